"""A dry run of the estimator before the first message, so that nothing is compiled while steps are due."""

from __future__ import annotations

import math

from ctr_dynamics.estimation.estimator import Estimator
from ctr_dynamics.estimation.monitoring.statuses import all_statuses
from ctr_dynamics.parameters import Settings
from ctr_dynamics.robot import Robot
from ctr_dynamics.runtime.garbage_collection import rare_garbage_collection
from ctr_dynamics.runtime.step_encoder import StepEncoder

START_NS = 1_000_000_000_000
JOINT_PERIOD_NS = 10_000_000
TICKS = 72
BUSY = range(40, 66)  # ticks in which there is no time for corrections, until steps have to wait for them
# ticks in which the tracker shows what the model does not explain, so that the columns follow every step
PUSHED = range(30, 66)
PUSH, SWING = 2e-3, 0.3  # m; rad per tick: slow enough to be taken for a force
JUMP_AT, JUMP = 20, 10.0  # tick of the jump, and times the change of a load for which a step is divided


def _no_time() -> float:
    return 0.0


@rare_garbage_collection()  # compiling makes millions of objects and keeps them
def warm_up(robot: Robot, settings: Settings) -> int:
    """Run another estimator near the robot's rest position with every kind of input; returns how many steps.

    The actuators turn and slide a little, a load comes and goes, and jumps once, so that a step is divided, and the tracker reports the predicted
    tip, now and then late enough to be fused by roll-back. For a while it contradicts the model, and corrections are put off for as long as they
    may be: memory is then nearly what it will be at most. In the end each run takes a step by itself, and the rescue of a hard one.
    """
    estimator = Estimator(robot, settings)
    encoder = StepEncoder(settings["output.frame_id"], robot.name)
    names = [f"tube{n}_{kind}" for n in range(1, robot.n_tubes + 1) for kind in ("rotation", "translation")]
    rest = list(zip(robot.rest.alpha.value, robot.rest.beta.value, strict=True))
    steps = 0
    for tick in range(TICKS):
        stamp_ns = START_NS + tick * JOINT_PERIOD_NS
        motion = 0.5 * (1.0 - math.cos(2.0 * math.pi * tick / TICKS))
        positions = [x for alpha, beta in rest for x in (alpha + 0.02 * motion, beta - 2e-4 * motion)]
        estimator.add_joint_state(stamp_ns, names, positions)
        force = 1e-3 * motion + (JUMP * estimator.model.load_slope_limit[1] if tick == JUMP_AT else 0.0)
        estimator.add_tip_load(stamp_ns, (0.0, -float(force), 0.0), (0.0, 0.0, 0.0))
        spare_s = _no_time if tick in BUSY else None
        steps_now = estimator.advance(stamp_ns + JOINT_PERIOD_NS // 2, spare_s)
        steps += len(steps_now)
        for out in steps_now:
            encoder.encode(out, lambda: all_statuses(estimator.health))
        if tick not in BUSY:
            estimator.do_idle_work()
        if steps_now and steps_now[-1].valid:
            out = steps_now[-1]
            w, *xyz = out.predicted_quaternion_wxyz.tolist()
            age_ns = JOINT_PERIOD_NS if tick % 3 else 4 * JOINT_PERIOD_NS
            x, y, z = out.predicted_position.tolist()
            beside = PUSH * math.sin(SWING * tick) if tick in PUSHED else 0.0
            estimator.add_tracker_pose(out.stamp_ns - age_ns, (x + beside, y, z), (*xyz, w))
    if estimator.runs.running:
        estimator.runs.apart(estimator.k + 1, [], record=True)
        estimator.runs.warm_up_rescue(estimator.k + 2)
    return steps
