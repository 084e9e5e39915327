"""Running a scenario: the model over time, then what encoders, tracker and load cell would have reported, as
a bag.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics import __version__
from ctr_dynamics.effects import make_plant
from ctr_dynamics.errors import InputError
from ctr_dynamics.io.bag_writer import write_bag
from ctr_dynamics.io.messages import topics
from ctr_dynamics.io.messages.encode import encode_joint_state, encode_pose_stamped, encode_wrench_stamped
from ctr_dynamics.io.truth_files import Truth
from ctr_dynamics.kernels.rotations import from_vector, matrix, multiply
from ctr_dynamics.model.model import Model
from ctr_dynamics.model.simulator import Inputs, Simulator
from ctr_dynamics.model.statics import Statics
from ctr_dynamics.model.time_scheme import scheme_of
from ctr_dynamics.robot import Robot
from ctr_dynamics.sensing import ActuatorModel
from ctr_dynamics.simulation.scenario import Scenario

Floats = NDArray[np.float64]
Progress = Callable[[float], None]
FRAME = "ctr_base"


@dataclass
class SimulatedRecording:
    """What a run gave; times in s from its begin, poses in ``ctr_base``.

    Attributes:
        t: (k,) s; position: (k, 3) m; quaternion: (k, 4) wxyz of the tip.
        wrench: known wrench (6,) N, N m at a time (s).
        joints: (N,) rad and (N,) m that the drives' encoders read at a time, without noise.
        failure: why the run ended before its time, else empty.
    """

    t: Floats
    position: Floats
    quaternion: Floats
    wrench: Callable[[float], Floats]
    joints: Callable[[float], tuple[Floats, Floats]]
    failure: str = ""


def _wrenches(scenario: Scenario, model: Model, inputs: Inputs) -> list[Floats]:
    """(6,) of every load; the torque of hung weights from the tangent in the equilibrium under everything
    that acts at t = 0.
    """
    gravity = np.array(model.robot.gravity.value)
    wrenches = [
        np.concatenate([np.array(load.force_N) + load.hung_mass_kg * gravity, load.torque_N_m])
        for load in scenario.loads
    ]
    hung = [i for i, load in enumerate(scenario.loads) if load.hung_mass_kg and load.below_tip_m]
    statics = Statics(model)
    for _ in range(200 if hung else 0):
        total = sum(
            (load.factor(0.0) * w for load, w in zip(scenario.loads, wrenches, strict=True)),
            np.r_[model.plant.tip_force, 0.0, 0.0, 0.0],
        )
        found = statics.solve(inputs.beta, inputs.alpha, total[:3], total[3:])
        if not found.converged:
            break
        tangent = matrix(found.tip_quaternion)[:, 2]
        change = 0.0
        for i in hung:
            load = scenario.loads[i]
            torque = np.array(load.torque_N_m) + np.cross(
                load.below_tip_m * tangent, load.hung_mass_kg * gravity
            )
            change = max(change, float(np.abs(torque - wrenches[i][3:]).max()))
            wrenches[i][3:] += 0.6 * (torque - wrenches[i][3:])
        if change < 1e-9:
            return wrenches
    if hung:
        raise InputError(
            "no equilibrium was found with the hung weight", do="lower hung_mass_kg", where="loads"
        )
    return wrenches


Drive = Callable[[float], Inputs]
Turning = Callable[[float], tuple[Floats, Floats]]  # angles and rates at a time in s


def _behind_backlash(command: Turning, actuators: ActuatorModel, end: float, dt: float) -> Turning:
    """(angles, rates) that the tubes follow to ``end`` s when the backlash of ``actuators`` lies between them and the drives' ``command``."""
    t = dt * np.arange(math.ceil(end / dt) + 2)
    driven = np.array([command(x)[0] for x in t])
    found = actuators.behind_backlash(np.hstack([driven, np.zeros_like(driven)]))[:, : actuators.n]
    slopes = np.diff(found, axis=0) / dt

    def follow(time: float) -> tuple[Floats, Floats]:
        i = min(max(math.ceil(time / dt) - 1, 0), len(slopes) - 1)
        if time <= 0.0:
            return found[0].copy(), np.zeros(actuators.n)
        return found[i] + (time - t[i]) * slopes[i], slopes[i].copy()

    return follow


def drives(scenario: Scenario, robot: Robot, model: Model) -> tuple[Drive, Drive]:
    """Actuators and load of ``scenario`` at a time in s: (what the tubes do under all loads, what is read of both: encoders and known loads).

    The scenario moves the drives; backlash and delay that the robot file names lie between them and the tubes.

    Raises:
        InputError: motions leave the actuators' range, are for more tubes than there are, or there is no
        equilibrium to begin with.
    """
    axes = scenario.axes(robot.n_tubes)
    rest_alpha, rest_beta = np.array(robot.rest.alpha.value), np.array(robot.rest.beta.value)

    actuators, load_delay = model.plant.actuators, model.plant.load_delay

    def turned(t: float) -> tuple[Floats, Floats]:
        return (
            rest_alpha + [rotation.value(t) for rotation, _ in axes],
            np.array([rotation.rate(t) for rotation, _ in axes]),
        )

    follow: Turning = turned
    if actuators.backlash.any():
        end = scenario.duration_s + max(-actuators.delay, 0.0)
        follow = _behind_backlash(turned, actuators, end, 0.2 * scenario.solver.dt_s)

    def late(t: float) -> tuple[Floats, Floats]:
        if t > actuators.delay or not actuators.delay:
            return follow(t - actuators.delay)
        return follow(0.0)[0], np.zeros(robot.n_tubes)

    def moving(t: float, wrench: Floats) -> Inputs:
        alpha, alpha_rate = late(t)
        beta = rest_beta + [translation.value(t) for _, translation in axes]
        beta_rate = np.array([translation.rate(t) for _, translation in axes])
        return Inputs(alpha, alpha_rate, beta, beta_rate, wrench[:3], wrench[3:])

    def read(t: float, wrench: Floats) -> Inputs:
        moved = moving(t, wrench)
        readings = actuators.inverse(np.concatenate([turned(t)[0], moved.beta]))
        n = actuators.n
        return replace(moved, alpha=readings[:n], beta=readings[n:])

    dt = scenario.solver.dt_s
    for k in range(0, math.ceil(scenario.duration_s / dt - 1e-9) + 1, 5):
        problem = robot.actuator_problem(moving(k * dt, np.zeros(6)).beta)
        if problem:
            raise InputError(f"at {k * dt:.3f} s {problem}", do="mend the translations", where="tubes")
    pairs = list(zip(scenario.loads, _wrenches(scenario, model, moving(0.0, np.zeros(6))), strict=True))

    unseen = np.r_[model.plant.tip_force, 0.0, 0.0, 0.0]

    def acting(t: float) -> Floats:
        return sum((load.factor(t - load_delay if load.known else t) * w for load, w in pairs), unseen.copy())

    def told(t: float) -> Floats:
        return sum((load.factor(t) * w for load, w in pairs if load.known), np.zeros(6))

    return lambda t: moving(t, acting(t)), lambda t: read(t, told(t))


def simulate(scenario: Scenario, robot: Robot, progress: Progress | None = None) -> SimulatedRecording:
    """Run a scenario with a robot from rest in the static equilibrium of its first inputs.

    Args:
        scenario: from :func:`load_scenario`, or built in Python.
        robot: from :func:`load_robot`.
        progress: called now and then with the fraction done.

    Returns:
        The recording: ``t`` (k,) s, ``position`` (k, 3) m and ``quaternion`` (k, 4) wxyz of the tip in ``ctr_base``, the known wrench and the
        encoders over time. A step that the solver cannot take ends the run there; ``failure`` says why.

    Raises:
        InputError: the scenario does not fit the robot, or moves an actuator out of its range.

    Example:
        >>> from ctr_dynamics import load_robot, load_scenario, simulate
        >>> scenario = load_scenario("release").model_copy(update={"duration_s": 0.02})
        >>> recording = simulate(scenario, load_robot("till2020_tissue"))
        >>> recording.position.shape, recording.failure
        ((21, 3), '')
    """
    model = Model(robot, nodes=scenario.solver.nodes)
    at, known = drives(scenario, robot, model)
    dt = scenario.solver.dt_s
    steps = math.ceil(scenario.duration_s / dt - 1e-9)
    simulator = Simulator(model, scheme_of(scenario.solver.scheme, dt))
    # the tubes start from rest even when a motion begins with a jump of speed
    state = simulator.rest(at(0.0))
    tips = [state.nodes[-1, :7].copy()]
    failure = ""
    shift = model.plant.load_delay
    corners = [t + shift * load.known for load in scenario.loads for t, _ in load.corners()]
    for k in range(steps):
        events = [t for t in corners if k * dt < t < (k + 1) * dt]
        result = simulator.step(state, k * dt, at, events=events)
        if not result.ok:
            failure = f"step at {k * dt:.4f} s failed: {result.reason}"
            break
        tips.append(state.nodes[-1, :7].copy())
        if progress is not None and k % 50 == 0:
            progress(k / steps)
    rows = np.array(tips)
    quaternion = rows[:, 3:] / np.linalg.norm(rows[:, 3:], axis=1, keepdims=True)
    return SimulatedRecording(
        dt * np.arange(len(rows), dtype=np.float64),
        rows[:, :3],
        quaternion,
        lambda t: np.concatenate([known(t).force, known(t).torque]),
        lambda t: (known(t).alpha, known(t).beta),
        failure,
    )


def _pick(value: float | None, default: float) -> float:
    return default if value is None else value


def _stamps(rate: float, end: float) -> list[int]:
    """Times in ns from 0 to ``end`` s at ``rate`` Hz."""
    return [round(k * 1e9 / rate) for k in range(math.floor(end * rate + 1e-9) + 1)]


def _tip_at(recording: SimulatedRecording) -> Callable[[Floats], Floats]:
    """The tip (s, 7) at any times (s,) in s, held outside the run."""
    poses = np.hstack([recording.position, recording.quaternion])

    def at(times: Floats) -> Floats:
        inside = np.clip(times, 0.0, recording.t[-1])
        tip = np.stack([np.interp(inside, recording.t, x) for x in poses.T], axis=1)
        for row in tip:
            row[3:] /= np.linalg.norm(row[3:])
        return tip

    return at


def truth_of(scenario: Scenario, robot: Robot, recording: SimulatedRecording) -> Truth:
    """The tip of a run over time, its velocity by central differences, and what an ideal tracker would have reported at each time."""
    tracker = make_plant(robot).tracker.corrected(delay=0.0)
    velocity = np.gradient(recording.position, recording.t, axis=0, edge_order=2)
    return Truth(
        recording.t,
        recording.position,
        recording.quaternion,
        velocity,
        tracker.forward(recording.t, _tip_at(recording))[0],
        scenario.start_stamp_s * 1_000_000_000,
    )


def messages(scenario: Scenario, robot: Robot, recording: SimulatedRecording) -> list[tuple[int, str, bytes]]:
    """(log time ns, topic, message) of a run in the order of log times, with noise and the tracker's chain as in files."""
    n = robot.n_tubes
    end = float(recording.t[-1])
    origin = scenario.start_stamp_s * 1_000_000_000
    joint_noise, tracker_noise = (np.random.default_rng([scenario.seed, stream]) for stream in (1, 2))
    noise, own = scenario.noise, robot.tracker.noise
    encoder = position = rotation = drift = 0.0
    drift_time = own.drift_time.value
    if noise is not False:
        encoder = _pick(noise.encoder_rad, robot.encoders.noise.value)
        position, rotation = (
            _pick(noise.position_m, own.position.value),
            _pick(noise.rotation_rad, own.rotation.value),
        )
        drift, drift_time = _pick(noise.drift_m, own.drift.value), _pick(noise.drift_time_s, drift_time)
    found: list[tuple[int, str, bytes]] = []

    names = [f"tube{i + 1}_{kind}" for kind in ("rotation", "translation") for i in range(n)]
    for ns in _stamps(scenario.rates.joints_hz, end):
        alpha, beta = recording.joints(ns * 1e-9)
        reading = alpha + encoder * joint_noise.standard_normal(n)
        stamp = origin + ns
        found.append(
            (
                stamp,
                topics.JOINT_STATES,
                encode_joint_state(stamp, names, [*reading.tolist(), *beta.tolist()]),
            )
        )

    tracker = make_plant(robot).tracker.corrected(delay=scenario.tracker.delay_s)
    stamps = _stamps(scenario.rates.tracker_hz, end)
    positions, quaternions = tracker.forward(np.array(stamps) * 1e-9, _tip_at(recording))
    stated = robot.tracker.mount_rotation
    mount = from_vector(stated.array if stated is not None else np.zeros(3))
    keep = math.exp(-1.0 / (scenario.rates.tracker_hz * drift_time))
    wander = drift * tracker_noise.standard_normal(3)
    for ns, p, h in zip(stamps, positions, quaternions, strict=True):
        wander = keep * wander + drift * math.sqrt(1.0 - keep * keep) * tracker_noise.standard_normal(3)
        reported = p + wander + position * tracker_noise.standard_normal(3)
        turned = multiply(h, from_vector(rotation * tracker_noise.standard_normal(3)))
        turned = multiply(turned / np.linalg.norm(turned), mount)
        stamp = origin + ns
        message = encode_pose_stamped(stamp, FRAME, reported.tolist(), turned[[1, 2, 3, 0]].tolist())
        found.append((stamp + round(scenario.tracker.arrival_s * 1e9), topics.TRACKER_TIP, message))

    if any(load.known for load in scenario.loads):
        corners = {round(t * 1e9) for load in scenario.loads if load.known for t, _ in load.corners()}
        grid = set(_stamps(scenario.rates.load_hz, end)) | {ns for ns in corners if ns <= end * 1e9}
        for ns in sorted(grid):
            wrench = recording.wrench(ns * 1e-9)
            stamp = origin + ns
            found.append(
                (
                    stamp,
                    topics.TIP_LOAD,
                    encode_wrench_stamped(stamp, FRAME, wrench[:3].tolist(), wrench[3:].tolist()),
                )
            )
    return sorted(found, key=lambda item: item[:2])


def write_recording(path: Path, scenario: Scenario, robot: Robot, recording: SimulatedRecording) -> int:
    """Write the driver messages of a run as one MCAP file; returns their number. The same run gives the same
    bytes.

    Raises:
        InputError: the file cannot be written.
    """
    metadata = {
        "version": __version__,
        "robot": robot.source or robot.name,
        "robot_sha256": robot.sha256,
        "scenario": scenario.source,
        "scenario_sha256": scenario.sha256,
        "parameters": scenario.model_dump_json(),
    }
    listed = messages(scenario, robot, recording)
    with write_bag(path, metadata) as bag:
        for log_ns, topic, data in listed:
            bag.write(topic, log_ns, data)
    return len(listed)
