"""Static limit: reference shapes of two independent public models, closed forms, branches and stability."""

import csv
from pathlib import Path

import numpy as np
import pytest
from model_cases import make_robot, make_tube, still

from ctr_dynamics.errors import InputError
from ctr_dynamics.model.model import Model
from ctr_dynamics.model.simulator import Simulator
from ctr_dynamics.model.statics import Statics
from ctr_dynamics.model.time_scheme import make_scheme
from ctr_dynamics.robot_files import load_robot

DATA = Path(__file__).parents[1] / "data" / "static"
CASES = {"A2_tissueTableIII": ("till2020_tissue", 2), "B3_TIMC": ("three_tube", 3)}


def rows(name):
    with (DATA / f"{name}.csv").open() as stream:
        return [{key: float(value) for key, value in row.items()} for row in csv.DictReader(stream)]


def columns(row, name, n):
    return np.array([row[f"{name}{i + 1}"] for i in range(n)])


@pytest.fixture(scope="module", params=list(CASES))
def case(request):
    """(file name, N, statics of the weightless robot)."""
    robot, n = CASES[request.param]
    model = Model(load_robot(robot), nodes=60)
    model.parameters[model.layout["gravity"]] = 0.0
    model.parameters[model.layout["body_mass"]] = 0.0
    return request.param, n, Statics(model)


def tip_frame(h):
    """Rotation matrix of a unit quaternion (w, x, y, z)."""
    w, x, y, z = h
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def test_unloaded_shapes_agree_with_two_public_models(case):
    """Every row that is stable there: tip within 2e-6 m, end angles, tip frame and stability measure."""
    name, n, statics = case
    worst = 0.0
    count = 0
    for row in rows(f"{name}.unloaded"):
        if row["det_dalpha_dpsiL"] <= 0:
            continue
        beta, alpha, psi = (columns(row, key, n) for key in ("beta", "alpha", "psiL"))
        found = statics.solve(beta, alpha, end_angles=psi)
        assert found.converged
        worst = max(worst, np.linalg.norm(found.tip_position - [row[f"tip_{k}"] for k in "xyz"]))
        np.testing.assert_allclose(found.end_angles, psi, atol=1e-4)
        # their frame does not turn about the tangent; tube 1's is turned by its end angle
        R = tip_frame(found.tip_quaternion)
        c, s = np.cos(psi[0]), np.sin(psi[0])
        theirs = tip_frame([row[f"q{k}"] for k in "wxyz"]) @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        np.testing.assert_allclose(R, theirs, atol=5e-5)
        stability = statics.stability(found, beta, alpha)
        assert stability == pytest.approx(row["det_dalpha_dpsiL"], abs=2e-4 * max(1, abs(stability)))
        count += 1
    assert count >= 38
    assert worst < 2e-6


def test_loaded_shapes_on_the_same_branch(case):
    name, n, statics = case
    unloaded = {round(row["alpha1"], 9): row for row in rows(f"{name}.unloaded")}
    worst_tip = worst_frame = 0.0
    for row in rows(f"{name}.loaded"):
        beta, alpha = columns(row, "beta", n), columns(row, "alpha", n)
        psi = columns(unloaded[round(row["alpha1"], 9)], "psiL", n)
        found = statics.solve(beta, alpha, [row[f"F{k}"] for k in "xyz"], end_angles=psi)
        assert found.converged
        worst_tip = max(worst_tip, np.linalg.norm(found.tip_position - [row[f"tip_{k}"] for k in "xyz"]))
        frame = np.array([row[f"R{i}{j}"] for i in "123" for j in "123"]).reshape(3, 3)
        worst_frame = max(worst_frame, np.abs(tip_frame(found.tip_quaternion) - frame).max())
    assert worst_tip < 1e-5
    assert worst_frame < 1e-4


def test_all_angles_zero_bends_to_minus_y():
    model = Model(load_robot("three_tube"))
    model.parameters[model.layout["gravity"]] = 0.0
    found = Statics(model).solve([-0.12, -0.08, -0.02], [0.0, 0.0, 0.0])
    assert found.tip_position[1] < -0.02
    assert abs(found.tip_position[0]) < 1e-12


def test_a_circular_tube_is_a_circle():
    """One precurved tube without load keeps its own curvature: the tip is on the circle, at any alpha."""
    k, L, alpha = 8.0, 0.15, 0.7
    model = Model(make_robot([make_tube(segments=((L, (k, 0, 0)),))], [0.0]), nodes=40)
    found = Statics(model).solve([0.0], [alpha])
    y, z = -(1 - np.cos(k * L)) / k, np.sin(k * L) / k
    np.testing.assert_allclose(found.tip_position, [-np.sin(alpha) * y, np.cos(alpha) * y, z], atol=2e-8)


def test_cantilever_sag_under_its_weight():
    """Small sag q L^4 / 8 EI of a straight tube, and P L^3 / 3 EI of its body's weight."""
    L, mass = 0.1, 1e-5
    tube = make_tube(segments=((L, (0, 0, 0)),), mass=mass)
    model = Model(make_robot([tube], [0.0], gravity=(0.0, -0.2, 0.0)), nodes=40)
    p, layout = model.parameters, model.layout
    EI, weight = p[layout["bending_stiffness"]][0], p[layout["mass_per_length"]][0] * 0.2
    sag = weight * L**4 / (8 * EI) + mass * 0.2 * L**3 / (3 * EI)
    found = Statics(model).solve([0.0], [0.0])
    assert found.tip_position[1] == pytest.approx(-sag, rel=2e-5)


def test_large_deflection_of_a_cantilever():
    """Elastica under a transverse end force with P L^2 / EI = 3.

    Tip at 0.603 L across and 0.254 L short (Bisshopp and Drucker 1945).
    """
    L = 0.2
    model = Model(make_robot([make_tube(segments=((L, (0, 0, 0)),))], [0.0]), nodes=60)
    EI = model.parameters[model.layout["bending_stiffness"]][0]
    found = Statics(model).solve([0.0], [0.0], [0.0, 3 * EI / L**2, 0.0])
    assert found.tip_position[1] / L == pytest.approx(0.6033, abs=2e-4)
    assert 1 - found.tip_position[2] / L == pytest.approx(0.2544, abs=2e-4)


def test_torque_twists_the_whole_tube():
    """A torque about the axis turns tip against actuator by M (L + |beta|) / GJ."""
    length, beta, M = 0.3, -0.1, 2e-3
    model = Model(make_robot([make_tube(segments=((length, (0, 0, 0)),))], [beta]), nodes=20)
    GJ = model.parameters[model.layout["torsional_stiffness"]][0]
    found = Statics(model).solve([beta], [0.2], torque=(0, 0, M))
    h = found.tip_quaternion
    assert 2 * np.arctan2(h[3], h[0]) == pytest.approx(0.2 + M * length / GJ, abs=1e-10)
    assert found.x[0] == pytest.approx(M, rel=1e-9)  # and the actuator holds it


def test_polynomial_precurvature_equals_a_constant_and_follows_its_tube():
    """Constants written as polynomials change nothing.

    A linear one gives its clothoid, also when its beginning is behind the plate.
    """
    constant = make_tube(segments=((0.1, (0, 0, 0)), (0.1, (9.0, 2.0, 0.5))))
    polynomial = make_tube(segments=((0.1, np.zeros((3, 2))), (0.1, [[9.0, 0, 0], [2.0, 0, 0], [0.5, 0, 0]])))
    tips = []
    for tube in (constant, polynomial):
        model = Model(make_robot([tube], [-0.05], gravity=(0, -9.81, 0)), nodes=30)
        tips.append(Statics(model).solve([-0.04], [0.4], [0.01, 0, 0]).tip_position)
    np.testing.assert_allclose(tips[0], tips[1], atol=1e-12)

    slope, L = 60.0, 0.2
    model = Model(make_robot([make_tube(segments=((L, [[0, slope], [0, 0], [0, 0]]),))], [-0.02]), nodes=40)
    statics = Statics(model)
    for beta in (-0.02, -0.08):  # the same mesh object must not keep the first position's precurvature
        s = np.linspace(-beta, L, 20001)
        angle = slope * (s**2 - beta**2) / 2
        expected = -np.trapezoid(np.sin(angle), s), np.trapezoid(np.cos(angle), s)
        np.testing.assert_allclose(statics.solve([beta], [0.0]).tip_position[1:], expected, atol=1e-7)


def test_twist_of_a_torsional_precurvature_behind_the_plate_is_exact():
    """u*_z that changes behind the plate turns the tube there by its integral wherever the change lies."""
    tube = make_tube(segments=((0.03, (0, 0, 4.0)), (0.07, (0, 0, -1.0)), (0.1, (5.0, 0, 0))))
    statics = Statics(Model(make_robot([tube], [-0.05]), nodes=20))
    for beta in (-0.05, -0.071):
        h = statics.solve([beta], [0.0]).nodes[0, 3:7]
        assert 2 * np.arctan2(h[3], h[0]) == pytest.approx(4.0 * 0.03 - 1.0 * (-beta - 0.03), abs=1e-12)


def test_a_mesh_made_where_a_tube_begins_at_the_plate_serves_behind_it():
    """The same mesh holds while no breakpoint passes the plate, so it must not keep that nothing was behind."""
    tube = make_tube(segments=((0.07, (0, 0, 4.0)), (0.1, (5.0, 0, 4.0))))
    model = Model(make_robot([tube], [-0.05]), nodes=20)
    assert not model.moving_precurvature
    key, mesh = model.mesh(np.zeros(1))
    for beta in (0.0, -0.02):
        assert model.mesh(np.array([beta]), key)[1] is mesh
        h = Statics(model).solve([beta], [0.0], key=key).nodes[0, 3:7]
        assert 2 * np.arctan2(h[3], h[0]) == pytest.approx(-4.0 * beta, abs=1e-12)


def test_convergence_in_arc_length_is_fourth_order():
    """Tip of a loaded, damped step's sections against very many nodes.

    Errors fall by 16 when nodes double.
    """
    robot = load_robot("till2020_tissue")
    beta, alpha = robot.rest.beta.value, (1.2, 0.3)

    def tip(nodes):
        found = Statics(Model(robot, nodes=nodes), tolerance=1e-13).solve(beta, alpha, (0.1, -0.2, 0.05))
        assert found.converged
        return found.tip_position

    exact = tip(961)
    errors = np.array([np.linalg.norm(tip(n) - exact) for n in (16, 31, 61, 121)])
    orders = np.log2(errors[:-1] / errors[1:])
    # cells of each section are whole numbers, so single doublings scatter around 4
    assert np.log2(errors[0] / errors[-1]) / 3 == pytest.approx(4.0, abs=0.3), orders


def test_static_solution_is_a_fixed_point_of_the_dynamics():
    """A robot at rest stays at rest to rounding, because every stage carries its own history."""
    model = Model(load_robot("till2020_tissue"), nodes=24)
    inputs = still(model.robot.rest.beta.value, (1.2, 0.3), (0.05, -0.1, 0.0))
    for scheme in ("sdirk3", "bdf_alpha"):
        simulator = Simulator(model, make_scheme(scheme, 0.003), tolerance=1e-10)
        state = simulator.rest(inputs)
        start = state.nodes[-1, :7].copy()
        for k in range(30):
            assert simulator.step(state, 0.003 * k, lambda t: inputs).ok
        np.testing.assert_allclose(state.nodes[-1, :7], start, atol=1e-9)
        assert np.abs(state.nodes[:, 7:13]).max() < 1e-6


def test_unreachable_positions_are_refused():
    statics = Statics(Model(load_robot("till2020_tissue")))
    with pytest.raises(InputError, match="behind the base plate"):
        statics.solve([-0.45, -0.1977], [0, 0])
    with pytest.raises(InputError, match="beyond tube 1"):
        statics.solve([-0.38, -0.01], [0, 0])
