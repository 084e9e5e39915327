"""Vibration modes against a simulation, and what a moving robot's are refreshed for."""

import dataclasses
import itertools

import numpy as np
import pytest
from scipy.optimize import curve_fit

from ctr_dynamics.estimation.mode_tracker import ModeTracker, RefreshOptions
from ctr_dynamics.estimation.vibration_modes import modal_basis
from ctr_dynamics.model.model import Model
from ctr_dynamics.model.simulator import Inputs, Simulator
from ctr_dynamics.model.statics import Statics
from ctr_dynamics.robot_files import load_robot

BETA, ALPHA, ZERO = np.array([-0.2521, -0.1977]), np.array([1.5708, 1.5708]), np.zeros(2)
DT = 0.003


@pytest.fixture(scope="module")
def model():
    return Model(load_robot("till2020_tissue"), nodes=24)


def test_modes_equal_a_simulated_small_vibration(model):
    """Let go of 2 mN: the tip's motion is the sum of modes with the frequencies and dampings found."""
    inputs = Inputs(ALPHA, ZERO, BETA, ZERO)
    equilibrium = Statics(model, 1e-10).solve(BETA, ALPHA, np.zeros(3), np.zeros(3))
    par = model.parameters.copy()
    par[model.layout["alpha"]], par[model.layout["beta"]] = ALPHA, BETA
    basis = modal_basis(model, equilibrium, par, BETA)
    assert basis is not None
    assert np.all(np.diff(basis.frequency_hz) > 0)
    assert np.all(basis.damping > 0)
    slowest = basis.direction[0]

    simulator = Simulator(model, tolerance=1e-10)
    state = simulator.rest(Inputs(ALPHA, ZERO, BETA, ZERO, 2e-3 * slowest))
    tips, modes = [], []
    for k in range(500):
        assert simulator.step(state, k * DT, lambda t: inputs).ok
        tips.append(state.nodes[-1, :3].copy())
        modes.append(basis.measure(state.fields, inputs))
    path = (np.array(tips) - equilibrium.nodes[-1, :3]) @ slowest
    t = DT * np.arange(1, 501)

    def waves(t, *numbers):
        return sum(
            size * np.exp(-decay * t) * np.cos(2 * np.pi * frequency * t + phase)
            for size, decay, frequency, phase in np.reshape(numbers, (-1, 4))
        )

    # two bending modes lie close together; the spectrum's peak is where the fit begins
    after = slice(30, None)
    spectrum = np.abs(np.fft.rfft(path[after] * np.hanning(470), 8192))
    peak = np.fft.rfftfreq(8192, DT)[np.argmax(spectrum)]
    size = np.abs(path[after]).max()
    start = (size, 3.0, peak, 0.0, 0.3 * size, 3.0, 1.6 * peak, 0.0)
    found = np.reshape(curve_fit(waves, t[after], path[after], p0=start, maxfev=20000)[0], (2, 4))
    assert np.std(path[after] - waves(t[after], *found.ravel())) < 0.02 * np.std(path[after])
    for _, decay, frequency, _ in found:
        mode = int(np.argmin(np.abs(basis.frequency_hz - frequency)))
        assert basis.frequency_hz[mode] == pytest.approx(frequency, rel=0.01)
        assert basis.damping[mode] == pytest.approx(
            decay / np.hypot(decay, 2 * np.pi * frequency), rel=0.1, abs=5e-4
        )

    amplitude, rate = (np.array([getattr(m, name) for m in modes]) for name in ("amplitude", "rate"))
    along = amplitude @ (basis.direction @ slowest)
    assert np.sqrt(np.mean((along - path) ** 2)) < 0.05 * np.sqrt(np.mean(path**2))
    # the rate is the amplitude's derivative
    slope = np.gradient(amplitude[:, 0], DT)
    assert np.sqrt(np.mean((rate[5:-5, 0] - slope[5:-5]) ** 2)) < 0.05 * np.sqrt(np.mean(slope**2))


def test_modes_at_rest_are_zero_also_where_actuators_have_moved(model):
    equilibrium = Statics(model, 1e-10).solve(BETA, ALPHA, np.zeros(3), np.zeros(3))
    par = model.parameters.copy()
    par[model.layout["alpha"]], par[model.layout["beta"]] = ALPHA, BETA
    basis = modal_basis(model, equilibrium, par, BETA)
    there = Inputs(ALPHA, ZERO, BETA, ZERO)
    assert np.abs(basis.measure(equilibrium.fields, there).amplitude).max() < 1e-9
    alpha = ALPHA + np.array([0.004, -0.002])
    near = Statics(model, 1e-10).solve(BETA, alpha, np.zeros(3), np.zeros(3))
    moved = basis.measure(near.fields, Inputs(alpha, ZERO, BETA, ZERO))
    still = basis.measure(near.fields, there)
    assert np.abs(moved.amplitude).max() < 0.1 * np.abs(still.amplitude).max()


def test_modes_are_recomputed_only_where_the_robot_has_moved(model):
    tracker = ModeTracker(model, every=0)
    simulator = Simulator(model)

    count = itertools.count()

    def refreshed(alpha):
        """Frequencies and amplitudes after a refresh at rest at ``alpha``, and whether the modes were found for it."""
        state = simulator.rest(Inputs(alpha, ZERO, BETA, ZERO))
        tracker.measure(state, next(count))
        parts = 0
        while not parts or tracker.refreshing:
            tracker.refresh(state, simulator.parameters)
            parts += 1
        found = tracker.measure(state, next(count))
        return found.frequency_hz, found.amplitude, parts > 1

    frequency, amplitude, found = refreshed(ALPHA)
    assert found
    assert np.abs(amplitude).max() < 1e-8
    for k in range(1, RefreshOptions().most_reused + 1):
        same, amplitude, found = refreshed(ALPHA + k * 1e-4)
        assert not found
        assert np.array_equal(same, frequency)
        assert np.abs(amplitude).max() < 1e-8
    assert refreshed(ALPHA)[2]  # reused often enough
    assert not refreshed(ALPHA)[2]
    moved, amplitude, found = refreshed(ALPHA + np.array([0.3, 0.0]))
    assert found
    assert np.abs(moved / frequency - 1).max() > 1e-4
    assert np.abs(amplitude).max() < 1e-8
    assert refreshed(ALPHA + 0.02)[2]
    turned = ALPHA + 0.02 + 0.015
    assert refreshed(turned)[2]


def test_the_rate_is_the_derivative_and_modes_keep_their_sign_while_the_tubes_turn(model):
    """Half a turn of both tubes with a small vibration on it, refreshed all the time: as the estimator does it, without noise."""
    tracker, simulator = ModeTracker(model, every=20), Simulator(model, tolerance=1e-8)
    speed = 1.2  # rad/s

    def at(t):
        return Inputs(ALPHA + speed * t, np.full(2, speed), BETA, ZERO)

    state = simulator.rest(Inputs(ALPHA, ZERO, BETA, ZERO, np.array([2e-3, 1e-3, 0.0])))
    found = []
    for k in range(round(np.pi / speed / DT)):
        assert simulator.step(state, k * DT, at).ok
        found.append(tracker.measure(state, k))
        tracker.refresh(state, simulator.parameters)
    found = found[100:]
    amplitude, rate, direction = (
        np.array([getattr(modes, name)[:2] for modes in found]) for name in ("amplitude", "rate", "direction")
    )
    # the directions turn with the robot, and none jumps to its opposite
    cosine = np.sum(direction[1:] * direction[:-1], axis=2)
    assert cosine.min() > 0.9
    assert np.sum(direction[0] * direction[-1], axis=1).min() < -0.5
    # refreshes renew the equilibrium: the derivative is that between them
    slope = np.gradient(amplitude, DT, axis=0)
    quiet = np.abs(np.diff(amplitude, 2, axis=0, prepend=0, append=0)).max(1)
    usual = quiet < 8.0 * np.median(quiet)
    assert usual.mean() > 0.8
    error = np.sqrt(np.mean((rate - slope)[usual] ** 2, axis=0))
    # the second mode is hardly excited
    assert np.all(error < 0.1 * np.sqrt(np.mean(slope[usual, 0] ** 2)))


def test_modes_continue_those_before_in_order_and_sign(model):
    equilibrium = Statics(model, 1e-10).solve(BETA, ALPHA, np.zeros(3), np.zeros(3))
    par = model.parameters.copy()
    par[model.layout["alpha"]], par[model.layout["beta"]] = ALPHA, BETA
    basis = modal_basis(model, equilibrium, par, BETA)
    m, order, sign = len(basis.damping), np.array([2, 0, 3, 1]), np.array([1.0, -1.0, -1.0, 1.0])
    assert m == 4
    twice, phase = np.tile(sign, 2)[:, None], np.exp(1j * np.arange(m))
    mixed = dataclasses.replace(
        basis,
        frequency_hz=basis.frequency_hz[order],
        readout=(twice * basis.readout[np.concatenate([order, order + m])]),
        direction=sign[:, None] * basis.direction[order],
        shapes=basis.shapes[:, order] * phase,  # an eigenvector has no phase of its own
    )
    aligned = mixed.aligned_with(basis)
    assert np.array_equal(aligned.frequency_hz, basis.frequency_hz)
    assert np.allclose(aligned.readout, basis.readout, rtol=1e-12)
    assert np.allclose(aligned.direction, basis.direction)
