"""What diagnosis reads of a bag: joints, known loads and tracker poses as arrays on one clock."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.errors import InputError
from ctr_dynamics.io.bag_reader import Bag, open_bag
from ctr_dynamics.io.messages.cdr import JointStateIn, PoseIn
from ctr_dynamics.robot import Robot
from ctr_dynamics.sensing.interpolation import finite, joint_order

Floats = NDArray[np.float64]
SHORTEST = 2.0  # s of joints and tracker together, below which nothing can be said
GAP = 0.1  # s without joints in which the robot may have gone anywhere
SETTLING = 0.5  # s after it that the tip still swings from what was not seen
PAUSE = 10.0  # s without joints, or by which their clock was set, beyond which it is another recording
LONGEST = 1000.0  # s of joints that fit into memory with all that a diagnosis keeps of them
BEGINNING = 0.1  # s of joints that tell whether the robot stands at the start
STANDING = (0.01, 2e-4)  # rad and m by which it may move in them, beside the encoders' noise
UNSETTLED = 2.0  # s until a start in motion, which the model does not know, has died away (1 s leaves 0.3 mm)
LOAD_GRACE = 0.1  # s; a first load that comes this soon after the joints is there from the start


@dataclass(frozen=True)
class Recording:
    """One bag; times in s from the first complete joint state.

    Attributes:
        name: of the bag. sha256: of its files, by name.
        joints: (k, 1 + 2N) t, alpha rad, beta m. load: (k, 7) t, force N, torque N m in ``ctr_base``; may be empty.
        stamps: (s,) s of the tracker poses; position: (s, 3) m; quaternion: (s, 4) wxyz.
        notes: what was left out or looks odd.
    """

    name: str
    path: str
    sha256: dict[str, str]
    joints: Floats
    load: Floats
    stamps: Floats
    position: Floats
    quaternion: Floats
    notes: tuple[str, ...]

    @property
    def duration(self) -> float:
        """s of joints."""
        return float(self.joints[-1, 0])

    def until(self, end: float) -> Recording:
        """What was recorded up to ``end`` (s), and the joint state after."""
        joints = self.joints[: int(np.searchsorted(self.joints[:, 0], end)) + 1]
        seen = self.stamps <= end
        return replace(
            self,
            joints=joints,
            stamps=self.stamps[seen],
            position=self.position[seen],
            quaternion=self.quaternion[seen],
        )


def read_recording(path: str | Path, robot: Robot) -> Recording:
    """Read a bag for ``robot``.

    Raises:
        InputError: not a bag, no complete joint state of this robot, no tracker, less than ``SHORTEST`` seconds of both, or more than
            ``LONGEST``.
    """
    bag = open_bag(path)
    bag.check_inputs()
    joints, poses, loads, notes, wrong = _collect(bag, robot)
    where = str(path)
    if not joints:
        wanted = ", ".join(f"tube{i + 1}_rotation, tube{i + 1}_translation" for i in range(robot.n_tubes))
        raise InputError(
            f"no complete joint state of robot '{robot.name}' ({wrong or 'none at all'}; needed: {wanted})",
            do="check the robot and the joint names with `ctr-dynamics info`",
            where=where,
        )
    if not poses:
        raise InputError(
            "no usable tracker pose", do="diagnosis needs the tracker on /ctr/tracker/tip", where=where
        )
    joints, loads, parted = _longest_part(_once(joints), _once(loads))
    notes += [parted] if parted else []
    t0 = joints[0][0]
    table = np.array([[(stamp - t0) * 1e-9, *value] for stamp, value in joints])
    reason = robot.actuator_problem(table[0, 1 + robot.n_tubes :], table[0, 1 : 1 + robot.n_tubes])
    if reason:
        raise InputError(
            f"{reason}; is it a bag of this robot?", do="check the robot file and the units", where=where
        )
    if table[-1, 0] > LONGEST:
        raise InputError(
            f"joints of {table[-1, 0]:.0f} s, limit {LONGEST:g} s",
            do="cut the bag; ten seconds with motion are enough",
            where=where,
        )
    tracker = np.array([[(stamp - t0) * 1e-9, *value] for stamp, value in _once(poses)])
    inside = (tracker[:, 0] >= 0.0) & (tracker[:, 0] <= table[-1, 0])
    if not inside.all():
        notes.append(
            f"{int((~inside).sum())} tracker poses lie outside the time of the joints and were left out"
        )
    tracker = tracker[inside]
    unseen, note = _unseen(table[:, 0], tracker[:, 0])
    notes += [note] if note else []
    moving = _moving(table, robot)
    if moving:
        notes.append(
            f"the recording begins in motion ({moving}), which the model does not know: tracker poses of the first {UNSETTLED:g} s were left out"
        )
        unseen |= tracker[:, 0] < UNSETTLED
    span = float(np.ptp(tracker[:, 0]) * np.mean(~unseen)) if len(tracker) else 0.0
    tracker = tracker[~unseen]
    if span < SHORTEST:
        raise InputError(
            f"tracker and joints overlap for {span:.2f} s, less than {SHORTEST:g} s{f' ({note})' if note else ''}",
            do="record for longer; ten seconds with motion are enough",
            where=where,
        )
    load = np.array([[(stamp - t0) * 1e-9, *value] for stamp, value in loads]).reshape(-1, 7)
    if len(load) and load[0, 0] > LOAD_GRACE:
        load = np.vstack([np.r_[load[0, 0] - 1e-9, np.zeros(6)], load])
    return Recording(
        bag.path.name, where, bag.sha256(), table, load, tracker[:, 0], tracker[:, 1:4], _continuous(tracker[:, 4:8]), tuple(notes)
    )  # fmt: skip


def _longest_part(joints: Samples, loads: Samples) -> tuple[Samples, Samples, str]:
    """The longest stretch of ``joints`` without a pause, the ``loads`` in it with the one that acts at its beginning, and a note on what was left
    out."""
    stamps = np.array([stamp for stamp, _ in joints])
    ends = np.flatnonzero(np.diff(stamps) > PAUSE * 1e9)
    if not len(ends):
        return joints, loads, ""
    parts = list(zip([0, *(ends + 1)], [*ends, len(stamps) - 1], strict=True))
    first, last = max(parts, key=lambda part: stamps[part[1]] - stamps[part[0]])
    begin, end = stamps[first], stamps[last]
    acting = [(int(begin), value) for stamp, value in loads if stamp <= begin][-1:]
    longest = float(np.diff(stamps).max()) * 1e-9
    return (
        joints[first : last + 1],
        acting + [load for load in loads if begin < load[0] <= end],
        f"joints are missing for up to {longest:.0f} s (limit {PAUSE:g} s): of {len(parts)} parts, only the longest was used, "
        f"{(end - begin) * 1e-9:.1f} s from {(begin - stamps[0]) * 1e-9:.0f} s on",
    )


def _moving(joints: Floats, robot: Robot) -> str:
    """Which actuator moves most at the beginning of ``joints`` (k, 1 + 2N), in words; empty where all stand."""
    n = robot.n_tubes
    rows = joints[joints[:, 0] <= BEGINNING]
    least = np.repeat([STANDING[0] + 6.0 * robot.encoders.noise.value, STANDING[1]], n)
    travel = np.ptp(rows[:, 1:], axis=0)
    most = int(np.argmax(travel / least))
    if travel[most] <= least[most]:
        return ""
    span = max(float(rows[-1, 0]), 1e-3)
    kind = (
        f"turns at {travel[most] / span:.2g} rad/s"
        if most < n
        else f"slides at {1e3 * travel[most] / span:.2g} mm/s"
    )
    return f"tube {most % n + 1} {kind}"


def _unseen(joints: Floats, poses: Floats) -> tuple[NDArray[np.bool_], str]:
    """Which of ``poses`` (s) fall into gaps of ``joints`` (s) or so soon behind that the tip may still swing from them, and a note about them."""
    gaps = np.flatnonzero(np.diff(joints) > GAP)
    unseen = np.zeros(len(poses), bool)
    for i in gaps:
        unseen |= (poses > joints[i]) & (poses < joints[i + 1] + SETTLING)
    if not len(gaps):
        return unseen, ""
    longest = float(np.diff(joints).max())
    times = "once" if len(gaps) == 1 else f"{len(gaps)} times"
    return unseen, (
        f"joints are missing {times}, for up to {longest:.2f} s (limit {GAP:g} s): {int(unseen.sum())} of {len(poses)} tracker poses, "
        f"up to {SETTLING:g} s after, were left out"
    )


Samples = list[tuple[int, list[float]]]


def _collect(bag: Bag, robot: Robot) -> tuple[Samples, Samples, Samples, list[str], str]:
    joints: Samples = []
    poses: Samples = []
    bare: Samples = []  # poses without a usable orientation
    loads: Samples = []
    left, wrong = 0, ""
    for item in bag.inputs():
        message = item.message
        if isinstance(message, JointStateIn):
            order = joint_order(tuple(message.names), robot.n_tubes)
            if isinstance(order, str):
                wrong = order
                continue
            value = (
                [float(message.positions[i]) for i in order]
                if len(message.positions) >= len(message.names)
                else []
            )
            if value and finite(value):
                joints.append((message.stamp_ns, value))
            else:
                left += 1
        elif isinstance(message, PoseIn):
            x, y, z, w = message.quaternion_xyzw
            norm = float(np.sqrt(x * x + y * y + z * z + w * w)) if finite(message.quaternion_xyzw) else 0.0
            if finite(message.position) and 0.9 <= norm <= 1.1:
                poses.append((message.stamp_ns, [*message.position, w / norm, x / norm, y / norm, z / norm]))
            elif finite(message.position):
                bare.append((message.stamp_ns, [*message.position, 1.0, 0.0, 0.0, 0.0]))
            else:
                left += 1
        elif finite(message.force) and finite(message.torque):
            loads.append((message.stamp_ns, [*message.force, *message.torque]))
        else:
            left += 1
    if poses:
        left += len(bare)
    poses = poses or bare  # a tracker of positions alone sends zeros or NaN for the orientation
    notes = [f"{left} messages hold values that cannot be used and were left out"] if left else []
    if wrong and joints:
        notes.append(f"some joint states were left out: {wrong}")
    return joints, poses, loads, notes, wrong


def _once(samples: Samples) -> Samples:
    """In the order of stamps, the first of each."""
    found: dict[int, list[float]] = {}
    for stamp, value in samples:
        found.setdefault(stamp, value)
    return sorted(found.items())


def _continuous(quaternion: Floats) -> Floats:
    """The same rotations without jumps of sign."""
    out = quaternion.copy()
    for i in range(1, len(out)):
        if out[i] @ out[i - 1] < 0.0:
            out[i] = -out[i]
    return out
