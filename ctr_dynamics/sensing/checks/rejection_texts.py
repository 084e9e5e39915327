"""Why a message cannot be used, in words: by the checks of a stream, and by the estimator where it is given messages without them."""

from __future__ import annotations

from ctr_dynamics.io.messages.unit_quaternions import MEASURED_NORMS


def pose_in_other_frame(frame_id: str, expected: str) -> str:
    """A pose that is not in the ``expected`` frame."""
    return f"pose in frame '{frame_id}', expected '{expected}'; if that is the tracker's frame, set tracker.frame_id={frame_id}"


def load_in_other_frame(frame_id: str, expected: str) -> str:
    """A load that is not in the ``expected`` frame."""
    return f"load in frame '{frame_id}', expected '{expected}'; send it in base axes"


def not_finite(noun: str, stamp_ns: int) -> str:
    """A message, called by ``noun``, with a number that is none."""
    return f"{noun} at {stamp_ns} ns holds a value that is not finite; it was left out"


def no_quaternion(size: float) -> str:
    """A quaternion whose norm ``size`` is not that of an orientation."""
    return f"quaternion of norm {size:.3g} is outside {MEASURED_NORMS}; send unit quaternions, or set tracker.axes to xyz; left out"


def second_of_stamp(noun: str, stamp_ns: int) -> str:
    """Another message, called by ``noun``, of a stamp that there was."""
    return f"a second {noun} of {stamp_ns} ns; the first counts; look at the driver"
