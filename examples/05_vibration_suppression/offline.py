"""The loop without ROS and without a clock: plant, estimator and damper in one thread, every delay as it would be.

    python examples/05_vibration_suppression/offline.py [ROBOT]

prints the settling times with and without control. The nodes of this folder do the same over DDS.
"""

from __future__ import annotations

import sys
from collections import deque
from pathlib import Path

import numpy as np

from ctr_dynamics.estimation.estimator import Estimator
from ctr_dynamics.io.messages import topics
from ctr_dynamics.io.messages.cdr import decode_joint_state, decode_pose_stamped, decode_wrench_stamped
from ctr_dynamics.parameters import Settings
from ctr_dynamics.robot import Robot
from ctr_dynamics.robot_files import load_robot

sys.path.insert(0, str(Path(__file__).parent))
from damper import DriveHistory, Estimate, Limits, ModalDamper, Tuning
from simulated_robot import Hardware, SimulatedRobot, settling_time

START_NS = 1_700_000_000_000_000_000
ESTIMATOR_LATENCY_S = 0.006  # from a step's stamp to its message in the controller's hands


def run(
    robot: Robot,
    seconds: float,
    *,
    control: bool = True,
    hardware: Hardware | None = None,
    tuning: Tuning | None = None,
    limits: Limits | None = None,
    period_s: float = 0.01,
    mode: int = 0,
) -> SimulatedRobot:
    """Release the weight and let the loop run; returns the plant with its truth."""
    plant = SimulatedRobot(robot, START_NS, hardware)
    estimator = Estimator(robot, Settings({"output.policy": "predict"}))
    # no tip moves farther than the robot is long; each estimate brings its own authority
    damper, drives = ModalDamper(robot.tubes[0].length, period_s, tuning, limits), DriveHistory()
    on_the_way: deque[tuple[float, Estimate | None]] = deque()
    next_command = 0.0
    while plant.t < seconds:
        for topic, data in plant.step():
            if topic == topics.JOINT_STATES:
                joints = decode_joint_state(data)
                estimator.add_joint_state(joints.stamp_ns, joints.names, joints.positions)
                drives.add(
                    (joints.stamp_ns - START_NS) * 1e-9, joints.positions[0] - robot.rest.alpha.value[0]
                )
            elif topic == topics.TRACKER_TIP:
                pose = decode_pose_stamped(data)
                estimator.add_tracker_pose(pose.stamp_ns, pose.position, pose.quaternion_xyzw, pose.frame_id)
            else:
                load = decode_wrench_stamped(data)
                estimator.add_tip_load(load.stamp_ns, load.force, load.torque, load.frame_id)
        for out in estimator.advance(START_NS + round(plant.t * 1e9)):
            t = (out.stamp_ns - START_NS) * 1e-9
            drive = drives.at(t)
            estimate = None
            known = out.jacobian.size and len(out.modes.frequency_hz) > mode
            if out.valid and drive is not None and known:
                turned = out.jacobian[:3, : robot.n_tubes].sum(axis=1)  # m/rad, all tubes together
                along = out.modes.direction[mode]
                estimate = Estimate(
                    t, float(out.modes.amplitude[mode]), float(out.modes.rate[mode]),
                    2 * np.pi * float(out.modes.frequency_hz[mode]), float(out.modes.damping[mode]),
                    float(np.sqrt(along @ out.tip_velocity_covariance[:3, :3] @ along)), *drive,
                    authority=float(along @ turned),
                )  # fmt: skip
            on_the_way.append((plant.t + ESTIMATOR_LATENCY_S, estimate))
            estimator.do_idle_work()  # as a node does between its steps; the modes are found there
        while on_the_way and on_the_way[0][0] <= plant.t:
            _, estimate = on_the_way.popleft()
            damper.take(estimate) if estimate is not None else damper.invalid()
        if plant.t >= next_command:
            next_command += period_s
            delta = damper.command(plant.t)
            if control:
                plant.send(plant.t, delta)
    return plant


def main() -> None:
    robot = load_robot(sys.argv[1] if len(sys.argv) > 1 else "till2020_tissue")
    for label, control in (("without control", False), ("with control", True)):
        plant = run(robot, 6.0, control=control)
        settled = settling_time(plant.truth, plant.hardware.release_s, 0.003)
        print(
            f"{label:<16} tip within 3 mm after {settled:.2f} s, largest turn {max(map(abs, plant.truth.delta)):.3f} rad"
        )


if __name__ == "__main__":
    main()
