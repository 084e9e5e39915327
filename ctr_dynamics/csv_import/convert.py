"""CSV logs to the messages of a bag: stamps, units, frames and what is wrong with them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics import __version__
from ctr_dynamics.csv_import.column_layout import (
    EULER,
    FORCE,
    MATRIX,
    POSITION,
    QUATERNION,
    TORQUE,
    Kind,
    Layout,
    Source,
    check_complete,
    layout_of_header,
    si_unit,
)
from ctr_dynamics.csv_import.frame_clock import times_of_frames
from ctr_dynamics.csv_import.orientations import with_quaternions
from ctr_dynamics.csv_import.table import CsvTable, Faults
from ctr_dynamics.csv_import.time_cells import TimeCells
from ctr_dynamics.errors import InputError
from ctr_dynamics.io.bag_checks import FRAME, BagFinding, inspector_for
from ctr_dynamics.io.bag_reader import InputMessage, sha256_of
from ctr_dynamics.io.bag_writer import write_bag
from ctr_dynamics.io.messages import topics
from ctr_dynamics.io.messages.cdr import decode_joint_state, decode_pose_stamped, decode_wrench_stamped
from ctr_dynamics.io.messages.encode import encode_joint_state, encode_pose_stamped, encode_wrench_stamped
from ctr_dynamics.io.messages.input_types import Decoded
from ctr_dynamics.io.messages.unit_quaternions import WRITTEN_WITHIN
from ctr_dynamics.kernels.rotations import conjugate, from_vector, matrix, multiply
from ctr_dynamics.robot import Robot
from ctr_dynamics.sensing.checks import Kind as Fault
from ctr_dynamics.sensing.checks.input_checks import check_messages
from ctr_dynamics.units import factor

Floats = NDArray[np.float64]
TOPIC_OF: dict[Kind, str] = {
    "joints": topics.JOINT_STATES,
    "tracker": topics.TRACKER_TIP,
    "load": topics.TIP_LOAD,
}
DECODERS: dict[str, Callable[[bytes], Decoded]] = {
    topics.JOINT_STATES: decode_joint_state,
    topics.TRACKER_TIP: decode_pose_stamped,
    topics.TIP_LOAD: decode_wrench_stamped,
}
_KIND_OF: dict[str, Kind] = {"joints": "joints", "tracker": "tracker", "load": "load"}
# The other checks of a log have a line on these; gaps are what the rows left out leave.
_SAID_BEFORE = {Fault.NOT_FINITE, Fault.QUATERNION, Fault.OUT_OF_RANGE, Fault.CLOCK_OFFSET, Fault.GAP}
RELATIVE_BELOW_S = 1_000_000  # a clock below is no system clock
RELATIVE_START_S = 1_000_000_000  # stamps of such logs begin about here; a stamp must not be negative
MAX_STAMP_S = 2**31 - 1  # what a ROS stamp holds
RATES_HZ = {"joints": (5.0, 5000.0), "tracker": (1.0, 2000.0), "load": (0.0, 1e5)}
ALIKE = 0.1  # of the rows: times that stand still so often have been rounded. A driver that repeats itself now and then has fewer


@dataclass
class Log:
    """One log in SI units: `stamp_ns` (n,), `values` (n, columns) named by `names`."""

    kind: Kind
    names: list[str]
    stamp_ns: list[int]
    values: Floats
    faults: Faults
    notes: list[str] = field(default_factory=list)

    def column(self, name: str) -> Floats:
        return self.values[:, self.names.index(name)]

    def columns(self, names: tuple[str, ...]) -> Floats:
        """(n, len(names)); an absent group is an error of the caller."""
        return np.stack([self.column(name) for name in names], axis=1)


def read_log(kind: Kind, path: Path, layout: Layout, frame: str) -> Log:
    """Read one CSV log.

    Args:
        kind: what it holds.
        layout: columns; without an entry for `kind` they are found by the header.
        frame: frame of poses and wrenches where the layout names none.

    Raises:
        InputError: unreadable, columns or units missing, no usable row, or a frame that cannot be used.
    """
    given: Source | None = getattr(layout, kind)
    where = str(path)
    table = CsvTable(path, None if given is None else given.header_line)
    source = given or layout_of_header(kind, table.header, where)
    check_complete(kind, source, table.header, where)
    names = sorted(source.values)
    scales = []
    for name in names:
        column = source.values[name]
        unit = 1.0 if si_unit(name) == "1" else factor(column.unit, si_unit(name), where)
        scales.append((column.scale * unit, column.offset * unit))
    faults = Faults()
    times: list[Decimal] = []
    rows: list[list[float]] = []
    lines: list[int] = []
    last, alike = Decimal("-Infinity"), 0
    wanted = [source.time.column, *(source.values[name].column for name in names)]
    if source.time.frames:
        wanted.append(source.time.frames)
    if source.status is not None:
        wanted.append(source.status.column)
    frames: list[float] = []
    clock = TimeCells(source.time, where)
    for number, cells in table.rows(wanted, faults):
        if source.status is not None and (status := cells.pop()) not in source.status.good:
            faults.add(number, f"{source.status.column} is '{status[:20]}'")
            continue
        try:
            # the host may stamp several frames alike, and late ones: the device knows their order
            number_of_frame = float(cells.pop()) if source.time.frames else None
            time = clock.read(cells[0])
            order = time if number_of_frame is None else Decimal(number_of_frame)
            row = [
                scale * float(cell) + offset for cell, (scale, offset) in zip(cells[1:], scales, strict=True)
            ]
        except InputError:
            raise
        except (InvalidOperation, ValueError):
            bad = next((cell for cell in cells[1:] if not _finite(cell)), cells[0])
            faults.add(number, f"'{bad[:20]}' is not a number")
            continue
        if not (time.is_finite() and order.is_finite()) or not all(map(math.isfinite, row)):
            faults.add(number, "holds a NaN or an infinity")
        elif abs(time) > MAX_STAMP_S * 10**9:
            faults.add(number, f"time {cells[0][:30]} is too large")
        elif order <= last:
            what = f"time {cells[0][:30]}" if number_of_frame is None else f"frame {number_of_frame:g}"
            faults.add(number, f"{what} is not later than the row before")
            alike += order == last
        else:
            times.append(time)
            rows.append(row)
            lines.append(number)
            last = order
            if number_of_frame is not None:
                frames.append(number_of_frame)
    if not rows:
        raise InputError(
            f"no usable row ({faults.count} left out; {faults if faults.count else 'no rows at all'})",
            do="mend the file",
            where=where,
        )
    if alike > ALIKE * (len(rows) + alike):
        raise InputError(
            f"{alike} of {len(rows) + alike} rows have the time of the row before",
            do="write times with all their digits, at least to the millisecond",
            where=where,
        )
    log = Log(kind, names, [], np.array(rows), faults)
    if source.time.frames:
        times, note = times_of_frames(times, frames, float(clock.seconds_per_unit), where)
        log.notes.append(note)
    log.stamp_ns = _stamps(times, source, log, where, clock)
    if kind == "tracker":
        _orientation(log, lines, where)
    if kind != "joints":
        _into_base(log, source, frame, where)
    return log


def _finite(cell: str) -> bool:
    try:
        return math.isfinite(float(cell))
    except ValueError:
        return False


def _stamps(times: list[Decimal], source: Source, log: Log, where: str, clock: TimeCells) -> list[int]:
    """Stamps in ns; logs on a clock that begins near zero are moved to a positive system time."""
    per_unit = clock.seconds_per_unit * 10**9
    start = source.time.start_s
    if start is None:
        first_s = times[0] * per_unit / 10**9
        start = RELATIVE_START_S if abs(first_s) < RELATIVE_BELOW_S else 0
        if start:
            log.notes.append(
                f"{where}: time begins at {float(first_s):g} s, no system clock; {start} s are added to every stamp"
            )
    shift = Decimal(repr(start)) * 10**9
    stamps = [int((time * per_unit + shift).to_integral_value()) for time in times]
    if stamps[0] < 0 or stamps[-1] > MAX_STAMP_S * 10**9:
        raise InputError(
            f"stamps run from {stamps[0] * 1e-9:g} s to {stamps[-1] * 1e-9:g} s, outside 0 to {MAX_STAMP_S} s",
            do="check the unit of time, or set start_s in the layout (-2082844800 for seconds since 1904, -2208988800 since 1900)",
            where=where,
        )
    if len(stamps) > 2:
        rate = 1e9 / max(float(np.median(np.diff(stamps))), 1e-9)
        low, high = RATES_HZ[log.kind]
        if not low <= rate <= high:
            raise InputError(
                f"{log.kind} come at {rate:.4g} Hz, outside {low:g} to {high:g} Hz, with time {clock.text}",
                do="check the unit of time",
                where=where,
            )
    return stamps


def _orientation(log: Log, lines: list[int], where: str) -> None:
    """Unit quaternions; without any, identities and a word about it."""
    if QUATERNION[0] not in log.names and (MATRIX[0] in log.names or EULER[0] in log.names):
        log.names, log.values = with_quaternions(log.names, log.values)
    if QUATERNION[0] not in log.names:
        log.names = [*log.names, *QUATERNION]
        log.values = np.hstack([log.values, np.tile([0.0, 0.0, 0.0, 1.0], (len(log.values), 1))])
        log.notes.append(
            f"{where}: no orientation; identities are written, so replay with --set tracker.axes=xyz"
        )
        return
    places = [log.names.index(name) for name in QUATERNION]
    norms = np.linalg.norm(log.values[:, places], axis=1)
    good = np.abs(norms - 1.0) <= WRITTEN_WITHIN
    if not good.any():
        raise InputError(
            f"quaternions have norms {norms.min():g} to {norms.max():g}, 1 +- {WRITTEN_WITHIN:g} is needed",
            do="check which columns are qx, qy, qz, qw (ROS order; qw is the scalar)",
            where=where,
        )
    for index in np.flatnonzero(~good):
        log.faults.add(lines[index], f"quaternion of norm {norms[index]:g}")
    log.values = log.values[good]
    log.stamp_ns = [stamp for stamp, keep in zip(log.stamp_ns, good, strict=True) if keep]
    log.values[:, places] /= norms[good][:, None]


def _into_base(log: Log, source: Source, frame: str, where: str) -> None:
    """Poses and wrenches in `ctr_base`.

    Raises:
        InputError: the frame is not stated, or is another one and its registration is not given.
    """
    if source.frame and frame and source.frame != frame:
        raise InputError(
            f"--frame says '{frame}' and the layout '{source.frame}'", do="leave one of them out", where=where
        )
    frame = source.frame or frame
    rotation, translation = source.registration_rotation_rad, source.registration_translation_m
    if not frame:
        raise InputError(
            "the frame of the poses is not stated"
            if log.kind == "tracker"
            else "the frame of the forces is not stated",
            do=f"say --frame {FRAME} if they are in the base frame or the robot file holds the registration; else give "
            "frame and registration in the layout",
            where=where,
        )
    if frame == FRAME:
        if rotation is not None or translation is not None:
            raise InputError(
                f"both frame {FRAME} and a registration are given", do="leave one of them out", where=where
            )
        return
    if rotation is None or (translation is None and log.kind == "tracker"):
        raise InputError(
            f"poses are in frame '{frame}', not in {FRAME}",
            do=f"give registration_rotation_rad and registration_translation_m of {FRAME} in '{frame}' in the layout",
            where=where,
        )
    h = from_vector(np.array(rotation))
    R = matrix(h)
    if log.kind == "tracker":
        _set(log, POSITION, (log.columns(POSITION) - np.array(translation)) @ R)
        turned = np.array([multiply(conjugate(h), q[[3, 0, 1, 2]]) for q in log.columns(QUATERNION)])
        _set(log, QUATERNION, turned[:, [1, 2, 3, 0]])
    else:
        for group in (FORCE, TORQUE):
            if group[0] in log.names:
                _set(log, group, log.columns(group) @ R)


def _set(log: Log, names: tuple[str, ...], values: Floats) -> None:
    log.values[:, [log.names.index(name) for name in names]] = values


def messages(log: Log) -> Iterator[tuple[int, str, bytes]]:
    """(stamp ns, topic, serialised message) of every row."""
    encode: Callable[[int, Floats], bytes]
    if log.kind == "joints":
        names = log.names

        def encode(stamp: int, row: Floats) -> bytes:
            return encode_joint_state(stamp, names, row.tolist())
    elif log.kind == "tracker":
        order = [log.names.index(name) for name in POSITION + QUATERNION]

        def encode(stamp: int, row: Floats) -> bytes:
            numbers = row[order].tolist()
            return encode_pose_stamped(stamp, FRAME, numbers[:3], numbers[3:])
    else:
        force = [log.names.index(name) for name in FORCE]
        torque = [log.names.index(name) for name in TORQUE] if TORQUE[0] in log.names else []

        def encode(stamp: int, row: Floats) -> bytes:
            return encode_wrench_stamped(
                stamp, FRAME, row[force].tolist(), row[torque].tolist() if torque else [0.0, 0.0, 0.0]
            )

    for stamp, row in zip(log.stamp_ns, log.values, strict=True):
        yield stamp, TOPIC_OF[log.kind], encode(stamp, row)


def check(logs: list[Log], robot: Robot | None) -> list[BagFinding]:
    """Units, signs, ranges and clocks of the logs, as `ctr-dynamics info` would find them; with a robot its
    actuators' range too."""
    found: list[BagFinding] = []
    for log in logs:
        inspector = inspector_for(TOPIC_OF[log.kind])
        for _, _, data in messages(log):
            inspector.add(data)
        found += inspector.findings()
    joints = next(log for log in logs if log.kind == "joints")
    for log in logs:
        begin, end = joints.stamp_ns[0], joints.stamp_ns[-1]
        inside = sum(begin <= stamp <= end for stamp in log.stamp_ns)
        if log.kind == "tracker" and inside < 0.5 * len(log.stamp_ns):
            text = (
                f"{inside} of {len(log.stamp_ns)} poses lie in the time of the joints ({begin * 1e-9:.3f} s to {end * 1e-9:.3f} s; "
                f"poses {log.stamp_ns[0] * 1e-9:.3f} s to {log.stamp_ns[-1] * 1e-9:.3f} s): both logs need one clock; "
                "start_s of a log's time in the layout moves it"
            )
            found.append(BagFinding("error", topics.TRACKER_TIP, text))
    if robot is not None:
        found += _actuator_findings(joints, robot)
    return found + _input_faults(logs, robot)


def _input_faults(logs: list[Log], robot: Robot | None) -> list[BagFinding]:
    """What replay and node would leave out or mend of these logs; none of it keeps the bag from being written."""
    recorded = sorted((stamp, topic, data) for log in logs for stamp, topic, data in messages(log))
    inputs = (InputMessage(topic, stamp, DECODERS[topic](data)) for stamp, topic, data in recorded)
    begin = recorded[0][0]
    return [
        BagFinding(
            "note" if found.level == "note" else "warning",
            TOPIC_OF[_KIND_OF[found.stream]],
            found.line(begin),
        )
        for found in check_messages(inputs, robot)
        if found.kind not in _SAID_BEFORE
    ]


def _actuator_findings(joints: Log, robot: Robot) -> list[BagFinding]:
    """Joints outside the range of the robot's actuators."""
    expected = sorted(
        f"tube{n}_{axis}" for n in range(1, robot.n_tubes + 1) for axis in ("rotation", "translation")
    )
    if sorted(joints.names) != expected:
        text = f"joints {', '.join(sorted(joints.names))}; robot '{robot.name}' has {', '.join(expected)}"
        return [BagFinding("error", topics.JOINT_STATES, text)]
    betas = joints.columns(tuple(f"tube{n}_translation" for n in range(1, robot.n_tubes + 1)))
    problems = [problem for beta in betas if (problem := robot.actuator_problem(beta.tolist()))]
    if not problems:
        return []
    text = (
        f"{len(problems)} of {len(betas)} rows are outside the range of robot '{robot.name}': {problems[0]}"
    )
    return [BagFinding("error", topics.JOINT_STATES, text)]


def write(path: Path, logs: list[Log], sources: list[Path], robot: Robot | None) -> int:
    """Write the bag; returns the number of messages. The same logs give the same bytes.

    Raises:
        InputError: the file cannot be written.
    """
    metadata = {
        "version": __version__,
        "imported_from": ", ".join(f"{source.name} sha256 {sha256_of(source)}" for source in sources),
        "robot": robot.name if robot else "",
    }
    listed = sorted(message for log in logs for message in messages(log))
    with write_bag(path, metadata) as bag:
        for stamp, topic, data in listed:
            bag.write(topic, stamp, data)
    return len(listed)
