"""The compiled sweep against its plain NumPy twin, and many lanes against one."""

import numpy as np
import pytest
from model_cases import many_tubes
from model_oracle import Oracle

from ctr_dynamics.kernels.kinds import ONE_LANE, lanes_for
from ctr_dynamics.kernels.sections import section_lengths
from ctr_dynamics.kernels.sincos import sincos
from ctr_dynamics.kernels.sweep import sweep
from ctr_dynamics.model.model import Model

MEMORY = 3  # base rows of a learned force


def random_problem(n, seed, nodes=12):
    """A model of `n` tubes with random parameters, unknowns and histories of the size of motion."""
    rng = np.random.default_rng(seed)
    model = Model(many_tubes(n), nodes=nodes)
    layout, par = model.layout, model.parameters.copy()
    beta = np.array(model.robot.rest.beta.value) + rng.uniform(-0.005, 0.005, n)
    par[layout["beta"]] = beta
    par[layout["alpha"]] = rng.uniform(-3, 3, n)
    par[layout["alpha_rate"]] = rng.uniform(-2, 2, n)
    par[layout["force"]] = rng.uniform(-0.2, 0.2, 3)
    par[layout["torque"]] = rng.uniform(-0.01, 0.01, 3)
    _, mesh = model.mesh(beta)
    x = rng.uniform(-1, 1, 5 + n) * np.array([2e-3] * n + [0.1] * 3 + [5e-3] * 2)
    points = len(mesh.ust) // (3 * n)
    scale = np.array([5.0] * 3 + [50.0] * 3 + [100.0] * 3 + [100.0] * (n - 1) + [50.0] * (n - 1))
    hist = rng.uniform(-1, 1, (points, len(scale))) * scale
    histb = rng.uniform(-1, 1, (n, 4 * mesh.base_cells + 1, 2)) * np.array([50.0, 100.0])
    return model, mesh, par, beta, x, hist.ravel(), np.append(histb.ravel(), np.zeros(4 * n + MEMORY))


def compiled(model, mesh, lanes, par, beta, x, hist, histb, c0):
    """One sweep; every argument (rows, L). Returns res, fields, base fields, nodes as (rows, L)."""
    L = lanes.count
    b = model.sweep_buffers(mesh, L)
    for target, source in ((b.parameters, par), (b.unknowns, x), (b.history, hist), (b.base_history, histb)):
        target[:] = np.asarray(source).reshape(-1, L).ravel()
    lengths = np.zeros(len(mesh.sec_cells))
    for j in range(L):
        section_lengths(mesh.bp_tube, mesh.bp_offset, beta.reshape(-1, L)[:, j].copy(), lengths)
        b.section_lengths.reshape(-1, L)[:, j] = lengths
    sweep(model.kind, lanes, c0, mesh, b)
    return tuple(a.reshape(-1, L).copy() for a in (b.residual, b.fields, b.base_fields, b.nodes))


def relative(found, expected):
    """Largest difference over the largest expected number."""
    return np.abs(found.ravel() - expected.ravel()).max() / np.abs(expected).max()


@pytest.mark.parametrize("n", [1, 2, 3, 4])
@pytest.mark.parametrize("c0", [0.0, 765.0])
def test_sweep_equals_its_numpy_twin(n, c0):
    """Random unknowns, actuators, loads and histories.

    Damping, friction, bodies and every gyroscopic term on.
    """
    model, mesh, par, beta, x, hist, histb = random_problem(n, 10 * n)
    if c0 == 0.0:
        hist, histb = 0.0 * hist, 0.0 * histb
    found = compiled(model, mesh, ONE_LANE, par, beta, x, hist, histb, c0)
    lengths = np.zeros(len(mesh.sec_cells))
    section_lengths(mesh.bp_tube, mesh.bp_offset, beta, lengths)
    expected = Oracle(model.layout, par, mesh, lengths, c0).sweep(x, hist, histb)
    assert np.isfinite(expected[0]).all()
    S = 16 + 3 * n
    for row in range(S):
        a, b = found[3].reshape(-1, S)[:, row], expected[3][:, row]
        np.testing.assert_allclose(
            a, b, rtol=1e-9, atol=1e-10 * max(np.abs(b).max(), 1e-12), err_msg=f"state row {row}"
        )
    # drives, tilts and the memory of a learned force stand still in the plain model
    base = np.append(expected[2].ravel(), np.zeros(4 * n + MEMORY))
    for name, a, b in zip(("res", "out", "outb"), found, (expected[0], expected[1], base), strict=False):
        assert relative(a, b) < 1e-9, name


@pytest.mark.parametrize("n", [1, 2, 3, 4])
def test_lanes_equal_separate_sweeps(n):
    """Sixteen problems at once, everything perturbed in each, against sweeps of one lane."""
    lanes, L, c0 = lanes_for(16), 16, 765.0
    model, mesh, *base = random_problem(n, 5)
    rng = np.random.default_rng(7)
    many = [np.asarray(v)[:, None] * (1 + 1e-2 * rng.standard_normal((len(v), L))) for v in base]
    together = compiled(model, mesh, lanes, *many, c0)
    for j in (0, 3, 15):
        alone = compiled(model, mesh, ONE_LANE, *(v[:, j] for v in many), c0)
        for a, b in zip(together, alone, strict=True):
            assert relative(a[:, j], b) < 1e-10


def test_polynomial_sine_and_cosine():
    angles = np.concatenate([np.linspace(-50, 50, 4001), np.arange(-8, 9) * np.pi / 4, [9e4, -9e4]])
    found = np.array([sincos(a) for a in angles])
    allowed = 5e-13 + np.abs(angles) * 1e-16  # and half a rounding of the argument
    assert (np.abs(found[:, 0] - np.sin(angles)) < allowed).all()
    assert (np.abs(found[:, 1] - np.cos(angles)) < allowed).all()


def test_torsion_row_of_the_total_moment_is_the_sum_of_the_tubes():
    """Without friction, bodies and loads the torques of all tubes add up to one rod's.

    (13), summed, has no internal torque.
    """
    n = 3
    model, mesh, par, beta, x, hist, histb = random_problem(n, 3)
    for name in (
        "tube_coulomb",
        "tube_viscous",
        "body_mass",
        "body_inertia_x",
        "body_inertia_y",
        "body_inertia_z",
    ):
        par[model.layout[name]] = 0.0
    changed = par.copy()
    changed[model.layout["tube_coulomb"]] = 0.05
    changed[model.layout["tube_viscous"]] = 1e-6
    plain = compiled(model, mesh, ONE_LANE, par, beta, x, hist, histb, 0.0)[3].reshape(-1, 16 + 3 * n)
    rubbing = compiled(model, mesh, ONE_LANE, changed, beta, x, hist, histb, 0.0)[3].reshape(-1, 16 + 3 * n)
    first, rubbed = plain[0, 18 : 18 + n], rubbing[0, 18 : 18 + n]
    assert np.abs(rubbed - first).max() > 1e-6  # friction acts on each tube
    assert abs(rubbed.sum() - first.sum()) < 1e-15  # and on their sum not at all
