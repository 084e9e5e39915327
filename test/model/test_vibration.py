"""Small vibrations of one straight tube against beam theory.

Frequencies, material damping, numerical damping, energy.
"""

import numpy as np
import pytest
from model_cases import dominant_frequency, make_robot, make_tube, still
from scipy.optimize import brentq

from ctr_dynamics.kernels.layout import RATES
from ctr_dynamics.kernels.sections import section_lengths
from ctr_dynamics.model.model import Model
from ctr_dynamics.model.simulator import Simulator
from ctr_dynamics.model.time_scheme import make_scheme

L = 0.2


def trapezoid_true(frequency, dt):
    """Frequency of the motion whose trapezoidal rule shows `frequency`.

    The rule maps omega to 2/dt atan(omega dt/2), exactly for linear motion.
    """
    return np.tan(np.pi * frequency * dt) / (np.pi * dt)


def shown_by(scheme, frequency, dt):
    """Frequency that a Runge-Kutta scheme shows for a motion of `frequency`.

    The angle that its stability function turns in a step.
    """
    return np.angle(sdirk_amplification(scheme, 2j * np.pi * frequency * dt)) / (2 * np.pi * dt)


def released(tube, *, dt, steps, force=(0, 0, 0), torque=(0, 0, 0), beta=0.0, scheme="trapezoid", nodes=24):
    """Motion after a small load is taken away at t = 0.

    Model, tip states per step (steps + 1, S) and stored fields.
    """
    model = Model(make_robot([tube], [beta]), nodes=nodes)
    free, held = still([beta], [0.0]), still([beta], [0.0], force, torque)
    simulator = Simulator(model, make_scheme(scheme, dt), tolerance=1e-9)
    state = simulator.rest(held)
    tips, fields = [state.nodes[-1].copy()], [state.bank[0].copy()]
    for k in range(steps):
        result = simulator.step(state, k * dt, lambda t: free)
        assert result.ok, result
        tips.append(state.nodes[-1].copy())
        fields.append(state.bank[0].copy())
    return model, state, np.array(tips), np.array(fields)


def constants(model):
    p, layout = model.parameters, model.layout
    return [
        p[layout[k]][0]
        for k in ("bending_stiffness", "torsional_stiffness", "mass_per_length", "inertia_per_length")
    ]


@pytest.mark.parametrize("ratio", [0.0, 0.5, 4.0])
def test_bending_frequency_of_a_cantilever(ratio):
    """First frequency with a tip mass of `ratio` times the tube's, Euler-Bernoulli, within 0.1 %."""
    tube = make_tube(segments=((L, (0, 0, 0)),))
    EI, _, mass, _ = constants(Model(make_robot([tube], [0.0])))
    tube = make_tube(segments=((L, (0, 0, 0)),), mass=ratio * mass * L)
    root = brentq(
        lambda x: 1 + np.cos(x) * np.cosh(x) + ratio * x * (np.cos(x) * np.sinh(x) - np.sin(x) * np.cosh(x)),
        0.3,
        1.9,
    )
    expected = root**2 * np.sqrt(EI / (mass * L**4)) / (2 * np.pi)
    dt = 1 / (60 * expected)
    _, _, tips, _ = released(tube, dt=dt, steps=700, force=(0.0, 1e-3, 0.0))
    found = trapezoid_true(dominant_frequency(tips[:, 1], dt, expected), dt)
    assert found == pytest.approx(expected, rel=1e-3)


def test_second_bending_frequency():
    """The second mode is in the same motion: 4.69409^2 over 1.87510^2 times the first."""
    tube = make_tube(segments=((L, (0, 0, 0)),))
    EI, _, mass, _ = constants(Model(make_robot([tube], [0.0])))
    expected = 4.694091**2 * np.sqrt(EI / (mass * L**4)) / (2 * np.pi)
    dt = 1 / (20 * expected)
    _, _, tips, _ = released(tube, dt=dt, steps=400, force=(0.0, 1e-3, 0.0), scheme="sdirk3")
    # the fourth difference in time raises the higher mode above the first
    found = dominant_frequency(np.diff(tips[:, 1], 4), dt, expected)
    assert found == pytest.approx(shown_by("sdirk3", expected, dt), rel=1e-3)


def test_torsion_frequency_with_an_end_inertia():
    """beta tan(beta) = rho 2I L / H, over the whole tube: half of it behind the plate, half before."""
    tube = make_tube(segments=((L, (0, 0, 0)),))
    _, GJ, _, inertia = constants(Model(make_robot([tube], [0.0])))
    H = 400 * 2 * inertia * L
    tube = make_tube(segments=((L, (0, 0, 0)),), inertia=(1e-12, 1e-12, H))
    root = brentq(lambda x: x * np.tan(x) - 2 * inertia * L / H, 1e-6, 1.5)
    expected = root / L * np.sqrt(GJ / (2 * inertia)) / (2 * np.pi)
    dt = 1 / (40 * expected)
    _, _, tips, _ = released(tube, dt=dt, steps=600, torque=(0, 0, 1e-3), beta=-L / 2)
    angle = 2 * np.arctan2(tips[:, 6], tips[:, 3])
    found = trapezoid_true(dominant_frequency(angle, dt, expected), dt)
    assert found == pytest.approx(expected, rel=1e-3)


def test_torsion_frequency_of_a_free_end():
    """c / 4 L with c = sqrt(G / rho); nearly the whole tube lies behind the plate, where (18) holds alone."""
    tube = make_tube(segments=((L, (0, 0, 0)),))
    robot = make_robot([tube], [-L + 0.01])
    _, GJ, _, inertia = constants(Model(robot))
    expected = np.sqrt(GJ / (2 * inertia)) / (4 * L)
    dt = 1 / (20 * expected)
    model = Model(robot, nodes=8, base_cells=24)
    free, held = still([-L + 0.01], [0.0]), still([-L + 0.01], [0.0], torque=(0, 0, 1e-3))
    _, tips, _ = torsion(model, held, free, dt, 400, "sdirk3")
    found = dominant_frequency(tips, dt, expected)
    assert found == pytest.approx(shown_by("sdirk3", expected, dt), rel=1e-3)


def torsion(model, held, free, dt, steps, scheme="trapezoid"):
    """Tip angle (steps + 1,) after a torque is taken away."""
    simulator = Simulator(model, make_scheme(scheme, dt), tolerance=1e-9)
    state = simulator.rest(held)
    angles = [2 * np.arctan2(state.nodes[-1, 6], state.nodes[-1, 3])]
    for k in range(steps):
        assert simulator.step(state, k * dt, lambda t: free).ok
        angles.append(2 * np.arctan2(state.nodes[-1, 6], state.nodes[-1, 3]))
    return state, np.array(angles), simulator


def energy(model, state, fields):
    """Kinetic plus elastic energy (rows,), J, of stored fields (rows, fields) of one tube before the plate,
    by Simpson's rule.
    """
    EI, GJ, mass, inertia = constants(model)
    mesh = state.mesh
    lengths = np.zeros(len(mesh.sec_cells))
    section_lengths(mesh.bp_tube, mesh.bp_offset, state.inputs.beta, lengths)
    points = len(mesh.ust) // 3
    y = fields[:, : points * 9].reshape(len(fields), points, 9)
    u = y[:, :, 6:9] - mesh.ust.reshape(-1, 3)
    density = (
        mass * (y[:, :, :3] ** 2).sum(-1)
        + inertia * (y[:, :, 3:6] ** 2 @ [1, 1, 2])
        + EI * (u[:, :, :2] ** 2).sum(-1)
        + GJ * u[:, :, 2] ** 2
    ) / 2
    total, at = np.zeros(len(fields)), 0
    for k, cells in enumerate(mesh.sec_cells):
        stage = density[:, at : at + 4 * cells].reshape(len(fields), cells, 4)
        total += lengths[k] / cells / 6 * (stage @ [1, 2, 2, 1]).sum(-1)
        at += 4 * cells + 1
    body = model.parameters[model.layout["body_mass"]][0]
    return total + body / 2 * (y[:, -1, :3] ** 2).sum(-1)


def test_trapezoid_keeps_the_energy():
    """Without dissipation the trapezoidal rule conserves the energy of small vibrations.

    700 steps, over ten periods.
    """
    tube = make_tube(segments=((L, (0, 0, 0)),), mass=1e-3)
    model, state, _, fields = released(tube, dt=2e-3, steps=700, force=(0.0, 1e-3, 0.0), nodes=40)
    E = energy(model, state, fields[2:])
    assert E.min() > 0
    assert np.abs(E / E[0] - 1).max() < 2e-3
    assert abs(E[-50:].mean() / E[:50].mean() - 1) < 2e-4


def test_large_motion_keeps_its_energy_nearly():
    """A precurved tube whipping through large angles.

    No drift of the trapezoidal rule beyond its second order error.
    """
    tube = make_tube(segments=((L, (6.0, 0, 0)),), mass=1e-3)
    model, state, tips, fields = released(tube, dt=1e-3, steps=600, force=(0.1, 0.1, 0.0), nodes=40)
    assert np.ptp(tips[:, 1]) > 0.05
    E = energy(model, state, fields[2:])
    assert np.abs(E / E[0] - 1).max() < 2e-2


@pytest.mark.parametrize(
    ("scheme", "amplification"),
    [
        ("backward_euler", lambda z: 1 / abs(1 - z)),
        ("bdf2", lambda z: abs(np.roots([1.5 - z, -2, 0.5])).max()),
        ("sdirk2", lambda z: abs(sdirk_amplification("sdirk2", z))),
        ("sdirk3", lambda z: abs(sdirk_amplification("sdirk3", z))),
    ],
)
def test_numerical_damping_is_the_schemes_own(scheme, amplification):
    """The first mode decays by |R(i omega dt)| a step, as the scheme's stability function says."""
    tube = make_tube(segments=((L, (0, 0, 0)),), mass=1e-3)
    EI, _, mass, _ = constants(Model(make_robot([tube], [0.0])))
    ratio = 1e-3 / (mass * L)
    root = brentq(
        lambda x: 1 + np.cos(x) * np.cosh(x) + ratio * x * (np.cos(x) * np.sinh(x) - np.sin(x) * np.cosh(x)),
        0.3,
        1.9,
    )
    omega = root**2 * np.sqrt(EI / (mass * L**4))
    dt = 0.3 / omega
    model, state, _, fields = released(tube, dt=dt, steps=240, force=(0.0, 1e-3, 0.0), scheme=scheme)
    E = energy(model, state, fields)
    # higher modes die first; whole periods, far from the start
    a, b = 60, 60 + round(6 * 2 * np.pi / 0.3)
    rate = np.log(E[b] / E[a]) / (2 * (b - a))
    expected = np.log(amplification(1j * omega * dt))
    assert rate == pytest.approx(expected, rel=0.02, abs=2e-6)


def sdirk_amplification(name, z):
    """R(z) of a scheme from its stage coefficients y_t = c0 y + weights."""
    scheme = make_scheme(name, 1.0)
    rates: list[complex] = []
    y = 1.0 + 0j
    for c0, weights in zip(scheme.c0, scheme.weights, strict=True):
        h = weights[0] + sum(w * r for w, r in zip(weights[RATES:], rates, strict=False))
        y = -h / (c0 - z)  # z y = c0 y + h
        rates.append(c0 * y + h)
    return y


def test_material_damping_ratio():
    """Kelvin-Voigt damping B u_t gives the first mode the damping ratio B omega / 2 EI."""
    tube = make_tube(segments=((L, (0, 0, 0)),), mass=1e-3)
    EI, _, mass, _ = constants(Model(make_robot([tube], [0.0])))
    ratio = 1e-3 / (mass * L)
    root = brentq(
        lambda x: 1 + np.cos(x) * np.cosh(x) + ratio * x * (np.cos(x) * np.sinh(x) - np.sin(x) * np.cosh(x)),
        0.3,
        1.9,
    )
    omega = root**2 * np.sqrt(EI / (mass * L**4))
    zeta = 0.01
    tube = make_tube(segments=((L, (0, 0, 0)),), mass=1e-3, bending_damping=2 * zeta * EI / omega)
    dt = 2 * np.pi / omega / 100
    _, _, tips, _ = released(tube, dt=dt, steps=1050, force=(0.0, 1e-3, 0.0))
    y = tips[:, 1]
    peaks = np.array([k for k in range(1, 1050) if y[k] > y[k - 1] and y[k] >= y[k + 1]])
    heights = [y[k] - (y[k + 1] - y[k - 1]) ** 2 / (8 * (y[k + 1] - 2 * y[k] + y[k - 1])) for k in peaks]
    decrement = np.log(heights[1] / heights[9]) / 8
    assert decrement / np.sqrt(4 * np.pi**2 + decrement**2) == pytest.approx(zeta, rel=5e-3)


def test_torsional_damping_ratio():
    """Likewise for torsion: B_T omega / 2 GJ."""
    tube = make_tube(segments=((L, (0, 0, 0)),))
    _, GJ, _, inertia = constants(Model(make_robot([tube], [0.0])))
    H, zeta = 400 * 2 * inertia * L, 0.02
    root = brentq(lambda x: x * np.tan(x) - 2 * inertia * L / H, 1e-6, 1.5)
    omega = root / L * np.sqrt(GJ / (2 * inertia))
    tube = make_tube(
        segments=((L, (0, 0, 0)),), inertia=(1e-12, 1e-12, H), torsion_damping=2 * zeta * GJ / omega
    )
    dt = 2 * np.pi / omega / 100
    model = Model(make_robot([tube], [-L / 2]), nodes=16)
    held, free = still([-L / 2], [0.0], torque=(0, 0, 1e-3)), still([-L / 2], [0.0])
    _, angle, _ = torsion(model, held, free, dt, 850)
    peaks = [k for k in range(1, 850) if angle[k] > angle[k - 1] and angle[k] >= angle[k + 1]]
    decrement = np.log(angle[peaks[0]] / angle[peaks[6]]) / 6
    assert decrement / np.sqrt(4 * np.pi**2 + decrement**2) == pytest.approx(zeta, rel=1e-2)
