"""Replay: a recorded bag through the estimator, without a ROS graph and as fast as it goes.

The estimator gets the messages in the order of their arrival (log time, ties by topic name), and all of one arrival time before a step is taken.
So a replay does what a node would have done, and repeats to the last bit.
"""

from __future__ import annotations

import contextlib
import json
import math
import time
from array import array
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ctr_dynamics import __version__
from ctr_dynamics.estimation.monitoring.statuses import all_statuses, snap_ahead
from ctr_dynamics.io.atomic_files import atomic_file, check_targets
from ctr_dynamics.io.bag_reader import Bag, InputMessage, open_bag
from ctr_dynamics.io.bag_writer import BagWriter, write_bag
from ctr_dynamics.io.messages.cdr import JointStateIn, PoseIn
from ctr_dynamics.io.messages.topics import JOINT_STATES
from ctr_dynamics.parameters import Settings, input_mapping
from ctr_dynamics.robot import Robot
from ctr_dynamics.robot_files import load_robot
from ctr_dynamics.runtime.clock_offset import ClockOffset, RisingStamps
from ctr_dynamics.runtime.garbage_collection import rare_garbage_collection
from ctr_dynamics.runtime.input_gate import InputGate
from ctr_dynamics.runtime.joint_rate import with_joint_rate
from ctr_dynamics.runtime.replay_notes import AFTER_NS, no_step, replay_notes, shortfall
from ctr_dynamics.runtime.step_encoder import StepEncoder
from ctr_dynamics.runtime.transform_encoder import transform_encoder
from ctr_dynamics.sensing.tracker_parameters import with_robot_file

if TYPE_CHECKING:
    from ctr_dynamics.estimation.estimator import Estimator, StepOutput
    from ctr_dynamics.reporting.replay_report import ReplayLog

MakeEstimator = Callable[[Robot, Settings], "Estimator"]
Progress = Callable[[float, int], None]
_MAX_STRETCHES = 100


@dataclass
class ReplayResult:
    """Outcome of a replay.

    Attributes:
        summary: the content of summary.json.
        notes: on unusual inputs, one line for each kind.
        shortfall: why next to nothing was estimated, in one line; empty where something was.
    """

    summary: dict[str, Any]
    notes: list[str] = field(default_factory=list)
    shortfall: str = ""

    @property
    def failures(self) -> int:
        """Steps that the solver could not take."""
        return int(self.summary["solver"]["failures"])


def last_joints(bag: Bag) -> tuple[int, int]:
    """Last stamp and last log time of the joint states, ns; outliers far ahead are left out."""
    clock = ClockOffset(own=False)
    last_ns = last_log_ns = 0
    for _, log_ns, message in bag.inputs({JOINT_STATES}):
        if clock.sample(message.stamp_ns, log_ns):
            last_ns, last_log_ns = max(last_ns, message.stamp_ns), log_ns
    return last_ns, last_log_ns


def arrivals(messages: Iterator[InputMessage]) -> Iterator[list[InputMessage]]:
    """Messages grouped by arrival time."""
    group: list[InputMessage] = []
    for item in messages:
        if group and item.log_ns != group[0].log_ns:
            yield group
            group = []
        group.append(item)
    if group:
        yield group


class Player:
    """Feeds an estimator from a bag, through the checks of its inputs, and yields its steps."""

    def __init__(self, estimator: Estimator) -> None:
        self.estimator = estimator
        self._gate = InputGate(estimator)
        estimator.step_times_s = array("d")
        self.joint_names: set[str] = set()
        self.unused = 0  # messages that came too long after the last joints
        self.joints_cover_ns = 0  # time between the joint states' arrivals, gaps over a second left out
        self._joints_log_ns: int | None = None
        self._clock = ClockOffset(own=False)
        self._now_ns: int | None = None
        self._last_ns = 0  # the last joint stamp
        self._call_times_s = array("d")

    def times_s(self) -> Sequence[float]:
        """Time spent on each step, in s, roll-back included.

        From the estimator's own account (`step_times_s`) when it has one of every step; else steps that came
        from one call share its time.
        """
        own = self.estimator.step_times_s
        return own if own is not None and len(own) == len(self._call_times_s) else self._call_times_s

    def play(self, bag: Bag) -> Iterator[StepOutput]:
        """Steps in order, to the last joint stamp."""
        self._last_ns, last_log_ns = last_joints(bag)
        for group in arrivals(bag.inputs()):
            log_ns = group[0].log_ns
            if log_ns > last_log_ns + AFTER_NS:
                self.unused += len(group)
                continue
            # the steps that a live node would have taken before these messages came
            yield from self._advance(log_ns - 1)
            for item in group:
                self._add(item)
            yield from self._advance(log_ns)
        yield from self._timed(self.estimator.finish)

    def _add(self, item: InputMessage) -> None:
        message = item.message
        if isinstance(message, JointStateIn):
            if self._joints_log_ns is not None and item.log_ns - self._joints_log_ns < 1_000_000_000:
                self.joints_cover_ns += max(0, item.log_ns - self._joints_log_ns)
            self._joints_log_ns = item.log_ns
            if len(self.joint_names) < 100:
                self.joint_names.update(message.names[:100])
            given = self._gate.joint_state(message, item.log_ns)
            if given is None:
                return
            if self._clock.sample(given.stamp_ns, item.log_ns):
                self.estimator.add_joint_state(given.stamp_ns, given.names, given.positions)
            else:
                rejection = self._clock.rejection(given.stamp_ns, item.log_ns)
                self.estimator.health.note("joints", "far ahead", rejection)
        elif isinstance(message, PoseIn):
            self._gate.give_pose(message, item.log_ns)
        else:
            load = self._gate.load(message, item.log_ns)
            if load is not None:
                self.estimator.add_tip_load(load.stamp_ns, load.force, load.torque, load.frame_id)

    def _advance(self, log_ns: int) -> Iterator[StepOutput]:
        """Take the steps due at that log time. Time goes back only where the clock of the stamps was set back."""
        if self._clock.known:
            now_ns = self._clock.at(log_ns)
            if self._now_ns is not None and 0 < self._now_ns - now_ns <= self._clock.limit_ns:
                now_ns = self._now_ns
            self._now_ns = now_ns
            until_ns = min(now_ns + self.estimator.lead_ns, self._last_ns)
            yield from self._timed(partial(self.estimator.advance, until_ns))

    def _timed(self, call: Callable[[], list[StepOutput]]) -> Iterator[StepOutput]:
        begin = time.perf_counter()
        steps = call()
        if steps:
            spent = (time.perf_counter() - begin) / len(steps)
            self._call_times_s.extend([spent] * len(steps))
            yield from steps
            self.estimator.do_idle_work()


class _InvalidStretches:
    """Stretches of invalid steps, for the summary."""

    def __init__(self) -> None:
        self.steps = 0
        self.stretches: list[dict[str, Any]] = []
        self._previous = -2

    def add(self, out: StepOutput, first_ns: int) -> None:
        if out.valid:
            return
        self.steps += 1
        now = (out.stamp_ns - first_ns) * 1e-9
        last = self.stretches[-1] if self.stretches else None
        if last is not None and out.k == self._previous + 1 and last["reason"] == out.reason:
            last["to_s"] = now
        elif len(self.stretches) < _MAX_STRETCHES:
            self.stretches.append({"from_s": now, "to_s": now, "reason": out.reason})
        self._previous = out.k


def plain(value: Any) -> Any:
    """The value for JSON: NumPy numbers as plain ones, and null for what is not finite."""
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple, np.ndarray)):
        return [plain(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def replay(
    bag: str | Path | Bag,
    robot: Robot | str | Path,
    settings: Settings | Mapping[str, Any] | None = None,
    output: str | Path | None = None,
    summary: str | Path | None = None,
    progress: Progress | None = None,
    make_estimator: MakeEstimator | None = None,
    report: str | Path | None = None,
) -> ReplayResult:
    """Run a recorded bag through the estimator, without a ROS graph and as fast as it goes.

    Args:
        bag: a file or folder, read as the ``joints`` and ``tracker`` settings say, or an opened bag.
        robot: a robot, the name of a shipped one, or a robot file.
        settings: parameters: all of them, or those that differ from replay's defaults. These are the node's, with ``output.policy`` ``wait``.
        output: MCAP file to write every output topic to; None for none. Files appear only when the
            replay ends well.
        summary: JSON file for the summary; None for none.
        progress: called now and then with the fraction done and the number of steps.
        make_estimator: another estimator with the same interface.
        report: HTML file for the report; None for none.

    Returns:
        The content of summary.json, and what was odd about the inputs.

    Raises:
        InputError: an input that cannot be used, or no step at all.

    Example:
        >>> from ctr_dynamics import replay
        >>> from ctr_dynamics.io.shipped_bags import shipped_bag
        >>> result = replay(shipped_bag(), "till2020_tissue", {"model.nodes": 12})
        >>> result.summary["steps"], result.failures
        (1997, 0)
        >>> result.summary["residual_rms_m"]["fused"] < result.summary["residual_rms_m"]["predicted"]  # 3-D, m
        True
    """
    if not isinstance(settings, Settings):
        settings = Settings({"output.policy": "wait", **(settings or {})})
    if not isinstance(robot, Robot):
        robot = load_robot(robot)
    settings = with_robot_file(settings, robot)
    mapping = input_mapping(settings)
    opened = bag if isinstance(bag, Bag) else open_bag(bag, mapping)
    opened.read_for(robot.n_tubes, mapping.mount_xyzw)
    opened.check_inputs()
    settings, rate_note = with_joint_rate(opened, settings)
    settings = settings.replace({"robot": robot.source or robot.name})
    read = {"bag" if i == 0 else f"bag's part {i + 1}": file.path for i, file in enumerate(opened.files)}
    check_targets(
        {"output": output, "summary": summary, "report": report}, {**read, "robot file": robot.source}
    )
    inputs = opened.sha256()
    provenance = {
        "version": __version__,
        "robot": {"name": robot.name, "source": robot.source, "sha256": robot.sha256},
        "inputs": [{"name": name, "sha256": digest} for name, digest in inputs.items()],
        "parameters": settings.as_dict(),
    }
    with contextlib.ExitStack() as stack:
        writer: BagWriter | None = None
        if output is not None:
            writer = stack.enter_context(write_bag(Path(output), _metadata(provenance)))
        summary_part = stack.enter_context(atomic_file(Path(summary))) if summary is not None else None
        make = make_estimator or _warm_estimator(robot, settings)
        report_part = stack.enter_context(atomic_file(Path(report))) if report is not None else None
        estimator = make(robot, settings)
        log = _report_log(estimator, opened) if report_part is not None else None
        stack.enter_context(rare_garbage_collection())
        numbers, times_s = _run(opened, estimator, robot, settings, writer, progress, log)
        notes = [*([rate_note] if rate_note else []), *replay_notes(opened, settings, numbers)]
        content = plain({**numbers, **provenance, "notes": notes})
        if summary_part is not None:
            text = json.dumps(content, indent=1, allow_nan=False, ensure_ascii=False)
            # a name that is not UTF-8 is escaped as JSON does it
            summary_part.write_text(text + "\n", encoding="utf-8", errors="backslashreplace")
        if report_part is not None and log is not None:
            from ctr_dynamics.reporting.replay_report import replay_page

            page = replay_page(log, content, times_s).text()
            report_part.write_text(page, encoding="utf-8", errors="backslashreplace")
    return ReplayResult(content, notes, shortfall(opened, settings, numbers))


def _warm_estimator(robot: Robot, settings: Settings) -> MakeEstimator:
    """The estimator, with everything compiled and loaded before the clock starts."""
    # Imported late: it brings the compiled model, which reading and checking a bag do not need.
    from ctr_dynamics.estimation.estimator import Estimator
    from ctr_dynamics.runtime.warm_up import warm_up

    warm_up(robot, settings)
    return Estimator


def _report_log(estimator: Estimator, bag: Bag) -> ReplayLog:
    """What a report collects, with the bag's tracker measurements in it."""
    from ctr_dynamics.reporting.replay_report import ReplayLog  # brings the plotting library

    log = ReplayLog(estimator.tracker)
    for item in bag.inputs():
        if isinstance(item.message, PoseIn):
            log.pose(item.message)
    return log


def _run(
    bag: Bag,
    estimator: Estimator,
    robot: Robot,
    settings: Settings,
    writer: BagWriter | None,
    progress: Progress | None,
    log: ReplayLog | None,
) -> tuple[dict[str, Any], Sequence[float]]:
    """The replay itself; returns the numbers of the summary and the time spent on each step, s."""
    encoder = StepEncoder(
        settings["output.frame_id"],
        robot.name,
        settings["output.backbone_every"],
        transform_encoder(settings, robot),
    )
    player = Player(estimator)
    invalid = _InvalidStretches()
    steps = withheld = 0
    stamps = RisingStamps()
    first_ns = last_ns = 0
    span_ns = bag.span_ns[1] - bag.span_ns[0]
    begin = time.perf_counter()
    for out in player.play(bag):
        if not stamps.passes(out.stamp_ns):
            withheld += 1
            continue
        if steps == 0:
            first_ns = out.stamp_ns
        last_ns = out.stamp_ns
        steps += 1
        invalid.add(out, first_ns)
        if log is not None:
            log.step(out)
        if writer is not None:
            for message in encoder.encode(
                out, lambda: all_statuses(estimator.health), snap_ahead(estimator.health)
            ):
                writer.write(message.topic, message.stamp_ns, message.data)
        if progress is not None and steps % 50 == 0:
            progress(min(1.0, (last_ns - first_ns) / span_ns) if span_ns > 0 else 1.0, steps)
    wall_s = time.perf_counter() - begin
    if steps == 0:
        raise no_step(bag, robot, player.joint_names, estimator.summary()["input_problems"]["joints"])
    duration_s = (last_ns - first_ns) * 1e-9
    p50, p99, worst = np.percentile(np.array(player.times_s()) * 1e3, (50, 99, 100))
    numbers = {
        **estimator.summary(),
        "steps": steps,
        "withheld": withheld,
        "unused": player.unused,
        "duration_s": duration_s,
        "joints_cover_s": player.joints_cover_ns * 1e-9,
        "wall_s": wall_s,
        "realtime_ratio": duration_s / wall_s,
        "step_ms": {"p50": p50, "p99": p99, "max": worst},
        "invalid": {"steps": invalid.steps, "stretches": invalid.stretches},
        "malformed": dict(bag.malformed),
    }
    return numbers, player.times_s()


def _metadata(provenance: dict[str, Any]) -> dict[str, str]:
    """Provenance as the text entries of an MCAP metadata record."""
    return {
        key: value if isinstance(value, str) else json.dumps(plain(value), sort_keys=True)
        for key, value in provenance.items()
    }
