"""What is in a bag and what is wrong with it: rates, gaps, stamps, clocks, frames, units, numbers.

`inspect` reads a bag once and returns plain facts per topic and a list of problems, each with value, limit,
unit and what to do. It needs no robot: limits are those that hold for any concentric tube robot of laboratory
size.
"""

from __future__ import annotations

import contextlib
from array import array
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.io.bag_checks import FRAME, BagFinding, Inspector, inspector_for
from ctr_dynamics.io.bag_reader import INPUT_TOPICS, Bag, open_bag
from ctr_dynamics.io.inputs.input_decoder import InputDecoder
from ctr_dynamics.io.inputs.input_mapping import InputMapping, cure
from ctr_dynamics.io.messages import cdr
from ctr_dynamics.io.messages.input_types import (
    TF_MESSAGE,
    Decoded,
    accepts_type,
    child_frames,
    has_stamp,
    own_type,
)
from ctr_dynamics.io.messages.topics import JOINT_STATES, TIP_LOAD, TOPIC, TRACKER_TIP

GAP_LIMIT_S = {JOINT_STATES: 0.1, TRACKER_TIP: 0.5}  # the joints' is the default of input_timeout_s
GAP_PERIODS = 3.0  # two lost readings in a row are a gap at any rate; less is jitter, or one lost message
LATE_LIMIT_S = 0.2  # default of filter.window_s
START_LIMIT_S = 0.5
CLOCK_LIMIT_S = 0.5
CLOCK_DIFFERENCE_S = 0.05
_SHOWN_GAPS = 10


@dataclass
class TopicReport:
    """Facts about one topic. Times in s; `first_s` from the bag's first message; stamps are header stamps."""

    name: str
    ros_type: str
    messages: int
    rate_hz: float | None = None
    first_s: float | None = None
    last_s: float | None = None
    longest_gap_s: float | None = None
    gaps: list[dict[str, float]] = field(default_factory=list)
    duplicate_stamps: int = 0
    stamps_backwards: int = 0
    log_minus_stamp_s: dict[str, float] | None = None
    frames: list[str] = field(default_factory=list)
    values: dict[str, Any] = field(default_factory=dict)


@dataclass
class BagReport:
    """Content and problems of a bag."""

    bag: str
    files: list[dict[str, Any]]
    duration_s: float
    start_ns: int
    topics: list[TopicReport]
    problems: list[BagFinding]
    metadata: dict[str, str]

    @property
    def worst(self) -> Literal["ok", "note", "warning", "error"]:
        levels = {finding.level for finding in self.problems}
        for level in ("error", "warning", "note"):
            if level in levels:
                return level
        return "ok"

    def to_dict(self) -> dict[str, Any]:
        """Plain content for JSON."""
        return {**asdict(self), "verdict": self.worst}


class _Times:
    """Log times and header stamps of one topic, in arrival order."""

    def __init__(self, stamped: bool) -> None:
        self.stamped = stamped
        self.log = array("q")
        self.stamp = array("q")
        self.frames: dict[str, int] = {}

    def add(self, log_ns: int, data: bytes) -> None:
        """An output of the product."""
        self.log.append(min(log_ns, 2**63 - 1))
        if self.stamped:
            try:
                self._header(*cdr.decode_header(data))
            except cdr.CdrError:
                return

    def take(self, log_ns: int, message: Decoded) -> None:
        """An input, decoded."""
        self.log.append(min(log_ns, 2**63 - 1))
        if self.stamped:
            self._header(message.stamp_ns, message.frame_id)

    def add_transforms(self, data: bytes, encoding: str) -> None:
        """Frames of the transforms in a message, each from parent to child."""
        with contextlib.suppress(cdr.CdrError):
            for child, pose in child_frames(TF_MESSAGE, encoding, data):
                self._count(f"{pose.frame_id} > {child}")

    def _header(self, stamp_ns: int, frame: str) -> None:
        self.stamp.append(stamp_ns)
        self._count(frame)

    def _count(self, frame: str) -> None:
        if len(self.frames) < 20 or frame in self.frames:
            self.frames[frame] = self.frames.get(frame, 0) + 1


def inspect(path: str | Path, mapping: InputMapping | None = None, pose_frame: str = FRAME) -> BagReport:
    """Read a bag through once.

    Args:
        path: of the bag. mapping: what its topics, names and units mean. pose_frame: the frame that the tracker's poses are in.

    Raises:
        InputError: not a bag, or an input topic of another type or encoding.
    """
    bag = open_bag(path, mapping)
    bag.check_inputs(required=())
    known = bag.topics
    times: dict[str, _Times] = {}
    inspectors: dict[str, Inspector] = {}
    decoder = InputDecoder(bag.mapping)
    transforms = bag.take_transforms(decoder)
    for topic, log_ns, data, ros_type, encoding in bag.typed_messages():
        entry = times.get(topic)
        if entry is None:
            entry = times[topic] = _Times(
                _stamped(topic, known[topic].ros_type if topic in known else ros_type)
            )
        if topic in transforms:
            entry.add(log_ns, data)
            for pose in bag.values(decoder, topic, log_ns, data, ros_type, encoding):
                times[TRACKER_TIP].take(log_ns, pose)
                inspectors[TRACKER_TIP].take(pose)
            continue
        if topic not in INPUT_TOPICS or (ros_type and not accepts_type(topic, ros_type)):
            entry.add(log_ns, data)
            if own_type(ros_type) == TF_MESSAGE:
                entry.add_transforms(data, encoding)
            continue
        inspector = inspectors.setdefault(
            topic, inspector_for(topic, pose_frame if topic == TRACKER_TIP else FRAME)
        )
        try:
            values = decoder.decode(topic, ros_type, encoding, data, log_ns)
        except cdr.CdrError as error:
            inspector.failed(error)
            entry.log.append(min(log_ns, 2**63 - 1))
            continue
        for value in values:
            entry.take(log_ns, value)
            inspector.take(value)
    for rest in decoder.joints.rest():
        times[JOINT_STATES].take(
            times[JOINT_STATES].log[-1] if times[JOINT_STATES].log else rest.stamp_ns, rest
        )
        inspectors[JOINT_STATES].take(rest)
    for pose in decoder.frames.rest():
        times[TRACKER_TIP].take(times[TRACKER_TIP].log[-1] if times[TRACKER_TIP].log else pose.stamp_ns, pose)
        inspectors[TRACKER_TIP].take(pose)
    times = {name: entry for name, entry in times.items() if len(entry.log)}
    starts = [t.log[0] for t in times.values()]
    ends = [t.log[-1] for t in times.values()]
    start_ns = min(starts, default=0)
    problems = [BagFinding("warning", "", note) for note in bag.notes]
    problems += [BagFinding("note", "", note) for note in bag.unchecked]
    problems += [BagFinding("note", JOINT_STATES, note) for note in decoder.joints.notes]
    problems += [BagFinding("note", TRACKER_TIP, note) for note in decoder.frames.notes]
    reports = [
        _topic_report(known[name].ros_type, name, times.get(name), start_ns, problems) for name in known
    ]
    for report in reports:
        if report.name in inspectors:
            report.values = inspectors[report.name].values()
            problems += inspectors[report.name].findings()
    problems += _between_topics(bag, times, reports)
    return BagReport(
        bag=str(bag.path),
        files=[
            {
                "name": f.path.name,
                "bytes": f.size,
                "complete": f.complete,
                "library": f.library,
                "profile": f.profile,
            }
            for f in bag.files
        ],
        duration_s=(max(ends, default=0) - start_ns) * 1e-9,
        start_ns=start_ns,
        topics=reports,
        problems=problems,
        metadata=bag.metadata("ctr_dynamics"),
    )


def _stamped(topic: str, ros_type: str) -> bool:
    """Whether messages begin with a header that is read."""
    if topic in INPUT_TOPICS:
        return has_stamp(ros_type)
    definition = TOPIC.get(topic)
    return definition is not None and definition.has_header and definition.ros_type == ros_type


def _topic_report(
    ros_type: str, name: str, times: _Times | None, start_ns: int, problems: list[BagFinding]
) -> TopicReport:
    report = TopicReport(name, ros_type, len(times.log) if times else 0)
    if times is None:
        return report
    log = np.frombuffer(times.log, dtype=np.int64)
    report.first_s = float(log[0] - start_ns) * 1e-9
    report.last_s = float(log[-1] - start_ns) * 1e-9
    report.frames = sorted(times.frames)
    stamps = np.frombuffer(times.stamp, dtype=np.int64) if len(times.stamp) == len(log) else log
    ordered = np.sort(stamps)
    steps = np.diff(ordered)
    report.duplicate_stamps = int(np.count_nonzero(steps == 0))
    report.stamps_backwards = int(np.count_nonzero(np.diff(stamps) < 0))
    if np.any(steps > 0):
        report.rate_hz = float(1e9 / np.median(steps[steps > 0]))
        report.longest_gap_s = float(steps.max()) * 1e-9
    if stamps is not log:
        offset = (log - stamps) * 1e-9
        report.log_minus_stamp_s = {
            "min": float(offset.min()),
            "median": float(np.median(offset)),
            "max": float(offset.max()),
        }
    if name in INPUT_TOPICS:
        problems += _stamp_findings(report, ordered, stamps, steps)
    return report


def _stamp_findings(
    report: TopicReport, ordered: NDArray[np.int64], stamps: NDArray[np.int64], steps: NDArray[np.int64]
) -> list[BagFinding]:
    name = report.name
    found: list[BagFinding] = []
    limit = GAP_LIMIT_S.get(name)
    if limit is not None:
        # slow streams have no gaps where nothing is lost
        limit = max(limit, GAP_PERIODS / report.rate_hz if report.rate_hz else 0.0)
        wide = np.flatnonzero(steps > limit * 1e9)
        report.gaps = [
            {"at_s": float(ordered[i] - ordered[0]) * 1e-9, "length_s": float(steps[i]) * 1e-9}
            for i in wide[:_SHOWN_GAPS]
        ]
        if wide.size:
            worst = int(wide[np.argmax(steps[wide])])
            found.append(
                BagFinding(
                    "warning",
                    name,
                    f"{wide.size} gaps longer than {limit:.3g} s, the longest {steps[worst] * 1e-9:.3f} s at "
                    f"{(ordered[worst] - ordered[0]) * 1e-9:.3f} s after its first stamp; outputs are "
                    "invalid or open-loop there",
                )
            )
    if report.duplicate_stamps:
        found.append(
            BagFinding(
                "warning", name, f"{report.duplicate_stamps} stamps occur more than once; check the driver"
            )
        )
    if report.stamps_backwards:
        back = -int(np.diff(stamps).min()) * 1e-9
        late = name == TRACKER_TIP and back <= LATE_LIMIT_S
        found.append(
            BagFinding(
                "note" if late else "warning",
                name,
                f"stamps run backwards {report.stamps_backwards} times, by {back:.3f} s at most"
                + (
                    f" (up to {LATE_LIMIT_S:g} s is fused at its own stamp)" if late else "; check the clocks"
                ),
            )
        )
    return found


def _between_topics(bag: Bag, times: dict[str, _Times], reports: list[TopicReport]) -> list[BagFinding]:
    """Problems of topics against each other: missing ones, clocks, start and end."""
    found: list[BagFinding] = []
    by_name = {report.name: report for report in reports}
    for name, level, text in (
        (JOINT_STATES, "error", "not in the bag; nothing can be estimated without it"),
        (TRACKER_TIP, "warning", "not in the bag; only the open loop can run (`replay --no-fusion`)"),
        (TIP_LOAD, "note", "not in the bag; the known load is taken as zero"),
    ):
        if name not in times:
            advice = cure(name, bag.stored_topics) if name not in bag.topics else ""
            text += f"; {advice}" if advice.startswith("if ") else ""
            found.append(BagFinding(level, name, text))  # type: ignore[arg-type]
    for name in (JOINT_STATES, TRACKER_TIP, TIP_LOAD):
        offset = by_name[name].log_minus_stamp_s if name in times else None
        if offset and abs(offset["median"]) > CLOCK_LIMIT_S:
            found.append(
                BagFinding(
                    "warning",
                    name,
                    f"log times are {offset['median']:.3f} s after the stamps (median), limit "
                    f"{CLOCK_LIMIT_S:g} s: driver and recorder use different clocks",
                )
            )
        if offset and name == TRACKER_TIP and offset["max"] - offset["min"] > LATE_LIMIT_S:
            found.append(
                BagFinding(
                    "warning",
                    name,
                    f"the slowest measurement came {offset['max'] - offset['min']:.3f} s later than the "
                    f"quickest, limit {LATE_LIMIT_S:g} s: such measurements are not fused; raise filter.window_s "
                    "or mend the driver",
                )
            )
    joints, tracker = by_name.get(JOINT_STATES), by_name.get(TRACKER_TIP)
    if joints and tracker and joints.log_minus_stamp_s and tracker.log_minus_stamp_s:
        difference = joints.log_minus_stamp_s["median"] - tracker.log_minus_stamp_s["median"]
        if abs(difference) > CLOCK_DIFFERENCE_S:
            found.append(
                BagFinding(
                    "warning",
                    TRACKER_TIP,
                    f"its stamps are {difference:.3f} s ahead of the joints' by arrival, limit "
                    f"{CLOCK_DIFFERENCE_S:g} s; synchronise the clocks or set tracker.delay_s",
                )
            )
        found += _start_and_end(times[JOINT_STATES], times[TRACKER_TIP])
    return found


def _start_and_end(joints: _Times, tracker: _Times) -> list[BagFinding]:
    found: list[BagFinding] = []
    if not joints.stamp or not tracker.stamp:
        return found
    start = (min(tracker.stamp) - min(joints.stamp)) * 1e-9
    end = (max(joints.stamp) - max(tracker.stamp)) * 1e-9
    if abs(start) > START_LIMIT_S:
        side = "after" if start > 0 else "before"
        found.append(
            BagFinding(
                "warning",
                TRACKER_TIP,
                f"starts {abs(start):.3f} s {side} the joints, limit {START_LIMIT_S:g} s; "
                + (
                    "the model runs in open loop until then"
                    if start > 0
                    else "earlier measurements are not used"
                ),
            )
        )
    if end > START_LIMIT_S:
        found.append(
            BagFinding(
                "warning", TRACKER_TIP, f"ends {end:.3f} s before the joints, limit {START_LIMIT_S:g} s"
            )
        )
    return found
