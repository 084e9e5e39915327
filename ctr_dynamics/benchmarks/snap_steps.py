"""Cost of the finite-difference solver on the published snap example."""

from __future__ import annotations

from typing import Any

import numpy as np

from ctr_dynamics.benchmarks.machine_info import best_of
from ctr_dynamics.kernels.snap_jacobian import back_solve, factorise
from ctr_dynamics.kernels.snap_residual import residual
from ctr_dynamics.robot_files import load_robot
from ctr_dynamics.snap.experiment import Plan, run
from ctr_dynamics.snap.solver import SnapSolver

PUBLISHED_MS = (63.0, 130.0)  # a step of the authors' published program on machines of this kind


def snap_cost(quick: bool) -> dict[str, Any]:
    """Cost of a 10 us step through the snap (or its first ms), and of its parts, in ms; ``failure`` empty unless the run ended early."""
    robot = load_robot("till2020_snap_example")
    motion = run(robot, Plan(3.56, duration=1e-3 if quick else 12e-3))
    beta = np.array(robot.rest.beta.value)
    solver = SnapSolver(robot, beta)
    solver.approach(np.array([-3.0, 0.0]))
    arrays, work, x, par, c0 = solver.grid.arrays, solver.work, solver.x, solver.parameters, 1.5e5
    repeats = 3 if quick else 20
    return {
        "unknowns": motion.unknowns,
        "dt_s": 1e-5,
        "steps": len(motion.t),
        "step_ms": 1e3 * motion.wall_s / max(len(motion.t), 1),
        "step_cpu_ms": 1e3 * motion.cpu_s / max(len(motion.t), 1),
        "iterations_per_step": float(motion.iterations.mean()),
        "jacobians_per_step": float(motion.jacobians.mean()),
        "residual_ms": 1e3 * best_of(lambda: residual(arrays, x, par, c0, work), repeats),
        "jacobian_ms": 1e3 * best_of(lambda: factorise(arrays, x, par, c0, work, *solver.scratch), repeats),
        "back_solve_ms": 1e3 * best_of(lambda: back_solve(arrays, work, work.error, work.step), repeats),
        "published_program_ms": list(PUBLISHED_MS),
        "failure": motion.failure,
    }
