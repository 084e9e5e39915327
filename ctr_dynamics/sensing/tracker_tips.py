"""Tips that recorded poses of a tracker show.

In: poses and a tracker. Out: times and positions of the tip.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.io.messages.cdr import PoseIn
from ctr_dynamics.io.messages.unit_quaternions import is_unit, norm
from ctr_dynamics.sensing.tracker import TrackerModel

Floats = NDArray[np.float64]


def tracker_tips(
    poses: Iterable[PoseIn],
    start_ns: int,
    tracker: TrackerModel,
    turned: Callable[[float], Floats] | None = None,
) -> tuple[Floats, Floats]:
    """Times (s,) s and positions (s, 3) m of the tip in ``ctr_base`` that usable poses show.

    Args:
        start_ns: stamp of time 0.
        turned: quaternion (4,) wxyz of the tip at a time (s), of which a tracker that does not measure all of it knows the rest.
    """
    partly = turned is not None and not tracker.mask[3:].all()
    times, points = [], []
    for pose in poses:
        stamp = (pose.stamp_ns - start_ns) * 1e-9
        q, expected = np.array(pose.quaternion_xyzw)[[3, 0, 1, 2]], None
        if turned is not None and partly:
            q = expected = turned(float(tracker.observed_times(np.array(stamp))))
        if np.isfinite(pose.position).all() and is_unit(norm(q)):
            time, point, _ = tracker.inverse(stamp, np.array(pose.position), q, expected)
            times.append(time)
            points.append(point)
    return np.array(times), np.array(points).reshape(-1, 3)
