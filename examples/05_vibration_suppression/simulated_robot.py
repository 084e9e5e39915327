"""A simulated robot without ROS: the dynamic model with other parameters than the robot file's, drives, encoders, tracker and a weight.

It is what the estimator and the controller do not know exactly: moduli, payload, friction and tracker delay differ, the drives answer late,
and everything that is measured is noisy.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.io.messages import topics
from ctr_dynamics.io.messages.encode import encode_joint_state, encode_pose_stamped, encode_wrench_stamped
from ctr_dynamics.kernels.rotations import from_vector, matrix, multiply
from ctr_dynamics.model.model import Model
from ctr_dynamics.model.simulator import Inputs, Simulator
from ctr_dynamics.model.statics import Statics
from ctr_dynamics.model.time_scheme import make_scheme
from ctr_dynamics.robot import Robot
from ctr_dynamics.robot_files import robot_quantities, robot_with

Floats = NDArray[np.float64]
DT_NS = 3_000_000
MISTAKES = {
    "tubes[0].youngs_modulus": 1.02, "tubes[1].youngs_modulus": 0.98, "tubes[0].end_body.mass": 1.03, "friction.base.coulomb": 0.8,
    "friction.base.viscous": 0.8, "friction.tubes.coulomb": 1.3, "tubes[1].precurvature[1].curvature": 1.005,
}  # fmt: skip


@dataclass(frozen=True)
class Hardware:
    """Drives, sensors and the weight.

    Attributes:
        dead_time_s, lag_s: of the drives; max_rate: rad/s.
        tracker_latency_s: from stamp to arrival; tracker_delay_s: how much older than its stamp a pose is.
        weight_kg, below_tip_m: hangs that far beyond the tip along the tangent until `release_s`, cut within 10 ms.
        joint_outage_s: (from, to) in which the driver sends no joints.
    """

    dead_time_s: float = 0.008
    lag_s: float = 0.010
    max_rate: float = 3.0
    tracker_latency_s: float = 0.010
    tracker_delay_s: float = 0.002
    weight_kg: float = 0.06
    below_tip_m: float = 0.0336
    release_s: float = 1.0
    joint_outage_s: tuple[float, float] = (0.0, 0.0)
    joints_hz: float = 100.0
    tracker_hz: float = 40.0


def real_robot(robot: Robot) -> Robot:
    """The robot as it is: `MISTAKES` times what its file says, where the file has that parameter."""
    known = robot_quantities(robot)
    values = {}
    for path, factor in MISTAKES.items():
        if path in known:
            value = known[path].value
            values[path] = [factor * v for v in value] if isinstance(value, tuple) else factor * value
    return robot_with(robot, values)


@dataclass
class Truth:
    """What really happened: t (s), tip (3,) m, angle delta of the drives (rad)."""

    t: list[float] = field(default_factory=list)
    tip: list[Floats] = field(default_factory=list)
    delta: list[float] = field(default_factory=list)


class SimulatedRobot:
    """Robot, drives and sensors on a time of their own that begins at 0.

    Args:
        robot: as its file says; the plant itself uses `real_robot`.
        start_ns: stamp of time 0.
    """

    def __init__(self, robot: Robot, start_ns: int, hardware: Hardware | None = None, seed: int = 1) -> None:
        self.file, self.start_ns, self.hardware = robot, start_ns, hardware or Hardware()
        self.model = Model(real_robot(robot), nodes=24)
        self.simulator = Simulator(self.model, make_scheme("sdirk3", DT_NS * 1e-9))
        self.truth = Truth()
        self._random = np.random.default_rng(seed)
        self._alpha0, self._beta = np.array(robot.rest.alpha.value), np.array(robot.rest.beta.value)
        self._delta = self._rate = 0.0
        self._commands: deque[tuple[float, float]] = deque()
        self._target = 0.0
        self._wrench = self._hung()
        self._state = self.simulator.rest(self._inputs(0.0))
        self._k = 0
        self._due = dict.fromkeys((topics.JOINT_STATES, topics.TRACKER_TIP, topics.TIP_LOAD), 0)
        self._late: deque[tuple[int, str, bytes]] = deque()
        self._drift = np.zeros(3)
        self._past: deque[tuple[float, Floats, Floats]] = deque(maxlen=20)

    @property
    def t(self) -> float:
        """Time in s."""
        return self._k * DT_NS * 1e-9

    def send(self, t: float, delta: float) -> None:
        """A command that leaves the controller at `t` s."""
        if math.isfinite(delta):
            self._commands.append((t + self.hardware.dead_time_s, delta))

    def step(self) -> list[tuple[str, bytes]]:
        """Advance by 3 ms; returns the messages that arrive meanwhile.

        Raises:
            RuntimeError: the model could not take the step.
        """
        t, h = self.t, DT_NS * 1e-9
        begin = self._delta
        self._drive(t, h)
        rate = (self._delta - begin) / h
        end = self._delta

        def inputs(when: float) -> Inputs:
            share = (when - t) / h
            return self._inputs(when, begin + share * (end - begin), rate)

        result = self.simulator.step(self._state, t, inputs)
        if not result.ok:
            raise RuntimeError(f"the simulated robot cannot step at {t:.3f} s: {result.reason}")
        self._k += 1
        tip = self._state.nodes[-1, :3].copy()
        h4 = self._state.nodes[-1, 3:7]
        self._past.append((self.t, tip, h4 / np.linalg.norm(h4)))
        self.truth.t.append(self.t)
        self.truth.tip.append(tip)
        self.truth.delta.append(self._delta)
        return self._messages()

    def _drive(self, t: float, h: float) -> None:
        """First-order lag with a rate limit behind a dead time."""
        while self._commands and self._commands[0][0] <= t:
            self._target = self._commands.popleft()[1]
        change = (self._target - self._delta) * (1.0 - math.exp(-h / self.hardware.lag_s))
        limit = self.hardware.max_rate * h
        self._delta += max(-limit, min(limit, change))

    def _inputs(self, t: float, delta: float = 0.0, rate: float = 0.0) -> Inputs:
        n = self.model.n
        wrench = self._load(t)
        return Inputs(self._alpha0 + delta, np.full(n, rate), self._beta, np.zeros(n), wrench[:3], wrench[3:])

    def _load(self, t: float) -> Floats:
        """Wrench of the weight (6,) N, N m."""
        return self._wrench * float(np.clip(1.0 - (t - self.hardware.release_s) / 0.01, 0.0, 1.0))

    def _hung(self) -> Floats:
        """Weight beyond the tip: its torque follows the tangent of the equilibrium under it."""
        wrench = np.zeros(6)
        wrench[:3] = self.hardware.weight_kg * np.array(self.file.gravity.value)
        statics = Statics(self.model)
        for _ in range(60):
            found = statics.solve(self._beta, self._alpha0, wrench[:3], wrench[3:])
            arm = self.hardware.below_tip_m * matrix(found.tip_quaternion)[:, 2]
            wrench[3:] += 0.6 * (np.cross(arm, wrench[:3]) - wrench[3:])
        return wrench

    def _messages(self) -> list[tuple[str, bytes]]:
        t, stamp = self.t, self.start_ns + self._k * DT_NS
        hardware, noise = self.hardware, self.file.tracker.noise
        found: list[tuple[str, bytes]] = []
        if self._is_due(topics.JOINT_STATES, hardware.joints_hz):
            first, last = hardware.joint_outage_s
            if not first <= t < last:
                found.append((topics.JOINT_STATES, self._joints(stamp)))
        if self._is_due(topics.TIP_LOAD, 100.0):
            wrench = self._load(t)
            found.append(
                (
                    topics.TIP_LOAD,
                    encode_wrench_stamped(stamp, "ctr_base", wrench[:3].tolist(), wrench[3:].tolist()),
                )
            )
        if self._is_due(topics.TRACKER_TIP, hardware.tracker_hz):
            when = t - hardware.tracker_delay_s
            times = [item[0] for item in self._past]
            p = np.array([np.interp(when, times, [item[1][i] for item in self._past]) for i in range(3)])
            keep = math.exp(-1.0 / (hardware.tracker_hz * noise.drift_time.value))
            self._drift = keep * self._drift + noise.drift.value * math.sqrt(
                1 - keep**2
            ) * self._random.standard_normal(3)
            p += self._drift + noise.position.value * self._random.standard_normal(3)
            turn = from_vector(noise.rotation.value * self._random.standard_normal(3))
            q = multiply(self._past[-1][2], turn)
            data = encode_pose_stamped(stamp, "ctr_base", p.tolist(), q[[1, 2, 3, 0]].tolist())
            self._late.append((stamp + round(hardware.tracker_latency_s * 1e9), topics.TRACKER_TIP, data))
        while self._late and self._late[0][0] <= stamp:
            found.append(self._late.popleft()[1:])
        return found

    def _is_due(self, topic: str, rate: float) -> bool:
        if self.t * rate < self._due[topic] - 1e-9:
            return False
        self._due[topic] += 1
        return True

    def _joints(self, stamp: int) -> bytes:
        n, sigma = self.model.n, self.file.encoders.noise.value
        alpha = self._alpha0 + self._delta + sigma * self._random.standard_normal(n)
        names = [f"tube{i}_{kind}" for kind in ("rotation", "translation") for i in range(1, n + 1)]
        return encode_joint_state(stamp, names, [*alpha.tolist(), *self._beta.tolist()])


def settling_time(truth: Truth, release_s: float, band_m: float, axis: int = 1) -> float:
    """Time after the release from which the tip stays within `band_m` of its last second's mean along `axis`, s."""
    t, tip = np.array(truth.t), np.array(truth.tip)[:, axis]
    centre = float(np.mean(tip[t > t[-1] - 1.0]))
    outside = np.flatnonzero((np.abs(tip - centre) > band_m) & (t > release_s))
    return float(t[outside[-1]] - release_s) if len(outside) else 0.0
