"""One hidden truth: the machine, what drives and disturbs it, how it is sensed; and the run of a motion through it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from scipy.optimize import root
from scipy.spatial.transform import Rotation

from ctr_dynamics.robot.schema import Robot

from . import machine as mechanics
from .machine import Machine
from .motion import GRAVITY, HUNG_BELOW_TIP_M, Motion, play

STEP_S = 1.25e-3  # divides the times of the cut and of the corners of the triangle
Floats = np.ndarray


@dataclass
class Actuators:
    """From reading to the angle that turns the tube: gain * reading + offset, delayed, through the gear's play."""

    gain: Floats
    offset: Floats  # rad
    latency_s: float = 0.0
    backlash: Floats = field(default_factory=lambda: np.zeros(0))  # rad
    slip: Callable[[Floats], Floats] | None = None  # t (...) to rad of tube 1, unseen by its encoder

    def true_angles(self, motion: Motion, t: Floats) -> Floats:
        """(..., N) at ascending times t."""
        angles = self.gain * motion.angles(t - self.latency_s) + self.offset
        for tube, width in enumerate(self.backlash):
            if width > 0:
                angles[..., tube] = play(angles[..., tube].ravel(), width).reshape(t.shape)
        if self.slip is not None:
            angles[..., 0] += self.slip(t)
        return angles


@dataclass
class Sensing:
    """The tracker: reading = R (scale (p + R_tip lever)) + translation + drift t, of the pose `delay_s` before, averaged over the
    `window_s` before that; stamps run at 1 + skew.
    """

    rotation: Floats  # (3,) rotation vector
    translation: Floats  # (3,) m
    lever: Floats  # (3,) m in the tip frame
    delay_s: float
    window_s: float = 0.0
    skew: float = 0.0
    scale: float = 1.0
    drift: Floats = field(default_factory=lambda: np.zeros(3))  # m/s
    # (rng, t (n,)) to (n, 3) m on top of the readings
    glitch: Callable[[np.random.Generator, Floats], Floats] | None = None


@dataclass(frozen=True)
class Law:
    """A force on the tip that follows from its state: `force` takes position, velocity and remembered position (k, 3) in base axes, m and m/s, and
    the tubes' angles (k, N), and gives (k, 3) N. What is remembered follows the position with the delay `memory_s`.
    """

    force: Callable[[Floats, Floats, Floats, Floats], Floats]
    memory_s: float = 1.0


@dataclass
class Disturbance:
    """What acts beside the known load, as functions of time."""

    constant_N: Floats = field(default_factory=lambda: np.zeros(3))
    force: Callable[[Floats], Floats] | None = None  # t (...) to (..., 3) N on the tip
    base: Callable[[Floats], Floats] | None = None  # t (...) to (..., 9): m, m/s, m/s^2 of the plate
    stiffening: Callable[[Floats], Floats] | None = None  # t (...) to the factor of all moduli
    law: Law | None = None


@dataclass
class World:
    """Everything that is true."""

    machine: Machine
    actuators: Actuators
    sensing: Sensing
    disturbance: Disturbance = field(default_factory=Disturbance)

    @classmethod
    def of(cls, robot: Robot) -> World:
        """The world as the robot file has it."""
        n, tracker = robot.n_tubes, robot.tracker
        return cls(
            Machine.of(robot),
            Actuators(np.ones(n), np.full(n, robot.encoders.offset.value), backlash=np.zeros(n)),
            Sensing(
                np.array(tracker.registration_rotation.value),
                np.array(tracker.registration_translation.value),
                np.array(tracker.lever_arm.value),
                tracker.delay.value,
            ),
        )


@dataclass
class Run:
    """A motion carried out: tip state every `step_s` from 0 on, and the known load before the cut."""

    motion: Motion
    step_s: float
    position: Floats  # (n, 3) m, base frame
    rotation: Floats  # (n, 3, 3)
    velocity: Floats  # (n, 3) m/s
    omega: Floats  # (n, 3) rad/s, base axes
    wrench: Floats  # (6,) N and N m about the tip point, base axes

    def pose(self, t: Floats) -> tuple[Floats, Floats]:
        """Position (n, 3) and rotation (n, 3, 3) at times t (n,), the first before 0 and the last after the end."""
        last = len(self.position) - 1
        x = np.clip(np.asarray(t) / self.step_s, 0.0, last)
        k = np.minimum(x.astype(int), last - 1)
        f = (x - k)[:, None]
        h = self.step_s
        # cubic Hermite
        p = (
            (1 + 2 * f) * (1 - f) ** 2 * self.position[k]
            + f**2 * (3 - 2 * f) * self.position[k + 1]
            + h * (f * (1 - f) ** 2 * self.velocity[k] - f**2 * (1 - f) * self.velocity[k + 1])
        )
        first = Rotation.from_matrix(self.rotation[k])
        whole = (Rotation.from_matrix(self.rotation[k + 1]) * first.inv()).as_rotvec()
        turned = f**2 * (3 - 2 * f) * whole + h * (
            f * (1 - f) ** 2 * self.omega[k] - f**2 * (1 - f) * self.omega[k + 1]
        )
        return p, (Rotation.from_rotvec(turned) * first).as_matrix()


def _inputs(world: World, motion: Motion, t: Floats, wrench: Floats) -> Floats:
    """(..., N + 16) inputs of the machine at ascending times t (...)."""
    n, disturbance = world.machine.n, world.disturbance
    inputs = np.zeros((*t.shape, n + mechanics.INPUTS_BEYOND_ANGLES))
    inputs[..., :n] = world.actuators.true_angles(motion, t)
    inputs[..., n : n + 6] = motion.load_share(t)[..., None] * wrench
    inputs[..., n : n + 3] += disturbance.constant_N
    if disturbance.force is not None:
        inputs[..., n : n + 3] += disturbance.force(t)
    if disturbance.base is not None:
        inputs[..., n + 6 : n + 15] = disturbance.base(t)
    inputs[..., n + 15] = 1.0 if disturbance.stiffening is None else disturbance.stiffening(t)
    return inputs


def carry_out(world: World, motion: Motion, step_s: float = STEP_S, refine: int = 1) -> Run:
    """Run `motion` from rest in the equilibrium of its first inputs.

    The torque of the hung weight about the tip is that of the loaded equilibrium, held until the cut.

    Raises:
        NoMotionError: the equations could not be solved.
    """
    plant, count = mechanics.plant_of(world.machine, refine)
    wrench = np.zeros(6)
    wrench[1] = -GRAVITY * motion.hung_kg
    c, law, n = None, world.disturbance.law, world.machine.n
    for _ in range(60 if motion.hung_kg else 1):
        start = _inputs(world, motion, np.zeros(1), wrench)[0]
        if law is not None:
            start[n : n + 3] += _force_at_rest(plant, count, start, law)
        c = mechanics.equilibrium(plant, count, start, c)
        if not motion.hung_kg:
            break
        tangent = mechanics.tip_at(plant, c, start)[[5, 8, 11]]
        torque = np.cross(HUNG_BELOW_TIP_M * tangent, wrench[:3])
        change = torque - wrench[3:]
        wrench[3:] += 0.7 * change
        if np.abs(change).max() < 1e-10:
            break
    t = mechanics.stage_times(motion.duration_s, step_s)
    inputs = _inputs(world, motion, t, wrench)
    tips = mechanics.run(plant, c, inputs, step_s) if law is None else _follow(plant, c, inputs, step_s, law)
    return Run(
        motion, step_s, tips[:, :3], tips[:, 3:12].reshape(-1, 3, 3), tips[:, 12:15], tips[:, 15:], wrench
    )


def _force_at_rest(plant: mechanics.Plant, count: int, inputs: Floats, law: Law) -> Floats:
    """Force (3,) of `law` in the equilibrium that it makes itself."""
    n = len(plant.GJ)
    begin = mechanics.equilibrium(plant, count, inputs)

    def missed(force: Floats) -> Floats:
        loaded = inputs.copy()
        loaded[n : n + 3] += force
        p = mechanics.tip_at(plant, mechanics.equilibrium(plant, count, loaded, begin), loaded)[None, :3]
        return law.force(p, np.zeros((1, 3)), p, inputs[None, :n])[0] - force

    return root(missed, np.zeros(3), tol=1e-10).x


WINDOW = 16  # steps over which force and motion are iterated


def _follow(plant: mechanics.Plant, c: Floats, inputs: Floats, step_s: float, law: Law) -> Floats:
    """Tip states of a run with the force of `law` at the stages: window after window, the force of the last motion until both agree."""
    n, nodes = len(plant.GJ), mechanics.RADAU.nodes
    c, v = c.copy(), np.zeros(len(c))
    tips = [mechanics.tip_at(plant, c, inputs[0, 0])]
    memory = tips[0][:3].copy()
    ends = [law.force(tips[0][None, :3], np.zeros((1, 3)), memory[None], inputs[0, :1, :n])[0]]
    for begin in range(0, len(inputs), WINDOW):
        now = inputs[begin : begin + WINDOW].copy()
        count = len(now)
        force = np.tile(ends[-1], (count + 1, 1))
        for _ in range(12):
            share = (np.arange(count)[:, None] + nodes).ravel()
            at_stages = np.stack([np.interp(share, np.arange(count + 1), f) for f in force.T], axis=1)
            given = now.copy()
            given[..., n : n + 3] += at_stages.reshape(count, 3, 3)
            cc, vv = c.copy(), v.copy()
            found = mechanics.run(plant, cc, given, step_s, start=(cc, vv))
            z = [memory]
            for a, b in zip(found[:-1, :3], found[1:, :3], strict=True):
                z.append(z[-1] + (1.0 - np.exp(-step_s / law.memory_s)) * (0.5 * (a + b) - z[-1]))
            angles = np.concatenate([now[:1, 0, :n], now[:, -1, :n]])
            new = law.force(found[:, :3], found[:, 12:15], np.array(z), angles)
            new[0] = ends[-1]
            change = np.abs(new - force).max()
            force = new
            if change < 1e-6:
                break
        c, v, memory = cc, vv, z[-1]
        ends.append(force[-1])
        tips.extend(found[1:])
    return np.array(tips)
