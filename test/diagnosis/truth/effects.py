"""Hidden effects by the names, units and signs of the findings contract, each with how its size is drawn and what it does to the world.

`hidden` is the effect alone, `total` with the tolerance draw. `insertion_velocity`, the two discretisation effects and `config_mistake` are
left out: translations stand still here, and mistakes of a file are no physics.

Laws that the contract leaves open: `softening` m = EI k / sqrt(1 + (k/k0)^2) with k the strain beyond precurvature; `ovality` stiffness EI sqrt(r)
about the axis and EI / sqrt(r) about the other one; `stribeck` mu (1 + (ratio - 1) exp(-(rate/speed)^2)) for base and tubes;
`distributed_friction` torque per length on the overlap beyond the plate with the same smoothing as Coulomb friction; `backlash` a play on the
angle, from the middle; `air_drag` (a + b |v|) v per length of backbone; `contact` force k d n where d = offset - n.p > 0;
`tracker_averaging` over the window before the pose's time; `clock_skew` about the first stamp.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from ctr_dynamics.robot.schema import Robot

from . import machine as mechanics
from .motion import GRAVITY, HUNG_KG
from .world import World

Found = dict[str, dict[str, Any]]


@dataclass
class Hide:
    """What an effect's function needs: where randomness comes from, the world to change, the draw that is already in it.

    `small` asks for sizes near the lower end.
    """

    rng: np.random.Generator
    world: World
    robot: Robot
    draws: dict[str, Any]
    small: bool = False

    def size(self, low: float, high: float) -> float:
        """Log-uniform."""
        if self.small:
            high = low * math.sqrt(high / low) ** 0.5
        return float(low * (high / low) ** self.rng.uniform())

    def sign(self) -> float:
        return float(self.rng.choice([-1.0, 1.0]))

    def scale(self, low: float, high: float) -> float:
        """1 plus or minus a size."""
        return 1.0 + self.sign() * self.size(low, high)

    def tube(self) -> int:
        return int(self.rng.integers(self.world.machine.n))

    def direction(self) -> np.ndarray:
        d = self.rng.standard_normal(3)
        return d / np.linalg.norm(d)

    def youngs_draw(self, tube: int) -> float:
        return self.draws[f"tube{tube + 1}_youngs_scale"]


def _value(hidden: float, total: float, unit: str) -> dict[str, Any]:
    return {"hidden": float(hidden), "total": float(total), "unit": unit}


def _xyz(names: str, hidden: np.ndarray, total: np.ndarray, unit: str) -> Found:
    return {names.format(a): _value(h, t, unit) for a, h, t in zip("xyz", hidden, total, strict=True)}


def _which_tubes(x: Hide) -> tuple[str, list[int]]:
    """One tube, or all of them one time in four."""
    if x.rng.uniform() < 0.25:
        return "all", list(range(x.world.machine.n))
    tube = x.tube()
    return f"tube{tube + 1}", [tube]


def youngs_modulus(x: Hide) -> Found:
    name, tubes = _which_tubes(x)
    k = x.scale(0.02, 0.10)
    for i in tubes:
        x.world.machine.EI[i] *= k
        x.world.machine.GJ[i] *= k
    total = k * float(np.mean([x.youngs_draw(i) for i in tubes]))
    return {f"{name}.scale": _value(k, total, "1")}


def shear_modulus(x: Hide) -> Found:
    name, tubes = _which_tubes(x)
    k = x.scale(0.06, 0.25)
    for i in tubes:
        x.world.machine.GJ[i] *= k
    # relative to a modulus that follows the tube's Young's modulus
    return {f"{name}.scale": _value(k, k * float(np.mean([x.youngs_draw(i) for i in tubes])), "1")}


def precurvature(x: Hide) -> Found:
    i, k = x.tube(), x.scale(0.015, 0.06)
    x.world.machine.segments[i] = [(length, u * k) for length, u in x.world.machine.segments[i]]
    return {f"tube{i + 1}.scale": _value(k, k * x.draws[f"tube{i + 1}_precurvature_scale"], "1")}


def density(x: Hide) -> Found:
    name, tubes = _which_tubes(x)
    k = x.scale(0.06, 0.4)
    x.world.machine.rho_a[tubes] *= k
    x.world.machine.rho_i[tubes] *= k
    return {f"{name}.scale": _value(k, k * x.draws["density_scale"], "1")}


def exposed_length(x: Hide) -> Found:
    i, k = x.tube(), x.sign() * x.size(0.8e-3, 4e-3)
    x.world.machine.beta[i] += k
    return {f"tube{i + 1}.beta_offset_m": _value(k, k, "m")}


def payload_mass(x: Hide) -> Found:
    k = x.size(0.15e-3, 1.5e-3) * (1.0 if x.rng.uniform() < 0.7 else -1.0)
    x.world.machine.mass[0] += k
    return {"added_kg": _value(k, k + x.draws["payload_added_kg"], "kg")}


def payload_inertia(x: Hide) -> Found:
    k = x.size(1.15, 1.9) if x.rng.uniform() < 0.5 else 1.0 / x.size(1.15, 1.9)
    x.world.machine.inertia[0] *= k
    return {"scale": _value(k, k, "1")}


def base_coulomb(x: Hide) -> Found:
    k = x.size(1.25, 2.0) if x.rng.uniform() < 0.5 else 1.0 / x.size(1.25, 2.5)
    x.world.machine.mu_base *= k
    hidden = k * x.robot.friction.base.coulomb.value
    return {"mu_base": _value(hidden, hidden * x.draws["base_coulomb_scale"], "1")}


def base_viscous(x: Hide) -> Found:
    k = x.size(8e-5, 6e-4)
    total = k * x.draws["base_viscous_scale"]
    x.world.machine.nu_base = total
    return {"nu_base": _value(k, total, "N m s/rad")}


def tube_coulomb(x: Hide) -> Found:
    k = x.size(0.05, 0.6)
    total = k * x.draws["tube_coulomb_scale"]
    x.world.machine.mu = total
    return {"mu": _value(k, total, "1")}


def tube_viscous(x: Hide) -> Found:
    k = x.size(2e-5, 3e-4)
    total = k * x.draws["tube_viscous_scale"]
    x.world.machine.nu = total
    return {"nu": _value(k, total, "N m s/rad")}


def stribeck(x: Hide) -> Found:
    ratio, speed = x.size(1.5, 4.0), x.size(0.7, 6.0)
    x.world.machine.static_ratio, x.world.machine.stribeck_speed = ratio, speed
    return {"static_ratio": _value(ratio, ratio, "1"), "speed_rad_s": _value(speed, speed, "rad/s")}


def distributed_friction(x: Hide) -> Found:
    k = x.size(0.01, 0.1)
    x.world.machine.distributed_Nm_per_m = k
    return {"torque_Nm_per_m": _value(k, k, "N m/m")}


def bending_damping(x: Hide) -> Found:
    i, k = x.tube(), x.size(4e-6, 6e-5)
    x.world.machine.bend_damp[i] = k
    return {f"tube{i + 1}.B_Nm2s": _value(k, k, "N m^2 s")}


def torsion_damping(x: Hide) -> Found:
    i, k = x.tube(), x.size(2e-5, 3e-4)
    x.world.machine.twist_damp[i] = k
    return {f"tube{i + 1}.B_Nm2s": _value(k, k, "N m^2 s")}


def air_drag(x: Hide) -> Found:
    linear, quadratic = x.size(0.04, 0.4), 0.0
    if x.rng.uniform() < 0.5:
        linear, quadratic = 0.0, x.size(0.1, 1.2)
    x.world.machine.drag = (linear, quadratic)
    return {
        "linear_Ns_per_m2": _value(linear, linear, "N s/m^2"),
        "quadratic_Ns2_per_m3": _value(quadratic, quadratic, "N s^2/m^3"),
    }


def backlash(x: Hide) -> Found:
    i, k = x.tube(), x.size(0.012, 0.08)
    x.world.actuators.backlash[i] = k
    return {f"tube{i + 1}.width_rad": _value(k, k, "rad")}


def encoder_offset(x: Hide) -> Found:
    i, k = x.tube(), x.sign() * math.radians(x.size(0.6, 3.0))
    x.world.actuators.offset[i] += k
    return {f"tube{i + 1}.offset_rad": _value(k, k + x.draws["encoder_offset_rad"][i], "rad")}


def encoder_gain(x: Hide) -> Found:
    i, k = x.tube(), x.scale(0.015, 0.07)
    x.world.actuators.gain[i] *= k
    return {f"tube{i + 1}.gain": _value(k, k, "1")}


def drivetrain_compliance(x: Hide) -> Found:
    i = x.tube()
    stiffness = x.size(0.03, 0.3) if i == 0 else x.size(0.08, 0.8)
    if x.small:
        stiffness *= 3.0
    inertia = x.size(1e-7, 2e-6)
    x.world.machine.drive[i] = stiffness, inertia
    return {
        f"tube{i + 1}.stiffness_Nm_per_rad": _value(stiffness, stiffness, "N m/rad"),
        f"tube{i + 1}.inertia_kgm2": _value(inertia, inertia, "kg m^2"),
    }


def actuator_latency(x: Hide) -> Found:
    k = x.size(6e-3, 30e-3)
    x.world.actuators.latency_s = k
    return {"delay_s": _value(k, k, "s")}


def clearance(x: Hide) -> Found:
    k = x.size(0.005, 0.03)
    x.world.machine.clearance_rad = k
    return {"play_rad": _value(k, k, "rad")}


def ovality(x: Hide) -> Found:
    i, ratio, axis = x.tube(), 1.0 + x.size(0.05, 0.3), float(x.rng.uniform(0, math.pi))
    x.world.machine.EI[i] *= [math.sqrt(ratio), 1.0 / math.sqrt(ratio)]
    x.world.machine.axis[i] = axis
    return {
        f"tube{i + 1}.ratio": _value(ratio, ratio, "1"),
        f"tube{i + 1}.axis_rad": _value(axis, axis, "rad"),
    }


def registration_rotation(x: Hide) -> Found:
    k = x.direction() * math.radians(x.size(0.7, 3.0))
    x.world.sensing.rotation = x.world.sensing.rotation + k
    return _xyz("r{}_rad", k, k + x.draws["registration_rotation_rad"], "rad")


def registration_translation(x: Hide) -> Found:
    k = x.direction() * x.size(1.2e-3, 6e-3)
    x.world.sensing.translation = x.world.sensing.translation + k
    return _xyz("t{}_m", k, k + x.draws["registration_translation_m"], "m")


def gravity_direction(x: Hide) -> Found:
    # about an axis across gravity: about gravity itself nothing would change
    down = np.array(x.robot.gravity.value)
    axis = np.cross(down, x.direction())
    k = axis / np.linalg.norm(axis) * math.radians(x.size(1.2, 6.0))
    total = k + x.draws["gravity_rotation_rad"]
    x.world.machine.gravity = Rotation.from_rotvec(total).apply(down)
    return _xyz("r{}_rad", k, total, "rad")


def tip_force(x: Hide) -> Found:
    k = x.direction() * x.size(0.006, 0.05)
    x.world.disturbance.constant_N = x.world.disturbance.constant_N + k
    return _xyz("F{}_N", k, k, "N")


def _rest_tips(x: Hide) -> tuple[np.ndarray, np.ndarray]:
    """Tip at the rest angles, unloaded and with the hung weight (without its torque), m."""
    n = x.world.machine.n
    plant, count = mechanics.plant_of(x.world.machine)
    inputs = np.zeros(n + mechanics.INPUTS_BEYOND_ANGLES)
    inputs[:n] = x.robot.rest.alpha.value
    inputs[-1] = 1.0
    free = mechanics.tip_at(plant, mechanics.equilibrium(plant, count, inputs), inputs)[:3]
    inputs[n + 1] = -GRAVITY * HUNG_KG
    loaded = mechanics.tip_at(plant, mechanics.equilibrium(plant, count, inputs), inputs)[:3]
    return free.copy(), loaded.copy()


def tip_spring(x: Hide) -> Found:
    stiffness, damping = x.size(0.4, 6.0), float(x.rng.choice([0.0, x.size(3e-3, 3e-2)]))
    anchor = _rest_tips(x)[0] + x.direction() * x.rng.uniform(0.005, 0.03)
    x.world.machine.spring = (stiffness, damping, *anchor)
    return {
        "stiffness_N_per_m": _value(stiffness, stiffness, "N/m"),
        "damping_Ns_per_m": _value(damping, damping, "N s/m"),
        **_xyz("anchor_{}_m", anchor, anchor, "m"),
    }


def contact(x: Hide) -> Found:
    """A plane beside the tip at rest, on the side away from where the hung weight holds it."""
    free, loaded = _rest_tips(x)
    normal = (loaded - free) / np.linalg.norm(loaded - free) + 0.5 * x.direction()
    normal /= np.linalg.norm(normal)
    stiffness, offset = x.size(60.0, 800.0), float(normal @ free) - x.size(2e-3, 8e-3)
    x.world.machine.contact = (stiffness, *normal, offset)
    return {
        "stiffness_N_per_m": _value(stiffness, stiffness, "N/m"),
        **_xyz("n{}", normal, normal, "1"),
        "offset_m": _value(offset, offset, "m"),
    }


def tracker_latency(x: Hide) -> Found:
    k = x.size(6e-3, 30e-3)
    x.world.sensing.delay_s += k
    return {"delay_s": _value(k, k + x.draws["tracker_latency_s"], "s")}


def tracker_averaging(x: Hide) -> Found:
    k = x.size(20e-3, 80e-3)
    x.world.sensing.window_s = k
    return {"window_s": _value(k, k, "s")}


def clock_skew(x: Hide) -> Found:
    k = x.sign() * x.size(6e-4, 4e-3)
    x.world.sensing.skew = k
    return {"rate": _value(k, k, "s/s")}


def tracker_lever_arm(x: Hide) -> Found:
    k = x.direction() * x.size(1.2e-3, 6e-3)
    x.world.sensing.lever = x.world.sensing.lever + k
    return _xyz("{}_m", k, k + x.draws["lever_m"], "m")


def tracker_scale(x: Hide) -> Found:
    k = x.scale(0.012, 0.05)
    x.world.sensing.scale = k
    return {"scale": _value(k, k, "1")}


def softening(x: Hide) -> Found:
    i = x.tube()
    # under the hung weight the strain beyond precurvature reaches 9 1/m in the inner tube and 1.3 1/m in the outer one
    k = (1.0 if i == 0 else 0.15) / x.size(1 / 80.0, 1 / 20.0)
    x.world.machine.soft[i] = 1.0 / k
    return {f"tube{i + 1}.curvature_1_per_m": _value(k, k, "1/m")}


def drift(x: Hide) -> Found:
    k = x.direction() * x.size(0.08e-3, 0.5e-3)
    x.world.sensing.drift = k
    return _xyz("{}_m_per_s", k, k, "m/s")


CATALOGUE: dict[str, Callable[[Hide], Found]] = {
    f.__name__: f
    for f in (
        youngs_modulus, shear_modulus, precurvature, density, exposed_length, payload_mass, payload_inertia, base_coulomb,
        base_viscous, tube_coulomb, tube_viscous, stribeck, distributed_friction, bending_damping, torsion_damping,
        air_drag, backlash, encoder_offset, encoder_gain, drivetrain_compliance, actuator_latency, clearance, ovality,
        registration_rotation, registration_translation, gravity_direction, tip_force, tip_spring, contact, tracker_latency,
        tracker_averaging, clock_skew, tracker_lever_arm, tracker_scale, softening, drift,
    )
}  # fmt: skip


# Outside the catalogue: nothing in it has such a signature.


def pulse(x: Hide) -> str:
    """A periodic force on the tip."""
    force, frequency = x.direction() * x.size(0.02, 0.08), x.rng.uniform(0.5, 1.6)
    phase = x.rng.uniform(0, 2 * math.pi)

    def at(t: np.ndarray) -> np.ndarray:
        return force * np.sin(2 * math.pi * frequency * t + phase)[..., None]

    x.world.disturbance.force = at
    return f"tip force {np.round(force, 4).tolist()} N at {frequency:.3f} Hz"


def pendulum(x: Hide) -> str:
    """A second payload that swings from the tip on a stiff string."""
    mass, length = x.size(0.6e-3, 2e-3), x.rng.uniform(0.03, 0.10)
    x.world.machine.bob = (mass, length, 60.0, 0.02)
    return f"a bob of {mass * 1e3:.2f} g swinging {length * 1e3:.0f} mm below the tip"


def collar_slip(x: Hide) -> str:
    """The inner tube slips in its collar, unseen by its encoder, and wanders a little after that."""
    angle, begin = x.sign() * x.size(0.05, 0.2), x.rng.uniform(2.5, 7.5)
    wander, rate = 0.25 * angle, x.rng.uniform(0.15, 0.35)

    def at(t: np.ndarray) -> np.ndarray:
        after = np.clip((t - begin) / 0.05, 0.0, 1.0)
        share = after * after * (3 - 2 * after)
        return share * (angle + wander * np.sin(2 * math.pi * rate * (t - begin)))

    x.world.actuators.slip = at
    return f"inner tube slips by {angle:.4f} rad in its collar at {begin:.2f} s, then wanders"


def glitches(x: Hide) -> str:
    """Bursts of displaced tracker readings."""
    size, per_second = x.size(2e-3, 8e-3), x.rng.uniform(0.3, 0.8)

    def at(rng: np.random.Generator, t: np.ndarray) -> np.ndarray:
        out = np.zeros((len(t), 3))
        for _ in range(max(2, rng.poisson(per_second * t[-1]))):
            begin, lasts = rng.uniform(0.2, t[-1] - 0.3), rng.uniform(0.1, 0.5)
            during = (t >= begin) & (t < begin + lasts)
            out[during] += rng.standard_normal(3) * size + rng.standard_normal((during.sum(), 3)) * 0.3 * size
        return out

    x.world.sensing.glitch = at
    return f"tracker bursts of about {size * 1e3:.1f} mm, {per_second:.2f} a second"


def stiffening(x: Hide) -> str:
    """All moduli rise slowly while the experiment runs."""
    rate, bend = x.size(0.004, 0.012), x.rng.uniform(4.0, 9.0)

    def at(t: np.ndarray) -> np.ndarray:
        # rises, then holds
        return 1.0 + rate * bend * np.tanh(t / bend)

    x.world.disturbance.stiffening = at
    return f"all moduli rise by {100 * rate:.2f} % a second at first, slower after {bend:.1f} s"


def plate_vibration(x: Hide) -> str:
    """The base plate vibrates sideways."""
    size, frequency = x.size(0.4e-3, 1.2e-3), x.rng.uniform(1.5, 9.0)
    angle = x.rng.uniform(0, 2 * math.pi)
    across = np.array([math.cos(angle), math.sin(angle), 0.0]) * size
    w = 2 * math.pi * frequency

    def at(t: np.ndarray) -> np.ndarray:
        s = (1 - np.cos(w * t))[..., None] * across
        return np.concatenate(
            [s, w * np.sin(w * t)[..., None] * across, w * w * np.cos(w * t)[..., None] * across], axis=-1
        )

    x.world.disturbance.base = at
    return f"plate vibrates {size * 1e3:.2f} mm at {frequency:.2f} Hz"


OUTSIDE: dict[str, Callable[[Hide], str]] = {
    f.__name__: f for f in (pulse, pendulum, collar_slip, glitches, stiffening, plate_vibration)
}

# Effect to a rival with nearly its signature; hidden small in near-tie cases.
NEAR_TIES = (
    ("density", "payload_mass"),
    ("payload_mass", "density"),
    ("shear_modulus", "drivetrain_compliance"),
    ("drivetrain_compliance", "shear_modulus"),
    ("gravity_direction", "tip_force"),
    ("tip_force", "gravity_direction"),
    ("base_viscous", "bending_damping"),
    ("bending_damping", "air_drag"),
    ("tracker_averaging", "tracker_latency"),
    ("clearance", "softening"),
    ("exposed_length", "youngs_modulus"),
)

# Effects that leave a robot at rest, unloaded and still, where it is.
UNSEEN_AT_REST = (
    "base_coulomb", "base_viscous", "tube_coulomb", "tube_viscous", "stribeck", "distributed_friction", "bending_damping",
    "torsion_damping", "air_drag", "backlash", "payload_inertia", "actuator_latency", "tracker_latency",
    "tracker_averaging",
)  # fmt: skip
