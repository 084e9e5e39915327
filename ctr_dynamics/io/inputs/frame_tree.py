"""Frames of poses: the tree of transforms that other nodes publish on /tf and /tf_static, and poses brought from one frame to another.

A transform is the pose of a child frame in its parent. One on /tf_static holds at all times, as that of a camera on its stand, and so does one on
/tf that has come more than once and never changed. One that has changed is taken between two of its stamps, linear in position and quaternion, so
that a pose newer than the last of them has to wait.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections import deque
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from ctr_dynamics.io.messages.cdr import PoseIn
from ctr_dynamics.io.messages.unit_quaternions import is_unit, norm
from ctr_dynamics.kernels.rotations import multiply

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]  # x, y, z, w

MOST_SAMPLES = (
    2000  # kept of a moving frame: 2 s of one that is published at 1 kHz, more than a late pose needs
)
MOST_WAITING = 200  # poses
MOST_FRAMES = 1000


class Transform(NamedTuple):
    """Pose of a frame in another: position (3,) in m, unit quaternion in ROS order."""

    position: Vector
    quaternion_xyzw: Quaternion


IDENTITY = Transform((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))


class NoTransform(Exception):
    """The frames are not connected, or not at that time; the text says which."""


class NotYet(Exception):
    """The frames are connected by one that moves, whose transform of that time has not come yet."""


def product(a: Quaternion, b: Quaternion) -> Quaternion:
    """Product of two quaternions x, y, z, w."""
    w, x, y, z = multiply(np.array([a[3], *a[:3]]), np.array([b[3], *b[:3]])).tolist()
    return x, y, z, w


def rotated(q: Quaternion, v: Vector) -> Vector:
    """The vector (3,) turned by the unit quaternion."""
    x, y, z, _ = product(product(q, (*v, 0.0)), (-q[0], -q[1], -q[2], q[3]))
    return x, y, z


def composed(a: Transform, b: Transform) -> Transform:
    """Pose in frame 0 of what has the pose ``b`` in a frame with the pose ``a`` in frame 0."""
    moved = rotated(a.quaternion_xyzw, b.position)
    x, y, z = (p + m for p, m in zip(a.position, moved, strict=True))
    return Transform((x, y, z), product(a.quaternion_xyzw, b.quaternion_xyzw))


def inverse(a: Transform) -> Transform:
    """Pose of frame 0 in a frame with the pose ``a`` in frame 0."""
    x, y, z, w = a.quaternion_xyzw
    back = (-x, -y, -z, w)
    px, py, pz = rotated(back, a.position)
    return Transform((-px, -py, -pz), back)


def _between(a: Transform, b: Transform, share: float) -> Transform:
    x, y, z = (p + share * (q - p) for p, q in zip(a.position, b.position, strict=True))
    dot = sum(p * q for p, q in zip(a.quaternion_xyzw, b.quaternion_xyzw, strict=True))
    toward = share if dot >= 0.0 else -share
    mixed = [
        (1.0 - share) * p + toward * q for p, q in zip(a.quaternion_xyzw, b.quaternion_xyzw, strict=True)
    ]
    size = norm(mixed)
    i, j, k, w = (v / size for v in mixed)
    return Transform((x, y, z), (i, j, k, w))


class _Link:
    """A child frame in its parent, at the stamps at which it was published."""

    def __init__(self, parent: str, static: bool) -> None:
        self.parent, self.static = parent, static
        self.moved = False
        self._stamps: deque[int] = deque(maxlen=MOST_SAMPLES)
        self._poses: deque[Transform] = deque(maxlen=MOST_SAMPLES)

    def add(self, stamp_ns: int, pose: Transform) -> None:
        if self.static:
            self._stamps.clear()
            self._poses.clear()
        elif self._stamps and stamp_ns <= self._stamps[-1]:
            if stamp_ns >= self._stamps[0]:  # repeated, or overtaken by a newer one
                return
            self._stamps.clear()  # the clock was set back
            self._poses.clear()
        self.moved = self.moved or bool(self._poses and pose != self._poses[-1])
        self._stamps.append(stamp_ns)
        self._poses.append(pose)

    def at(self, stamp_ns: int) -> Transform:
        if not self.moved and (self.static or len(self._poses) > 1 or stamp_ns <= self._stamps[-1]):
            return self._poses[-1]
        after = bisect_right(self._stamps, stamp_ns)
        if after == 0:
            raise NoTransform(f"it is {1e-9 * (self._stamps[0] - stamp_ns):.3f} s older than the transforms")
        begin = self._stamps[after - 1]
        if begin == stamp_ns:
            return self._poses[after - 1]
        if after == len(self._stamps):
            raise NotYet
        share = (stamp_ns - begin) / (self._stamps[after] - begin)
        return _between(self._poses[after - 1], self._poses[after], share)


class FrameTree:
    """Brings poses into one frame.

    Args:
        target: that frame; empty: poses are left as they are.

    Attributes:
        placed: number of poses brought into it, by the frame that they came in.
    """

    def __init__(self, target: str = "") -> None:
        self.target = target.lstrip("/")
        self.placed: dict[str, int] = {}
        self._links: dict[str, _Link] = {}
        self._waiting: deque[PoseIn] = deque()

    def add(self, transforms: Iterable[tuple[str, PoseIn]], static: bool) -> None:
        """Take the transforms of a message: name of each child, and its stamped pose in the frame of its header.

        Those that are no poses, or of a frame in itself, are left out.
        """
        for name, pose in transforms:
            child, parent = name.lstrip("/"), pose.frame_id.lstrip("/")
            values = (*pose.position, *pose.quaternion_xyzw)
            size = norm(pose.quaternion_xyzw)
            if child == parent or not all(map(math.isfinite, values)) or not is_unit(size):
                continue
            link = self._links.get(child)
            if link is None or link.parent != parent or link.static != static:
                if link is None and len(self._links) >= MOST_FRAMES:
                    continue
                link = self._links[child] = _Link(parent, static)
            x, y, z, w = (v / size for v in pose.quaternion_xyzw)
            link.add(pose.stamp_ns, Transform(pose.position, (x, y, z, w)))

    def take_over(self, other: FrameTree) -> None:
        """Know the transforms that another tree has been given."""
        self._links = other._links

    def lookup(self, source: str, target: str, stamp_ns: int) -> Transform:
        """Pose of frame ``source`` in frame ``target``.

        Raises:
            NoTransform: they are not connected at that time. NotYet: they may be, once later transforms have come.
        """
        down, up = self._chain(source), self._chain(target)
        common = next((frame for frame in down if frame in up), None)
        if common is None:
            raise NoTransform(f"no transform connects '{source}' and '{target}'")
        return composed(inverse(self._in(up, common, stamp_ns)), self._in(down, common, stamp_ns))

    def _chain(self, frame: str) -> list[str]:
        """The frame, its parent, that one's parent, and so on."""
        frames = [frame]
        while frames[-1] in self._links and self._links[frames[-1]].parent not in frames:
            frames.append(self._links[frames[-1]].parent)
        return frames

    def _in(self, chain: list[str], ancestor: str, stamp_ns: int) -> Transform:
        """Pose in ``ancestor`` of the first frame of the chain."""
        pose = IDENTITY
        for frame in chain[: chain.index(ancestor)]:
            pose = composed(self._links[frame].at(stamp_ns), pose)
        return pose

    def place(self, pose: PoseIn) -> list[PoseIn]:
        """The pose in the target frame; as it is where it is in that frame or cannot be brought there; nothing where it has to wait."""
        source = pose.frame_id.lstrip("/")
        if not self.target or source in ("", self.target):
            return [pose]
        try:
            frame = self.lookup(source, self.target, pose.stamp_ns)
        except NoTransform:
            return [pose]
        except NotYet:
            self._waiting.append(pose)
            return [self._waiting.popleft()] if len(self._waiting) > MOST_WAITING else []
        moved = composed(frame, Transform(pose.position, pose.quaternion_xyzw))
        self.placed[source] = self.placed.get(source, 0) + 1
        return [
            pose._replace(
                frame_id=self.target, position=moved.position, quaternion_xyzw=moved.quaternion_xyzw
            )
        ]

    def released(self) -> list[PoseIn]:
        """Poses that have waited and need wait no longer, in the order in which they came."""
        held, self._waiting = self._waiting, deque()
        return [placed for pose in held for placed in self.place(pose)]

    def rest(self) -> list[PoseIn]:
        """Poses whose transforms never came, as they are."""
        held, self._waiting = self._waiting, deque()
        return list(held)

    @property
    def notes(self) -> list[str]:
        """What was brought into the target frame, a line for each frame."""
        return [
            f"{count} poses in frame '{frame}' were brought into '{self.target}' by the transforms on /tf and /tf_static"
            for frame, count in self.placed.items()
        ]
