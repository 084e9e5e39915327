"""Truth of snaps: the angle between the markers at 50 kHz from the independent simulator of test/diagnosis/truth, with a hidden drivetrain.

It shares nothing with the finite-difference solver: Legendre polynomials of strain on each section and Radau IIA in time. By hand, from the
repository: ``PYTHONPATH=.:test/diagnosis:test/snap python -m snap_truth --seed 5 --output DIR``.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from truth import machine as mechanics
from truth.kernels import TIP, integrate
from truth.machine import Machine
from truth.nuisances import truncated

from ctr_dynamics.robot import Robot, load_robot
from ctr_dynamics.snap.experiment import robot_for_snap

ROBOT = "till2020_snap"
LENGTHS = {"fit": -0.112, "held_back": -0.1628}  # beta1 of the first two experiments of Table II, m
CELL_M = 0.004  # sections here are as short as 1 mm
RATE = 10.0  # rad/s of the base
FRAME_S = 2e-5  # of the camera
NOISE = 0.01  # rad, of an angle between two markers
BEFORE, AFTER = 0.4e-3, 6e-3  # s around theta = 4 rad that the camera keeps
CLOCK = 0.3e-3  # s, largest error of the camera's trigger


@dataclass(frozen=True)
class Hidden:
    """What the generator hides: the drive of tube 1 (N m/rad, kg m^2), and errors inside the robot file's tolerances by name."""

    stiffness: float
    inertia: float
    tolerances: dict[str, float]


def draw(seed: int, robot: Robot) -> Hidden:
    """Drive with its own frequency between 2.2 and 3.2 kHz and a stiffness of 0.15 to 0.4 N m/rad; normal errors inside tolerance."""
    rng = np.random.default_rng(seed)
    stiffness = 0.15 * (0.4 / 0.15) ** rng.uniform()
    frequency = rng.uniform(2200.0, 3200.0)
    inner, outer = robot.tubes
    sizes = {
        "youngs_1": inner.youngs_modulus.relative,
        "youngs_2": outer.youngs_modulus.relative,
        "density": inner.density.relative,
        "precurvature_1": inner.precurvature_tolerance,
        "precurvature_2": outer.precurvature_tolerance,
        "tube_coulomb": robot.friction.tubes.coulomb.relative,
        "tube_viscous": robot.friction.tubes.viscous.relative,
    }
    tolerances = {name: float(1.0 + size * truncated(rng)) for name, size in sizes.items()}
    return Hidden(stiffness, stiffness / (2.0 * np.pi * frequency) ** 2, tolerances)


def hidden_machine(robot: Robot, hidden: Hidden | None) -> Machine:
    """The robot's machine; with ``hidden``, on its drive and with its errors."""
    machine = Machine.of(robot)
    if hidden is None:
        return machine
    t = hidden.tolerances
    for i, (young, curved) in enumerate((("youngs_1", "precurvature_1"), ("youngs_2", "precurvature_2"))):
        machine.EI[i] *= t[young]
        machine.GJ[i] *= t[young]
        machine.segments[i] = [(length, u * t[curved]) for length, u in machine.segments[i]]
    machine.rho_a *= t["density"]
    machine.rho_i *= t["density"]
    machine.mu *= t["tube_coulomb"]
    machine.nu *= t["tube_viscous"]
    machine.drive[0] = hidden.stiffness, hidden.inertia
    return machine


def marker_angle(plant: mechanics.Plant, c: np.ndarray) -> float:
    """psi_L2 - psi_L1, rad: Legendre polynomials but the first integrate to nothing."""
    n, psi = len(plant.GJ), []
    for i in range(2):
        angle = c[i] + plant.straight[i] * c[n + 2 * i]
        for s, present in enumerate(plant.present):
            if i < present:
                length = plant.h[plant.first[s] : plant.first[s + 1]].sum()
                angle += length * c[plant.offset[s] + 2 * plant.nb[s] + i * plant.nt[s]]
        psi.append(angle)
    return float(psi[1] - psi[0])


def snap(
    machine: Machine, start: float, duration: float, slow: float = 0.0, step: float = FRAME_S, refine: int = 1
) -> tuple[np.ndarray, np.ndarray]:
    """t (k,) s and angles between the markers (k,) rad: at rest at theta_b = ``start``, then tube 1 turning at -RATE.

    The first ``slow`` s take steps four times as long, and are not returned.
    """
    plant, count = mechanics.plant_of(machine, refine, CELL_M)
    inputs = np.zeros(2 + mechanics.INPUTS_BEYOND_ANGLES)
    inputs[-1] = 1.0
    c = mechanics.equilibrium(plant, count, inputs)
    for theta_b in np.linspace(0.0, start, 1 + int(np.ceil(start / 0.1)))[1:]:
        inputs[0] = -theta_b
        c = mechanics.equilibrium(plant, count, inputs, c)
    v, counts, begin, t, path = np.zeros(count), np.zeros(2, dtype=np.int64), 0.0, np.empty(0), np.empty((0, 0))
    for h, end in ((4.0 * step, slow), (step, duration)):
        steps = round((end - begin) / h)
        now = np.tile(inputs, (steps, 3, 1))
        now[:, :, 0] = -start - RATE * (begin + h * (np.arange(steps)[:, None] + mechanics.RADAU.nodes))
        path, tips = np.empty((steps, count)), np.empty((steps + 1, TIP))
        done = integrate(plant, mechanics.RADAU, c, v, now, h, 1e-6, tips, counts, path)
        if done < steps:
            raise mechanics.NoMotionError(f"the step at {begin + h * done:.6f} s did not converge")
        t = begin + h * np.arange(1, steps + 1)
        begin += h * steps
    return t, np.array([marker_angle(plant, row) for row in path])
