"""Vibration modes against a simulation, and what a moving robot's are refreshed for."""

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

    def refreshed(alpha):
        """Frequencies and amplitudes after a refresh at rest at ``alpha``, and whether the modes were found for it."""
        state = simulator.rest(Inputs(alpha, ZERO, BETA, ZERO))
        tracker.measure(state)
        parts = 0
        while not parts or tracker.refreshing:
            tracker.refresh(state, simulator.parameters)
            parts += 1
        found = tracker.measure(state)
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
