"""Truth of snaps: the angle between the markers at 50 kHz from the independent simulator of test/diagnosis/truth, with a hidden drivetrain.

It shares nothing with the finite-difference solver: Legendre polynomials of strain on each section and Radau IIA in time. By hand, from the
repository: ``PYTHONPATH=.:test/diagnosis:test/snap python -m snap_truth --seed 5 --output DIR``.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from truth import machine as mechanics
from truth.kernels import TIP, integrate
from truth.machine import Machine
from truth.nuisances import truncated

from ctr_dynamics.robot import Robot
from ctr_dynamics.robot_files import load_robot
from ctr_dynamics.snap.experiment import robot_for_snap
from ctr_dynamics.snap.features import crossing
from ctr_dynamics.snap.scurve import s_curve

ROBOT = "till2020_snap"
LENGTHS = {"fit": -0.112, "held_back": -0.1628}  # beta1 of the first two experiments of Table II, m
RATE = 10.0  # rad/s, of the base
FRAME_S = 2e-5  # of the camera
NOISE = 0.01  # rad, of an angle between two markers
BEFORE, AFTER = 0.4e-3, 5e-3  # s around theta_f = 4 rad that are kept
MARGIN = 0.006  # rad before the fold at which the base starts
SLOW_S = 2.4e-3  # from there on nothing happens yet
CELL_M = 0.004  # sections here are as short as 1 mm
ZERO = 0.01  # rad, error of the markers' zero


@dataclass(frozen=True)
class Hidden:
    """What the generator hides: the drive of tube 1, and errors inside tolerance.

    Attributes:
        stiffness_Nm_per_rad, inertia_kgm2: of the drive.
        factors: on the robot file's values, by name. zero_rad: added to every angle.
    """

    stiffness_Nm_per_rad: float
    inertia_kgm2: float
    factors: dict[str, float]
    zero_rad: float


def draw(seed: int, robot: Robot) -> Hidden:
    """A drive of 0.15 to 0.4 N m/rad that swings by itself at 2.0 to 2.5 kHz; normal errors with the robot file's deviations."""
    rng = np.random.default_rng(seed)
    stiffness = 0.15 * (0.4 / 0.15) ** rng.uniform()
    frequency = rng.uniform(2000.0, 2500.0)
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
    factors = {name: float(1.0 + size * truncated(rng)) for name, size in sizes.items()}
    zero = float(ZERO * truncated(rng))
    return Hidden(stiffness, stiffness / (2.0 * np.pi * frequency) ** 2, factors, zero)


def hidden_machine(robot: Robot, hidden: Hidden) -> Machine:
    """The robot's machine on its drive and with its errors."""
    machine, factor = Machine.of(robot), hidden.factors
    for i in range(2):
        machine.EI[i] *= factor[f"youngs_{i + 1}"]
        machine.GJ[i] *= factor[f"youngs_{i + 1}"]
        bent = factor[f"precurvature_{i + 1}"]
        machine.segments[i] = [(length, u * bent) for length, u in machine.segments[i]]
    machine.rho_a *= factor["density"]
    machine.rho_i *= factor["density"]
    machine.mu *= factor["tube_coulomb"]
    machine.nu *= factor["tube_viscous"]
    machine.drive[0] = hidden.stiffness_Nm_per_rad, hidden.inertia_kgm2
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
    for theta_b in np.linspace(0.0, start, 1 + int(np.ceil(start / 0.3)))[1:]:
        inputs[0] = -theta_b
        c = mechanics.equilibrium(plant, count, inputs, c)
    v, counts, begin, t, path = (
        np.zeros(count),
        np.zeros(2, dtype=np.int64),
        0.0,
        np.empty(0),
        np.empty((0, 0)),
    )
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


def fold(robot: Robot, hidden: Hidden) -> float:
    """theta_b (rad) at which the drive's tube snaps."""
    drive = {"tube1.stiffness_Nm_per_rad": hidden.stiffness_Nm_per_rad}
    robot = robot.model_copy(update={"extensions": {"drivetrain_compliance": drive}})
    found = s_curve(robot, np.array(robot.rest.beta.value), points=80, last=2.8, nodes=24).snap
    assert found is not None
    return found[0]


def record(seed: int, folder: Path) -> Hidden:
    """Write ``NAME.csv`` of both snaps, ``snaps.json`` about them and the sealed ``answer.json``; the same seed gives the same bytes.

    The camera's clock starts at its first frame, BEFORE + AFTER s long, somewhere around the snap.
    """
    folder.mkdir(parents=True, exist_ok=True)
    hidden = draw(seed, load_robot(ROBOT))
    snaps = []
    for number, (name, beta1) in enumerate(LENGTHS.items()):
        rng = np.random.default_rng([seed, number])
        robot = robot_for_snap(load_robot(ROBOT), {"beta1": beta1})
        start = fold(robot, hidden) - MARGIN
        t, theta = snap(hidden_machine(robot, hidden), start, 12e-3, SLOW_S)
        crossed = crossing(t, theta)
        assert crossed is not None
        assert t[0] < crossed - BEFORE
        assert crossed + AFTER < t[-1]
        kept = (t > crossed - BEFORE) & (t < crossed + AFTER)
        measured = theta[kept] + hidden.zero_rad + NOISE * rng.standard_normal(kept.sum())
        rows = [f"{x:.6f},{y:.5f}" for x, y in zip(FRAME_S * np.arange(kept.sum()), measured, strict=True)]
        (folder / f"{name}.csv").write_text("\n".join(["t_s,theta_f", *rows]) + "\n")
        snaps.append(
            {
                "file": f"{name}.csv",
                "beta1_m": beta1,
                "rate_rad_s": RATE,
                "theta_b_rad": round(start + RATE * crossed, 5),
                "noise_rad": NOISE,
            }
        )
    (folder / "snaps.json").write_text(json.dumps({"robot": ROBOT, "snaps": snaps}, indent=1) + "\n")
    answer = {"seed": seed, "cause": "drivetrain_compliance", **asdict(hidden)}
    (folder / "answer.json").write_text(json.dumps(answer, indent=1) + "\n")
    return hidden


if __name__ == "__main__":
    parser = argparse.ArgumentParser(prog="snap_truth", description=__doc__)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--output", type=Path, required=True, metavar="DIR")
    options = parser.parse_args()
    record(options.seed, options.output)
