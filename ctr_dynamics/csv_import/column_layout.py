"""Which column holds what and in which unit: from the header itself, or from a layout file in YAML."""

from __future__ import annotations

import re
from difflib import get_close_matches
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, FiniteFloat, ValidationError, field_validator

from ctr_dynamics.errors import InputError
from ctr_dynamics.io.text_files import decode_text, read_bytes
from ctr_dynamics.io.yaml_files import read_yaml
from ctr_dynamics.robot.quantity import Block, problem, problem_line
from ctr_dynamics.units import factor, units_of

Kind = Literal["joints", "tracker", "load"]
POSITION, QUATERNION = ("x", "y", "z"), ("qx", "qy", "qz", "qw")
MATRIX = ("m00", "m01", "m02", "m10", "m11", "m12", "m20", "m21", "m22")
EULER = ("roll", "pitch", "yaw")
FORCE, TORQUE = ("fx", "fy", "fz"), ("mx", "my", "mz")
_JOINT = re.compile(r"tube[1-9]_(rotation|translation)")
_FRAME = ("frame", "framenumber", "frame_number", "frame number")
_AGAIN = re.compile(r"(.+)#(\d+)")  # a name that has been there before
_TIME = ("t", "time", "stamp", "timestamp")
_ALIASES = {"tx": "x", "ty": "y", "tz": "z", "px": "x", "py": "y", "pz": "z", "q0": "qw"}
_BRACKETS = re.compile(r"(.+?)\s*[\[(]\s*(.+?)\s*[\])]")
Vector = Annotated[list[FiniteFloat], Field(min_length=3, max_length=3)]


class Column(Block):
    """A column of the file: the value is (scale * cell + offset), in `unit`."""

    column: str
    unit: str = ""
    scale: FiniteFloat = 1.0
    offset: FiniteFloat = 0.0

    @field_validator("scale")
    @classmethod
    def _not_zero(cls, scale: float) -> float:
        if not scale:
            raise problem(
                "0 makes every value the offset; write the factor from the cell to the value, such as -1"
            )
        return scale


class TimeColumn(Block):
    """The column of time; `start_s` is added to it, in s.

    `rate_hz`: instead of a unit, where the column counts frames. `frames`: another column with frame numbers, about which the times scatter.
    Cells such as 2023-11-14T22:13:20.012 or 22:13:20.012 need neither unit nor rate: the first are taken for UTC unless they name an offset, the
    second go on over midnight.
    """

    column: str
    unit: str = ""
    rate_hz: Annotated[FiniteFloat, Field(gt=0)] | None = None
    start_s: FiniteFloat | None = None
    frames: str = ""


class Status(Block):
    """A column that says which rows hold a measurement: those whose cell is one of `good`."""

    column: str
    good: list[str] = Field(default_factory=lambda: ["OK"], min_length=1)


class Source(Block):
    """Columns of one kind of log.

    Attributes:
        time: column of the stamp.
        status: column that says which rows count; None where all do.
        header_line: line with the names of the columns, from 1; 0 for a file without them, whose columns are then '1', '2', ..
        values: name (`tube1_rotation`, `x`, `qw`, `fx`, ..) to its column.
        frame: frame that poses and wrenches are given in.
        registration_rotation_rad: (3,) rotation vector of `ctr_base` in that frame, rad.
        registration_translation_m: (3,) origin of `ctr_base` in that frame, m.
    """

    time: TimeColumn
    values: dict[str, Column]
    status: Status | None = None
    header_line: Annotated[int, Field(ge=0)] | None = None
    frame: str = ""
    registration_rotation_rad: Vector | None = None
    registration_translation_m: Vector | None = None


class Layout(Block):
    """A layout file."""

    joints: Source | None = None
    tracker: Source | None = None
    load: Source | None = None


def si_unit(name: str) -> str:
    """SI unit of a value; "1" for components of a quaternion."""
    if _JOINT.fullmatch(name):
        return "rad" if name.endswith("rotation") else "m"
    for names, unit in (
        (POSITION, "m"),
        (QUATERNION, "1"),
        (MATRIX, "1"),
        (EULER, "rad"),
        (FORCE, "N"),
        (TORQUE, "N m"),
    ):
        if name in names:
            return unit
    raise KeyError(name)


def known(kind: Kind, name: str) -> bool:
    """Whether a log of that kind has a value of that name."""
    names = {"tracker": POSITION + QUATERNION + MATRIX + EULER, "load": FORCE + TORQUE, "joints": ()}[kind]
    return name in names or (kind == "joints" and _JOINT.fullmatch(name) is not None)


def read_layout(path: Path) -> Layout:
    """A layout file.

    Raises:
        InputError: unreadable, an unknown key or value, or a unit that is none.
    """
    data = read_yaml(decode_text(read_bytes(path), str(path)), str(path))
    try:
        layout = Layout.model_validate(data)
    except ValidationError as error:
        raise InputError(problem_line(error), do="see docs/data.md", where=str(path)) from None
    for kind in ("joints", "tracker", "load"):
        source: Source | None = getattr(layout, kind)
        for name, column in (source.values if source else {}).items():
            if not known(kind, name):
                raise InputError(
                    f"{kind}.values holds '{name}'", do=f"known names: {_names(kind)}", where=str(path)
                )
            if si_unit(name) != "1":
                _check_unit(column.unit, name, f"{path}: {kind}.values.{name}")
    return layout


def layout_of_header(kind: Kind, header: list[str], where: str) -> Source:
    """Columns by their names: `tube1_rotation [deg]` or `tube1_rotation_deg`, `x [mm]`, `time [s]`, `qw`, ...

    Raises:
        InputError: no column of time, two columns for one value, or a column that needs a unit and names none.
    """
    time: TimeColumn | None = None
    values: dict[str, Column] = {}

    def only(cell: str, before: TimeColumn | Column | None, what: str) -> None:
        if before is not None:
            raise InputError(
                f"columns '{before.column}' and '{cell}' are both {what}",
                do="leave one of them, or give --layout",
                where=where,
            )

    for cell in header:
        again = _AGAIN.fullmatch(cell)
        name, unit = _split(again[1] if again else cell)
        if again and (known(kind, name) or name in _TIME):
            raise InputError(
                f"column '{again[1]}' is there {again[2]} times",
                do="leave one of them, or give --layout",
                where=where,
            )
        if name in _TIME:
            if unit:
                factor(unit, "s", f"{where}: column '{cell}'")
            only(cell, time, "the time")
            time = TimeColumn(column=cell, unit=unit)
        elif known(kind, name):
            if si_unit(name) != "1":
                _check_unit(unit, name, f"{where}: column '{cell}'")
            only(cell, values.get(name), name)
            values[name] = Column(column=cell, unit=unit)
    if time is None:
        raise InputError(f"no column of time among {_some(header)}", do=_time_cure(header), where=where)
    return Source(time=time, values=values)


def _check_unit(unit: str, name: str, where: str) -> None:
    """That a column of the value ``name`` has a unit of its kind.

    Raises:
        InputError: it has another one, or none.
    """
    si = si_unit(name)
    if not unit:
        raise InputError("has no unit", do=f"write one of {', '.join(units_of(si))}", where=where)
    factor(unit, si, where)


def _time_cure(header: list[str]) -> str:
    """What to do about a header without a column of time."""
    frames = [cell for cell in header if _split(cell)[0] in _FRAME]
    if frames:
        return (
            f"if '{frames[0]}' counts frames, give --layout with time: {{column: {frames[0]}, rate_hz: RATE}}"
        )
    return "name it 'time [s]', or give --layout; header_line in it says which line has the names"


def check_complete(kind: Kind, source: Source, header: list[str], where: str) -> None:
    """Every named column is there, and every needed value has one.

    Raises:
        InputError: the first that is not.
    """
    extra = [] if source.status is None else [source.status.column]
    if source.time.frames:
        extra.append(source.time.frames)
    for column in (source.time.column, *extra, *(column.column for column in source.values.values())):
        if column not in header:
            near = get_close_matches(column, header, 1)
            hint = f"did you mean '{near[0]}'?" if near else f"the file has {_some(header)}"
            raise InputError(f"no column '{column}'", do=hint, where=where)
    used: dict[str, str] = {}
    for name, given in source.values.items():
        if given.column in used:
            raise InputError(
                f"column '{given.column}' is that of {used[given.column]} and of {name}",
                do="name one column for each",
                where=where,
            )
        used[given.column] = name
    names = set(source.values)
    if kind == "joints":
        numbers = {int(name[4]) for name in names}
        needed = {
            f"tube{n}_{axis}"
            for n in range(1, max(numbers, default=1) + 1)
            for axis in ("rotation", "translation")
        }
    else:
        needed = set(POSITION if kind == "tracker" else FORCE)
        for group in (QUATERNION, MATRIX, EULER, TORQUE):
            needed |= set(group) if names & set(group) else set()
    missing = sorted(needed - names)
    if missing:
        raise InputError(
            f"no column for {', '.join(missing)} among {_some(header)}",
            do=f"name them so with their unit, e.g. '{missing[0]} [{units_of(si_unit(missing[0]))[-1]}]', or give --layout",
            where=where,
        )


def _split(cell: str) -> tuple[str, str]:
    """Name in lower case and unit of a column's name; the unit is empty when there is none."""
    match = _BRACKETS.fullmatch(cell)
    if match is not None:
        name, unit = match[1], match[2]
    else:
        name, _, unit = cell.rpartition("_")
        if not name or unit in ("rotation", "translation"):
            name, unit = cell, ""
    name = name.strip().lower()
    return _ALIASES.get(name, name), unit


def _names(kind: Any) -> str:
    if kind == "joints":
        return "tube1_rotation, tube1_translation, tube2_rotation, .."
    return ", ".join(POSITION + QUATERNION + MATRIX + EULER if kind == "tracker" else FORCE + TORQUE)


def _some(header: list[str]) -> str:
    return ", ".join(f"'{name}'" for name in header[:12]) + (", .." if len(header) > 12 else "")
