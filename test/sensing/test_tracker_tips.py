"""Tips that poses show: of a tracker that measures all of the orientation, part of it, or none."""

from dataclasses import replace

import numpy as np
import pytest

from ctr_dynamics.effects import make_plant
from ctr_dynamics.io.messages.cdr import PoseIn
from ctr_dynamics.kernels.rotations import from_vector, matrix
from ctr_dynamics.robot_files import load_robot, robot_with
from ctr_dynamics.sensing.tracker_tips import tracker_tips

LEVER, DELAY = np.array([0.0, 0.01, 0.02]), 0.025
TURN = from_vector(np.array([0.3, -0.2, 0.9]))


def pose(stamp_ns, position, wxyz):
    return PoseIn(
        stamp_ns=stamp_ns, position=tuple(position), quaternion_xyzw=tuple(np.roll(wxyz, -1)), frame_id=""
    )


def tracker(axes):
    """The tissue robot's, with a lever arm and a delay, that measures as many ``axes``."""
    robot = robot_with(
        load_robot("till2020_tissue"), {"tracker.lever_arm": LEVER.tolist(), "tracker.delay": DELAY}
    )
    return replace(make_plant(robot).tracker, mask=np.arange(6) < axes)


@pytest.mark.parametrize("axes", [6, 3])
def test_the_lever_arm_is_turned_by_what_is_known_of_the_orientation(axes):
    tip = np.array([0.01, 0.02, 0.1])
    sensor = tip + matrix(TURN) @ LEVER
    seen = TURN if axes == 6 else [0.0, 0.0, 0.0, 0.0]
    poses = [pose(1_000_000_000, sensor, seen), pose(1_010_000_000, [np.nan] * 3, seen)]
    asked = []

    def turned(t):
        asked.append(t)
        return TURN

    times, points = tracker_tips(poses, 500_000_000, tracker(axes), turned)
    np.testing.assert_allclose(times, [0.5 - DELAY])
    np.testing.assert_allclose(points, [tip], atol=1e-12)
    assert bool(asked) == (axes == 3)
    alone, _ = tracker_tips(poses, 500_000_000, tracker(axes))
    assert len(alone) == (axes == 6)
