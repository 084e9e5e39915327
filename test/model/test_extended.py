"""The extended kernels against physics worked out apart from them: closed forms, force and momentum balances, rigid-body kinematics.

All robots here have two tubes, so that the kernels are compiled once; what is said of a single tube holds where the inner one stands alone.
"""

import copy
import math

import numpy as np
import pytest
from model_cases import dominant_frequency, make_robot, make_tube
from scipy.interpolate import CubicSpline

from ctr_dynamics.kernels.kinds import ONE_LANE
from ctr_dynamics.kernels.sections import section_lengths
from ctr_dynamics.kernels.sweep import sweep
from ctr_dynamics.model.mesh import node_positions
from ctr_dynamics.model.model import Model
from ctr_dynamics.model.simulator import Inputs, Simulator
from ctr_dynamics.model.statics import Statics
from ctr_dynamics.model.time_scheme import make_scheme
from ctr_dynamics.robot_files import robot_from_dict, robot_to_dict

E3 = np.array([0.0, 0.0, 1.0])
INNER = {"inner": 0.514e-3, "outer": 0.622e-3}
OUTER = {"inner": 0.7e-3, "outer": 0.9e-3}
BETA = np.array([-0.05, -0.04])
STILL = np.zeros(2)


def straight(outer_length=0.12, **options):
    """Two straight tubes, 0.15 m and outer_length - 0.04 m long beyond the plate."""
    tubes = [make_tube(**INNER), make_tube(**OUTER, segments=((outer_length, (0.0, 0.0, 0.0)),))]
    return make_robot(tubes, BETA, **options)


def curved(**options):
    """Two precurved tubes."""
    tubes = [
        make_tube(**INNER, segments=((0.11, (0.0, 0.0, 0.0)), (0.09, (9.0, 0.0, 0.0)))),
        make_tube(**OUTER, segments=((0.07, (0.0, 0.0, 0.0)), (0.05, (5.0, 2.0, 0.0)))),
    ]
    return make_robot(tubes, BETA, **options)


def extended(robot, nodes=24, **extensions):
    """Model of ``robot`` with extensions by name."""
    data = copy.deepcopy(robot_to_dict(robot))
    data["extensions"] = extensions
    return Model(robot_from_dict(data), nodes=nodes, extended=True)


def rotation(h):
    """Rotation matrix of a quaternion wxyz of any length."""
    w, v = h[0], h[1:]
    V = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    return np.eye(3) + 2.0 / (h @ h) * (w * V + V @ V)


def still(alpha=(0.0, 0.0), force=(0.0, 0.0, 0.0), torque=(0.0, 0.0, 0.0), beta=BETA):
    """Inputs at rest."""
    return Inputs(np.array(alpha), STILL, np.array(beta), STILL, np.array(force), np.array(torque))


def simulate(model, inputs, steps, dt, start=None):
    """States at all steps (tips (steps + 1, 13), unknowns (steps + 1, 7), node states)."""
    simulator = Simulator(model, make_scheme("sdirk3", dt), tolerance=1e-10)
    state = simulator.rest(inputs(0.0) if start is None else start)
    tips, unknowns, nodes = (
        [state.nodes[-1, :13].copy()],
        [state.unknowns[-1].copy()],
        [(state.mesh, state.nodes.copy())],
    )
    for k in range(steps):
        result = simulator.step(state, k * dt, inputs)
        assert result.ok, (k, result.reason)
        tips.append(state.nodes[-1, :13].copy())
        unknowns.append(state.unknowns[-1].copy())
        nodes.append((state.mesh, state.nodes.copy()))
    return np.array(tips), np.array(unknowns), nodes


def rate_of(values, dt):
    """Derivative (k - 4, ...) of samples, of fourth order; without the two samples at either end."""
    return (values[:-4] - 8.0 * values[1:-3] + 8.0 * values[3:-1] - values[4:]) / (12.0 * dt)


def tip_velocities(tips):
    """R q of every step."""
    return np.array([rotation(row[3:7]) @ row[7:10] for row in tips])


def sweep_at_rest(model, x, rates):
    """Node states of one sweep without history (c0 = 0), for unknowns and rates of the actuators that need not be in balance."""
    _, mesh = model.mesh(BETA)
    b = model.sweep_buffers(mesh, 1)
    b.parameters[:] = model.parameters
    b.parameters[model.layout["beta"]] = BETA
    b.parameters[model.layout["alpha_rate"]] = rates
    section_lengths(mesh.bp_tube, mesh.bp_offset, BETA, b.section_lengths)
    b.unknowns[:] = x
    sweep(model.kind, ONE_LANE, 0.0, mesh, b)
    return node_positions(mesh, BETA), b.nodes.reshape(-1, 22).copy()


# -- drives --


def test_compliant_drive_twists_by_torque_over_stiffness():
    alpha, k = np.array([0.4, -0.8]), np.array([0.05, 0.4])
    robot = curved(gravity=(0.0, -9.81, 0.0))
    soft = extended(
        robot, drivetrain_compliance={"tube1.stiffness_Nm_per_rad": k[0], "tube2.stiffness_Nm_per_rad": k[1]}
    )
    rigid = extended(robot)
    found = Statics(soft).solve(BETA, alpha)
    torque = found.x[:2]
    assert found.converged
    assert np.abs(torque / k).max() > 0.02
    same = Statics(rigid).solve(BETA, alpha + torque / k, guess=found.x)
    assert np.abs(same.tip_position - found.tip_position).max() < 1e-9
    # a drive that gives way takes some of the torque off
    assert np.all(np.abs(torque) < np.abs(Statics(rigid).solve(BETA, alpha, guess=found.x).x[:2]))


def test_drive_inertia_swings_on_the_drive_stiffness():
    k, inertia, dt = 2e-3, 1e-7, 0.001
    model = extended(
        straight(),
        drivetrain_compliance={"tube1.stiffness_Nm_per_rad": k, "tube1.inertia_kgm2": inertia},
    )

    def inputs(t):
        # a turn within 10 ms
        x = min(max(t / 0.01, 0.0), 1.0)
        alpha = 0.02 * (x - math.sin(2.0 * math.pi * x) / (2.0 * math.pi))
        rate = 0.02 / 0.01 * (1.0 - math.cos(2.0 * math.pi * x)) if x < 1.0 else 0.0
        return Inputs(np.array([alpha, 0.0]), np.array([rate, 0.0]), BETA, STILL)

    tips = simulate(model, inputs, 420, dt)[0][20:]
    tube = 2.0 * model.parameters[model.layout["inertia_per_length"]][0] * 0.2  # turns along as a whole
    expected = math.sqrt(k / (inertia + tube)) / (2.0 * math.pi)
    assert dominant_frequency(tips[:, 12], dt, expected) == pytest.approx(expected, rel=3e-3)


# -- clearance --


def test_play_tilts_by_the_moment_and_passes_on_all_forces():
    play = 0.012
    model = extended(straight(), clearance={"play_rad": play})
    found = Statics(model).solve(BETA, (0.3, 0.3), (0.05, -0.2, 0.0))
    s = node_positions(found.mesh, BETA)
    end = int(np.argmin(np.abs(s - 0.08)))  # of the outer tube
    near, far = found.nodes[end], found.nodes[end + 1]
    assert s[end] == s[end + 1]
    m = near[16:18]
    expected = play * m / math.hypot(*m, 0.01)
    R, Rt = rotation(near[3:7]), rotation(far[3:7])
    turn = R.T @ Rt
    found_turn = 0.5 * np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    assert np.hypot(*expected) > 0.5 * play
    assert np.abs(found_turn - [*expected, 0.0]).max() < 1e-6
    assert np.array_equal(near[:3], far[:3])
    assert np.abs(R @ near[13:16] - Rt @ far[13:16]).max() < 1e-9
    across = [np.array([*row[16:18], row[18:20].sum()]) for row in (near, far)]
    assert np.abs(R @ across[0] - Rt @ across[1]).max() < 1e-9


@pytest.mark.parametrize(("share", "limit"), [(1.0, 1e-3), (0.0, math.inf)], ids=["rigid", "not turned"])
def test_tip_moves_as_its_velocity_says_across_the_play(share, limit):
    """R q is p's rate when velocities turn with the tilt; without that they do not match."""
    model = extended(
        straight(gravity=(0.0, -9.81, 0.0)), clearance={"play_rad": 0.05}, play_kinematics={"share": share}
    )
    dt = 0.001

    def inputs(t):
        turn, rate = 0.5 * (1.0 - math.cos(20.0 * t)), 10.0 * math.sin(20.0 * t)
        force = np.array([0.0, -0.2 * math.cos(15.0 * t), 0.0])
        return Inputs(np.full(2, turn), np.full(2, rate), BETA, STILL, force, np.zeros(3))

    tips, _, _ = simulate(model, inputs, 80, dt)
    velocity = tip_velocities(tips)[2:-2]
    error = np.abs(rate_of(tips[:, :3], dt) - velocity)[10:].max() / np.abs(velocity).max()
    assert error < limit
    if math.isinf(limit):
        assert error > 1e-2


# -- tubes --


@pytest.mark.parametrize(("axis", "alpha"), [(0.0, 0.0), (math.pi / 2, 0.0), (0.0, math.pi / 2)])
def test_an_oval_tube_sags_by_the_ratio_of_its_stiffnesses(axis, alpha):
    """A force along y bends about x. The stiffer axis stands at ``axis`` in the tube, which is turned by alpha."""
    ratio = 1.6
    model = extended(
        straight(),
        ovality={"tube1.ratio": ratio, "tube1.axis_rad": axis, "tube2.ratio": ratio, "tube2.axis_rad": axis},
    )
    sag = [
        abs(Statics(model).solve(BETA, (alpha, alpha), 1e-3 * np.eye(3)[i]).tip_position[i]) for i in (0, 1)
    ]
    plain = abs(Statics(extended(straight())).solve(BETA, (0.0, 0.0), (1e-3, 0.0, 0.0)).tip_position[0])
    about_x = abs(axis + alpha) < 0.1
    assert sag[0] / sag[1] == pytest.approx(ratio if about_x else 1.0 / ratio, rel=1e-5)
    # the mean stiffness stays
    assert 0.5 * (1.0 / sag[0] + 1.0 / sag[1]) == pytest.approx(1.0 / plain, rel=1e-5)


def test_softening_follows_its_moment_curvature_law():
    limit = 30.0
    model = extended(straight(), softening={"tube1.curvature_1_per_m": limit})
    stiffness = model.parameters[model.layout["bending_stiffness"]][0]
    for moment in (0.01, 0.03, 0.04):  # up to k = 0.45 k_1: the law is solved by iteration
        found = Statics(model).solve(BETA, (0.0, 0.0), (0.0, 0.0, 0.0), (moment, 0.0, 0.0))
        assert found.converged
        points = len(found.mesh.ust) // 6
        u = found.fields[: points * 11].reshape(points, 11)[-1, 6:9]  # the inner tube alone
        k = moment / stiffness
        assert u[0] == pytest.approx(k / math.sqrt(1.0 - (k / limit) ** 2), rel=2e-6)
        assert abs(u[1]) + abs(u[2]) < 1e-9


# -- friction and drag --


def slip(rate, epsilon=15.0):
    """Smoothed sign."""
    return rate / math.hypot(rate, epsilon)


def test_distributed_friction_adds_torque_along_the_overlap():
    per_length = 4e-3
    model = extended(straight(), distributed_friction={"torque_Nm_per_m": per_length})
    rates = np.array([1.0, 4.0])
    s, nodes = sweep_at_rest(model, np.zeros(7), rates)
    # the outer tube, turning faster, drags the inner one along
    torque = per_length * slip(3.0) * np.minimum(s, 0.08)
    assert np.abs(nodes[:, 18] + torque).max() < 1e-15
    inside = s < 0.0799
    assert np.abs(nodes[inside, 19] - torque[inside]).max() < 1e-15


@pytest.mark.parametrize("rate", [0.0, 0.5, 2.0, 40.0])
def test_stribeck_raises_coulomb_friction_near_rest(rate):
    """At the plate, with a bending moment as preload; twice as much at rest as at speed."""
    ratio, speed, moment = 2.0, 2.0, 0.02
    robot = straight(base=(0.5, 0.0))
    x = np.array([0.0, 0.0, 0.0, 0.0, 0.0, moment, 0.0])
    found = []
    for options in ({}, {"stribeck": {"static_ratio": ratio, "speed_rad_s": speed}}):
        _, nodes = sweep_at_rest(extended(robot, **options), x, np.array([rate, rate]))
        found.append(nodes[0, 19])
    assert found[0] == pytest.approx(0.5 * moment * slip(rate), abs=1e-15)
    assert found[1] == pytest.approx(
        found[0] * (1.0 + math.exp(-((rate / speed) ** 2))), rel=1e-12, abs=1e-16
    )


def cantilever(x):
    """First mode of a cantilever at x in [0, 1], 1 at the tip."""
    b = 1.875104068711961
    sigma = (math.cosh(b) + math.cos(b)) / (math.sinh(b) + math.sin(b))
    shape = np.cosh(b * x) - np.cos(b * x) - sigma * (np.sinh(b * x) - np.sin(b * x))
    return shape / (math.cosh(b) - math.cos(b) - sigma * (math.sinh(b) - math.sin(b)))


def ringing(**extensions):
    """Peaks (k, 2: time, height) of the tip after the release of a small load; the inner tube stands alone but for 2 mm."""
    model = extended(straight(outer_length=0.042), **extensions)
    dt = 0.001

    def inputs(t):
        return still(force=(0.0, -0.02, 0.0) if t <= 0.0 else (0.0, 0.0, 0.0))

    tips, _, _ = simulate(model, inputs, 450, dt)
    y = CubicSpline(dt * np.arange(451), tips[:, 1])
    turning = y.derivative().roots(extrapolate=False)
    turning = turning[turning > 0.05]  # when higher modes have faded
    # the first mode only: the mean of neighbouring extremes is free of what is slow
    return turning, np.abs(y(turning))


def decay_rate(times, heights):
    """1/s, by a straight line through the logarithms."""
    return -np.polyfit(times, np.log(heights), 1)[0]


def test_linear_drag_and_a_damper_at_the_tip_let_vibration_decay_at_their_rates():
    """Drag c per length: c / (2 rho A). Damper C at the tip: 2 C / (rho A L), as the mode's mass is a quarter of the tube's."""
    own = decay_rate(*ringing())  # of the time scheme
    c, damper, length = 0.02, 4e-4, 0.149
    mass = 6493.0 * math.pi * (INNER["outer"] ** 2 - INNER["inner"] ** 2)
    drag = decay_rate(*ringing(air_drag={"linear_Ns_per_m2": c})) - own
    assert drag == pytest.approx(c / (2.0 * mass), rel=0.02)
    tip = decay_rate(*ringing(tip_spring={"damping_Ns_per_m": damper})) - own
    assert tip == pytest.approx(2.0 * damper / (mass * length), rel=0.04)


def test_quadratic_drag_lets_amplitude_fall_as_one_over_time():
    """A_t = -(4 / 3 pi) d / (rho A) w A^2 times the mode's integral of |phi|^3 over that of phi^2: 1 / A grows linearly."""
    d = 1.0
    times, heights = ringing(air_drag={"quadratic_Ns2_per_m3": d})
    own = decay_rate(*ringing())
    mass = 6493.0 * math.pi * (INNER["outer"] ** 2 - INNER["inner"] ** 2)
    omega = math.pi / np.mean(np.diff(times))
    x = np.linspace(0.0, 1.0, 2001)
    phi = cantilever(x)
    expected = 4.0 / (3.0 * math.pi) * d / mass * omega * np.mean(np.abs(phi) ** 3) / np.mean(phi**2)
    undamped = heights * np.exp(
        own * times
    )  # the time scheme's own decay taken off, exactly enough while it is small
    slope = np.polyfit(times, 1.0 / undamped, 1)[0]
    assert slope == pytest.approx(expected, rel=0.06)


# -- tip --


def test_spring_pulls_the_tip_to_its_anchor():
    anchor, k = np.array([0.02, 0.03, 0.12]), 5.0
    robot = curved(gravity=(0.0, -9.81, 0.0))
    model = extended(
        robot,
        tip_spring={
            "stiffness_N_per_m": k, "anchor_x_m": anchor[0], "anchor_y_m": anchor[1], "anchor_z_m": anchor[2],
        },
    )  # fmt: skip
    found = Statics(model).solve(BETA, (0.2, 0.2))
    force = k * (anchor - found.tip_position)
    assert np.abs(force).max() > 0.05
    same = Statics(extended(robot)).solve(BETA, (0.2, 0.2), force, guess=found.x)
    assert np.abs(same.tip_position - found.tip_position).max() < 1e-9


def test_contact_pushes_in_proportion_to_the_depth_and_leaves_the_free_side_alone():
    robot = straight()
    wall = {"stiffness_N_per_m": 80.0, "nx": 0.0, "ny": 2.0, "nz": 0.0, "offset_m": -0.01}
    model, plain = extended(robot, contact=wall), extended(robot)
    for load, touching in ((-0.5, True), (-0.02, False), (0.5, False)):
        force = np.array([0.0, load, 0.0])
        found = Statics(model).solve(BETA, (0.0, 0.0), force)
        depth = -0.01 - found.tip_position[1]
        assert (depth > 0.0) == touching
        push = np.array([0.0, 80.0 * max(depth, 0.0), 0.0])
        same = Statics(plain).solve(BETA, (0.0, 0.0), force + push, guess=found.x)
        assert np.abs(same.tip_position - found.tip_position).max() < 1e-9


# -- moving tubes --

WAVES = (0.006, 14.0), (-0.004, 9.0)  # m, rad/s


def sliding(t):
    """Both tubes slide and turn, smoothly from rest."""
    beta, rate = BETA.copy(), np.zeros(2)
    for i, (size, omega) in enumerate(WAVES):
        beta[i] += size * (1.0 - math.cos(omega * t))
        rate[i] = size * omega * math.sin(omega * t)
    turn = 0.3 * (1.0 - math.cos(8.0 * t)), 0.3 * 8.0 * math.sin(8.0 * t)
    return Inputs(np.full(2, turn[0]), np.full(2, turn[1]), beta, rate)


def test_without_its_scale_the_extended_model_is_the_plain_one():
    robot = curved(gravity=(0.0, -9.81, 0.0), base=(0.5, 1e-6), between=(0.01, 1e-7))
    found = []
    for model in (extended(robot, insertion_velocity={"scale": 0.0}), Model(robot, nodes=24)):
        found.append(simulate(model, sliding, 40, 0.003)[0])
    assert np.abs(found[0] - found[1])[:, :7].max() < 1e-9
    assert np.abs(found[0] - found[1])[:, 7:].max() < 1e-6


def test_tip_velocity_holds_the_insertion():
    model = extended(curved(gravity=(0.0, -9.81, 0.0)), insertion_velocity={"scale": 1.0})
    dt = 0.002
    tips, _, _ = simulate(model, sliding, 100, dt)
    velocity = tip_velocities(tips)[2:-2]
    error = np.abs(rate_of(tips[:, :3], dt) - velocity).max()
    assert np.abs(velocity).max() > 0.08
    assert error < 2e-3 * np.abs(velocity).max()


def test_straight_tubes_slide_without_bending_and_their_axial_force_is_mass_times_acceleration():
    model = extended(straight(), insertion_velocity={"scale": 1.0})
    acceleration, dt = 0.8, 0.002

    def inputs(t):
        beta, rate = BETA.copy(), np.zeros(2)
        beta[0] += 0.5 * acceleration * t * t
        rate[0] = acceleration * t
        return Inputs(STILL, STILL, beta, rate)

    tips, unknowns, _ = simulate(model, inputs, 80, dt)
    t = dt * np.arange(81)
    assert np.abs(tips[:, :2]).max() < 1e-12
    assert np.abs(tips[10:, 9] - acceleration * t[10:]).max() < 1e-9
    mass = model.parameters[model.layout["mass_per_length"]][0]
    expected = -mass * (0.15 + 0.5 * acceleration * t**2) * acceleration
    assert np.abs(unknowns[10:, 4] - expected[10:]).max() < 1e-3 * np.abs(expected).max()


def momentum(model, mesh, nodes, inputs, scale):
    """Linear momentum (3,) of the material beyond the plate, its weight, and what flows in through the plate each second.

    q is the velocity of the grid for ``scale`` 1; the plain model's, 0, leaves the sliding out altogether.
    """
    masses = model.parameters[model.layout["mass_per_length"]]
    g = model.parameters[model.layout["gravity"]]
    s = node_positions(mesh, inputs.beta)
    grid = (node_positions(mesh, inputs.beta + 1e-4 * inputs.beta_rate) - s) / 1e-4
    R = np.array([rotation(row[3:7]) for row in nodes])
    total, weight, first = np.zeros(3), np.zeros(3), 0
    for cells, present in zip(mesh.sec_cells, mesh.sec_tubes, strict=True):
        part = slice(first, first + cells + 1)
        first += cells + 1
        for i in range(present):
            slide = inputs.beta_rate[i] - scale * grid[part]
            v = np.einsum("kij,kj->ki", R[part], nodes[part, 7:10] + slide[:, None] * E3)
            total += masses[i] * CubicSpline(s[part], v).integrate(s[part][0], s[part][-1])
            weight += masses[i] * (s[part][-1] - s[part][0]) * g
    return total, weight, (masses @ inputs.beta_rate**2) * E3


def test_momentum_of_sliding_curved_tubes_changes_by_force_weight_and_inflow():
    """d/dt of the momentum beyond the plate = -n(0) + weight + the momentum of what slides in. The plain model misses it by far."""
    dt = 0.002
    errors = []
    for scale in (1.0, 0.0):
        model = extended(curved(gravity=(0.0, -9.81, 0.0)), insertion_velocity={"scale": scale})
        rows = []
        for k, (mesh, nodes) in enumerate(simulate(model, sliding, 90, dt)[2]):
            P, weight, inflow = momentum(model, mesh, nodes, sliding(k * dt), scale)
            rows.append((P, -rotation(nodes[0, 3:7]) @ nodes[0, 13:16] + weight + inflow))
        P, force = (np.array(x) for x in zip(*rows, strict=True))
        rate = rate_of(P, dt)[20:]
        errors.append(np.abs(rate - force[2:-2][20:]).max() / np.abs(rate).max())
    assert errors[0] < 0.02
    assert errors[1] > 0.3
