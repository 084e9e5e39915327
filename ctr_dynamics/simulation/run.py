"""Running a scenario: the model over time, then what encoders, tracker and load cell would have reported, as
a bag.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics import __version__
from ctr_dynamics.bagio.writer import write_bag
from ctr_dynamics.errors import InputError
from ctr_dynamics.estimation.rotations import from_vector, matrix, multiply
from ctr_dynamics.messages import topics
from ctr_dynamics.messages.encode import encode_joint_state, encode_pose_stamped, encode_wrench_stamped
from ctr_dynamics.model.model import Model
from ctr_dynamics.model.scheme import make_scheme
from ctr_dynamics.model.simulator import Inputs, Simulator
from ctr_dynamics.model.statics import Statics
from ctr_dynamics.robot import Robot
from ctr_dynamics.simulation.scenario import Scenario

Floats = NDArray[np.float64]
Progress = Callable[[float], None]
FRAME = "ctr_base"


@dataclass
class Recording:
    """What a run gave; times in s from its begin, poses in ``ctr_base``.

    Attributes:
        t: (k,) s; position: (k, 3) m; quaternion: (k, 4) wxyz of the tip.
        wrench: known wrench (6,) N, N m at a time (s).
        alpha, beta: (N,) rad and m at a time.
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
            (load.factor(0.0) * w for load, w in zip(scenario.loads, wrenches, strict=True)), np.zeros(6)
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


def drives(scenario: Scenario, robot: Robot, model: Model) -> tuple[Drive, Drive]:
    """Actuators and load of ``scenario`` at a time in s: (all loads, the known loads only).

    Raises:
        InputError: motions leave the actuators' range, are for more tubes than there are, or there is no
        equilibrium to begin with.
    """
    axes = scenario.axes(robot.n_tubes)
    rest_alpha, rest_beta = np.array(robot.rest.alpha.value), np.array(robot.rest.beta.value)

    def moving(t: float, wrench: Floats) -> Inputs:
        alpha = rest_alpha + [rotation.value(t) for rotation, _ in axes]
        beta = rest_beta + [translation.value(t) for _, translation in axes]
        alpha_rate = np.array([rotation.rate(t) for rotation, _ in axes])
        beta_rate = np.array([translation.rate(t) for _, translation in axes])
        return Inputs(alpha, alpha_rate, beta, beta_rate, wrench[:3], wrench[3:])

    dt = scenario.solver.dt_s
    for k in range(0, math.ceil(scenario.duration_s / dt - 1e-9) + 1, 5):
        problem = robot.actuator_problem(moving(k * dt, np.zeros(6)).beta)
        if problem:
            raise InputError(f"at {k * dt:.3f} s {problem}", do="mend the translations", where="tubes")
    pairs = list(zip(scenario.loads, _wrenches(scenario, model, moving(0.0, np.zeros(6))), strict=True))

    def total(t: float, known_only: bool) -> Floats:
        return sum((load.factor(t) * w for load, w in pairs if load.known or not known_only), np.zeros(6))

    return lambda t: moving(t, total(t, False)), lambda t: moving(t, total(t, True))


def simulate(scenario: Scenario, robot: Robot, progress: Progress | None = None) -> Recording:
    """Run ``scenario`` with ``robot`` from rest in the static equilibrium of its first inputs.

    A step that the solver cannot take ends the run there; ``failure`` says why.

    Raises:
        InputError: as :func:`drives`.
    """
    model = Model(robot, nodes=scenario.solver.nodes)
    at, known = drives(scenario, robot, model)
    dt = scenario.solver.dt_s
    steps = math.ceil(scenario.duration_s / dt - 1e-9)
    simulator = Simulator(model, make_scheme(scenario.solver.scheme, dt))
    # the tubes start from rest even when a motion begins with a jump of speed
    state = simulator.rest(at(0.0))
    tips = [state.nodes[-1, :7].copy()]
    failure = ""
    for k in range(steps):
        result = simulator.step(state, k * dt, at)
        if not result.ok:
            failure = f"step at {k * dt:.4f} s failed: {result.reason}"
            break
        tips.append(state.nodes[-1, :7].copy())
        if progress is not None and k % 50 == 0:
            progress(k / steps)
    rows = np.array(tips)
    quaternion = rows[:, 3:] / np.linalg.norm(rows[:, 3:], axis=1, keepdims=True)
    return Recording(
        dt * np.arange(len(rows), dtype=np.float64),
        rows[:, :3],
        quaternion,
        lambda t: np.concatenate([known(t).force, known(t).torque]),
        lambda t: (at(t).alpha, at(t).beta),
        failure,
    )


def _pick(value: float | None, default: float) -> float:
    return default if value is None else value


def _stamps(rate: float, end: float) -> list[int]:
    """Times in ns from 0 to ``end`` s at ``rate`` Hz."""
    return [round(k * 1e9 / rate) for k in range(math.floor(end * rate + 1e-9) + 1)]


def messages(scenario: Scenario, robot: Robot, recording: Recording) -> list[tuple[int, str, bytes]]:
    """(log time ns, topic, message) of a run in the order of log times, with noise, registration, lever arm
    and delay as in files.
    """
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
        reading = alpha - robot.encoders.offset.value + encoder * joint_noise.standard_normal(n)
        stamp = origin + ns
        found.append(
            (
                stamp,
                topics.JOINT_STATES,
                encode_joint_state(stamp, names, [*reading.tolist(), *beta.tolist()]),
            )
        )

    registration = from_vector(np.array(robot.tracker.registration_rotation.value))
    shift, lever = (
        np.array(robot.tracker.registration_translation.value),
        np.array(robot.tracker.lever_arm.value),
    )
    delay = robot.tracker.delay.value + scenario.tracker.delay_s
    keep = math.exp(-1.0 / (scenario.rates.tracker_hz * drift_time))
    wander = drift * tracker_noise.standard_normal(3)
    for ns in _stamps(scenario.rates.tracker_hz, end):
        t = min(max(ns * 1e-9 - delay, 0.0), end)
        p = np.array([np.interp(t, recording.t, recording.position[:, i]) for i in range(3)])
        h = np.array([np.interp(t, recording.t, recording.quaternion[:, i]) for i in range(4)])
        h /= np.linalg.norm(h)
        wander = keep * wander + drift * math.sqrt(1.0 - keep * keep) * tracker_noise.standard_normal(3)
        reported = matrix(registration) @ (p + matrix(h) @ lever) + shift + wander
        reported += position * tracker_noise.standard_normal(3)
        turned = multiply(multiply(registration, h), from_vector(rotation * tracker_noise.standard_normal(3)))
        turned /= np.linalg.norm(turned)
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


def write_recording(path: Path, scenario: Scenario, robot: Robot, recording: Recording) -> int:
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
