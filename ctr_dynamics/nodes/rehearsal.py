"""A dry run of the estimator before the first message, so that nothing is compiled while steps are due."""

from __future__ import annotations

from ctr_dynamics.estimation.estimator import Estimator
from ctr_dynamics.messages.encode import StepEncoder
from ctr_dynamics.parameters import Settings
from ctr_dynamics.robot import Robot

START_NS = 1_000_000_000_000
JOINT_PERIOD_NS = 10_000_000
DURATION_NS = 300_000_000


def rehearse(robot: Robot, settings: Settings) -> int:
    """Run another estimator at the robot's rest position, tracker included; returns the number of steps.

    The tracker reports the predicted tip, every third sample late enough to be fused by roll-back.
    """
    estimator = Estimator(robot, settings)
    encoder = StepEncoder(settings["output.frame_id"], robot.name)
    names = [f"tube{n}_{kind}" for n in range(1, robot.n_tubes + 1) for kind in ("rotation", "translation")]
    rest = zip(robot.rest.alpha.value, robot.rest.beta.value, strict=True)
    positions = [float(x) for pair in rest for x in pair]
    steps = 0
    for stamp_ns in range(START_NS, START_NS + DURATION_NS, JOINT_PERIOD_NS):
        estimator.add_joint_state(stamp_ns, names, positions)
        for index, out in enumerate(estimator.advance(stamp_ns + JOINT_PERIOD_NS // 2)):
            encoder.encode(out, estimator.health.statuses)
            steps += 1
            if index == 0 and out.valid:
                w, x, y, z = out.predicted_quaternion_wxyz
                age_ns = JOINT_PERIOD_NS if steps % 3 else 3 * JOINT_PERIOD_NS
                estimator.add_tracker_pose(
                    out.stamp_ns - age_ns, out.predicted_position, (x, y, z, w), settings["output.frame_id"]
                )
    return steps
