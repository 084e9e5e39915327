"""Errors inside tolerance, which every case has: normal with the robot file's sigmas, none beyond 2.7 sigma."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from ctr_dynamics.robot.schema import Robot

from .world import World

LIMIT_SIGMAS = 2.7


def truncated(rng: np.random.Generator, size: int | tuple[int, ...] = ()) -> Any:
    """Standard normal numbers, drawn again where beyond 2.7."""
    z = rng.standard_normal(size)
    while np.any(np.abs(z) > LIMIT_SIGMAS):
        z = np.where(np.abs(z) > LIMIT_SIGMAS, rng.standard_normal(size), z)
    return z


def draw(rng: np.random.Generator, robot: Robot) -> dict[str, Any]:
    """One draw of every tolerance, as it is written into the answer."""
    friction, tracker = robot.friction, robot.tracker
    body = robot.tubes[0].end_body
    found: dict[str, Any] = {
        "payload_added_kg": float(truncated(rng) * (body.mass.tolerance if body else 0.0)),
        "density_scale": float(1 + truncated(rng) * robot.tubes[0].density.relative),
    }
    for i, tube in enumerate(robot.tubes, 1):
        found[f"tube{i}_youngs_scale"] = float(1 + truncated(rng) * tube.youngs_modulus.relative)
        found[f"tube{i}_precurvature_scale"] = float(1 + truncated(rng) * tube.precurvature_tolerance)
    for name, quantity in (
        ("base_coulomb", friction.base.coulomb),
        ("base_viscous", friction.base.viscous),
        ("tube_coulomb", friction.tubes.coulomb),
        ("tube_viscous", friction.tubes.viscous),
    ):
        found[f"{name}_scale"] = float(1 + truncated(rng) * quantity.relative)
    found["gravity_rotation_rad"] = (truncated(rng, 3) * robot.gravity.direction_tolerance).tolist()
    for name, vector in (
        ("registration_rotation_rad", tracker.registration_rotation),
        ("registration_translation_m", tracker.registration_translation),
        ("lever_m", tracker.lever_arm),
    ):
        found[name] = (truncated(rng, 3) * np.array(vector.tolerance)).tolist()
    found["tracker_latency_s"] = float(truncated(rng) * tracker.delay.tolerance)
    found["encoder_offset_rad"] = (truncated(rng, robot.n_tubes) * robot.encoders.offset.tolerance).tolist()
    return found


def apply(draws: dict[str, Any], world: World) -> None:
    """Put a draw into the world. The shear modulus follows Young's modulus, the payload's inertia does not follow its mass."""
    machine, sensing = world.machine, world.sensing
    machine.mass[0] += draws["payload_added_kg"]
    machine.rho_a *= draws["density_scale"]
    machine.rho_i *= draws["density_scale"]
    for i in range(machine.n):
        machine.EI[i] *= draws[f"tube{i + 1}_youngs_scale"]
        machine.GJ[i] *= draws[f"tube{i + 1}_youngs_scale"]
        scale = draws[f"tube{i + 1}_precurvature_scale"]
        machine.segments[i] = [(length, u * scale) for length, u in machine.segments[i]]
    machine.mu_base *= draws["base_coulomb_scale"]
    machine.nu_base *= draws["base_viscous_scale"]
    machine.mu *= draws["tube_coulomb_scale"]
    machine.nu *= draws["tube_viscous_scale"]
    machine.gravity = Rotation.from_rotvec(draws["gravity_rotation_rad"]).apply(machine.gravity)
    sensing.rotation = sensing.rotation + draws["registration_rotation_rad"]
    sensing.translation = sensing.translation + draws["registration_translation_m"]
    sensing.lever = sensing.lever + draws["lever_m"]
    sensing.delay_s += draws["tracker_latency_s"]
    world.actuators.offset = world.actuators.offset + draws["encoder_offset_rad"]
