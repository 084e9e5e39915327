"""Data: what diagnosis reads of a bag.

In: a bag and a robot. Out: joints, known loads and tracker poses as arrays on one clock, with notes on what was left out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.diagnosis.coarse_stamps import evened
from ctr_dynamics.diagnosis.diagnosis_options import RecordingOptions
from ctr_dynamics.errors import InputError
from ctr_dynamics.io.bag_reader import Bag, open_bag
from ctr_dynamics.io.messages.cdr import JointStateIn, PoseIn
from ctr_dynamics.io.messages.topics import JOINT_STATES, TRACKER_TIP, accepts_frame
from ctr_dynamics.io.messages.unit_quaternions import is_unit, norm
from ctr_dynamics.parameters import Settings, axes_mask, input_mapping, pose_frame
from ctr_dynamics.robot import Robot
from ctr_dynamics.sensing.checks import CheckOptions, JointChecks, Kind
from ctr_dynamics.sensing.encoder_noise import without_noise
from ctr_dynamics.sensing.interpolation import finite, joint_order
from ctr_dynamics.sensing.tracker_parameters import with_robot_file

Floats = NDArray[np.float64]
Samples = list[tuple[int, list[float]]]


@dataclass(frozen=True)
class Recording:
    """One bag; times in s from the first complete joint state.

    Attributes:
        name: of the bag. sha256: of its files, by name.
        joints: (k, 1 + 2N) t, alpha rad without the encoders' noise, beta m. load: (k, 7) t, force N, torque N m in ``ctr_base``; may be empty.
        stamps: (s,) s of the tracker poses; position: (s, 3) m; quaternion: (s, 4) wxyz.
        notes: what was left out or looks odd.
        axes: measured axes of the tracker, as the parameter ``tracker.axes`` has them.
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
    axes: tuple[bool, ...] = (True,) * 6

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


def read_recording(
    path: str | Path,
    robot: Robot,
    options: RecordingOptions | None = None,
    settings: Settings | None = None,
    remap: Mapping[str, str] | None = None,
) -> Recording:
    """Read a bag for ``robot``.

    Args:
        path: of the bag. options: what is used of it.
        settings: parameters; ``joints`` and ``tracker`` say what the bag's names, units and frames mean.
        remap: topic of the bag to the product's.

    Raises:
        InputError: not a bag, no complete joint state of this robot, no tracker, or joints and tracker together shorter or longer than
            the options say.
    """
    o, settings = options or RecordingOptions(), with_robot_file(settings or Settings(), robot)
    bag = open_bag(path, input_mapping(settings, remap))
    bag.tubes = robot.n_tubes
    bag.check_inputs((JOINT_STATES, TRACKER_TIP))
    joints, poses, loads, notes, wrong = _collect(bag, robot, settings)
    where = str(path)
    if not joints:
        wanted = ", ".join(f"tube{i + 1}_rotation, tube{i + 1}_translation" for i in range(robot.n_tubes))
        raise InputError(
            f"no complete joint state of robot '{robot.name}' ({wrong or 'none at all'}; needed: {wanted})",
            do="check the robot, and name the joints with joints.rotation_names and joints.translation_names (`--set`)",
            where=where,
        )
    if not poses:
        raise InputError(
            "no usable tracker pose" + "".join(f"; {note}" for note in notes[-1:]),
            do="diagnosis needs the tracker on /ctr/tracker/tip",
            where=where,
        )
    joints, loads, parted = _longest_part(_once(joints), _once(loads), o)
    notes += [parted] if parted else []
    t0 = joints[0][0]
    table, coarse = _rows(joints, t0, o)
    notes += [f"joint states: {coarse}"] if coarse else []
    reason = robot.actuator_problem(table[0, 1 + robot.n_tubes :], table[0, 1 : 1 + robot.n_tubes])
    if reason:
        raise InputError(
            f"{reason}; is it a bag of this robot?", do="check the robot file and the units", where=where
        )
    if table[-1, 0] > o.longest_s:
        raise InputError(
            f"joints of {table[-1, 0]:.0f} s, limit {o.longest_s:g} s",
            do="cut the bag; ten seconds with motion are enough",
            where=where,
        )
    # by the readings as they are: without noise, the limits for it would be too wide
    moving = _moving(table, robot, o)
    angles = slice(1, 1 + robot.n_tubes)
    table[:, angles] = without_noise(table[:, 0], table[:, angles], robot.encoders.noise.value)
    tracker, coarse = _rows(_once(poses), t0, o)
    notes += [f"tracker poses: {coarse}"] if coarse else []
    inside = (tracker[:, 0] >= 0.0) & (tracker[:, 0] <= table[-1, 0])
    if not inside.all():
        notes.append(
            f"{int((~inside).sum())} tracker poses lie outside the time of the joints and were left out"
        )
    tracker = tracker[inside]
    unseen, note = _unseen(table[:, 0], tracker[:, 0], o)
    notes += [note] if note else []
    if moving:
        notes.append(
            f"the recording begins in motion ({moving}), which the model does not know: tracker poses of the first {o.unsettled_s:g} s were left out"
        )
        unseen |= tracker[:, 0] < o.unsettled_s
    span = float(np.ptp(tracker[:, 0]) * np.mean(~unseen)) if len(tracker) else 0.0
    tracker = tracker[~unseen]
    if span < o.shortest_s:
        raise InputError(
            f"tracker and joints overlap for {span:.2f} s, less than {o.shortest_s:g} s{f' ({note})' if note else ''}",
            do="record for longer; ten seconds with motion are enough",
            where=where,
        )
    load = np.array([[(stamp - t0) * 1e-9, *value] for stamp, value in loads]).reshape(-1, 7)
    if len(load) and load[0, 0] > o.first_load_s:
        load = np.vstack([np.r_[load[0, 0] - 1e-9, np.zeros(6)], load])
    return Recording(
        bag.path.name, where, bag.sha256(), table, load, tracker[:, 0], tracker[:, 1:4], _continuous(tracker[:, 4:8]), tuple(notes),
        axes_mask(settings["tracker.axes"]),
    )  # fmt: skip


def measured_axes(recordings: Sequence[Recording], notes: list[str]) -> NDArray[np.bool_]:
    """(6,) axes that carry information in every recording: a tracker that sends one and the same rotation has three degrees of freedom.

    ``notes`` takes what an engineer should know of them.
    """
    mask = np.all([r.axes for r in recordings], axis=0)
    if mask[3:].any() and any(np.ptp(r.quaternion, axis=0).max(initial=0.0) < 1e-9 for r in recordings):
        mask[3:] = False
        notes.append(
            "the tracker sends no rotation (three degrees of freedom); causes are judged by position alone"
        )
    return mask


def _rows(samples: Samples, t0: int, options: RecordingOptions) -> tuple[Floats, str]:
    """(k, 1 + c): s after ``t0`` (ns), then the values; and a note where the stamps were coarse and are evened."""
    stamps = np.array([stamp for stamp, _ in samples], dtype=np.int64)
    times, step = evened(stamps, options)
    values = np.array([value for _, value in samples])
    rows = np.column_stack([(times + float(stamps[0] - t0)) * 1e-9, values])
    if not step:
        return rows, ""
    moved = 1e-6 * float(np.abs(times - (stamps - stamps[0])).max())
    return (
        rows,
        f"stamps are multiples of {1e-6 * step:g} ms; inside that they were made even, which moved them by up to {moved:.1f} ms",
    )


def _longest_part(joints: Samples, loads: Samples, options: RecordingOptions) -> tuple[Samples, Samples, str]:
    """The longest part of ``joints`` without a long gap, the ``loads`` in it, and a note on what was left out.

    The load that acts at its beginning is among them.
    """
    stamps = np.array([stamp for stamp, _ in joints])
    ends = np.flatnonzero(np.diff(stamps) > options.pause_s * 1e9)
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
        f"joints are missing for up to {longest:.0f} s (limit {options.pause_s:g} s): of {len(parts)} parts, only the longest was used, "
        f"{(end - begin) * 1e-9:.1f} s from {(begin - stamps[0]) * 1e-9:.0f} s on",
    )


def _moving(joints: Floats, robot: Robot, options: RecordingOptions) -> str:
    """Which actuator moves most at the beginning of ``joints`` (k, 1 + 2N), in words; empty where all stand."""
    n = robot.n_tubes
    rows = joints[: max(int(np.sum(joints[:, 0] <= options.start_s)), 2)]
    noise = options.start_noise * robot.encoders.noise.value
    least = np.repeat([options.start_rad + noise, options.start_m], n)
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


def _unseen(joints: Floats, poses: Floats, options: RecordingOptions) -> tuple[NDArray[np.bool_], str]:
    """Which of ``poses`` (s) fall into gaps of ``joints`` (s), or so soon behind that vibration from them persists, and a note."""
    limit = (
        max(options.gap_s, options.gap_periods * float(np.median(np.diff(joints))))
        if len(joints) > 1
        else options.gap_s
    )
    gaps = np.flatnonzero(np.diff(joints) > limit)
    unseen = np.zeros(len(poses), bool)
    for i in gaps:
        unseen |= (poses > joints[i]) & (poses < joints[i + 1] + options.settling_s)
    if not len(gaps):
        return unseen, ""
    longest = float(np.diff(joints).max())
    times = "once" if len(gaps) == 1 else f"{len(gaps)} times"
    return unseen, (
        f"joints are missing {times}, for up to {longest:.2f} s (limit {limit:.2g} s): {int(unseen.sum())} of {len(poses)} tracker poses, "
        f"up to {options.settling_s:g} s after, were left out"
    )


def _collect(bag: Bag, robot: Robot, settings: Settings) -> tuple[Samples, Samples, Samples, list[str], str]:
    """Joints, poses and loads, notes, and what is wrong with names of joints. Angles that wrap are made continuous."""
    frame, n = pose_frame(settings), robot.n_tubes
    options = CheckOptions(unwrap=settings["joints.unwrap"], turns=bag.mapping.joints.turns)
    checks = JointChecks(n, robot, options)
    joints: Samples = []
    poses: Samples = []
    bare: Samples = []  # poses without a usable orientation
    loads: Samples = []
    left, wrong, foreign = 0, "", ""
    start_ns = 0
    for _, log_ns, message in bag.inputs():
        start_ns = start_ns or log_ns
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
            if not value or not finite(value):
                left += 1
                continue
            verdict = checks.check(message.stamp_ns, log_ns or None, value[:n], value[n:])
            if verdict.use == "drop" and any(found.kind is Kind.WRAPPED for found in checks.findings):
                continue  # whole turns are not known
            joints.append((message.stamp_ns, [*(verdict.rotations or value[:n]), *value[n:]]))
        elif isinstance(message, PoseIn):
            if not accepts_frame(message.frame_id, frame):
                foreign = message.frame_id
                continue
            x, y, z, w = message.quaternion_xyzw
            size = norm(message.quaternion_xyzw)
            if finite(message.position) and is_unit(size):
                poses.append((message.stamp_ns, [*message.position, w / size, x / size, y / size, z / size]))
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
    notes = [found.line(start_ns) for found in checks.findings if found.kind is Kind.WRAPPED]
    if left:
        notes.append(f"{left} messages hold values that cannot be used and were left out")
    if wrong and joints:
        notes.append(f"some joint states were left out: {wrong}")
    if foreign:
        notes.append(
            f"poses in frame '{foreign}' were left out, expected '{frame}': if that is the tracker's frame, set tracker.frame_id={foreign}"
        )
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
