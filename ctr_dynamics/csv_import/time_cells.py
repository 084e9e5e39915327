"""Cells of a column of time: numbers with a unit, frame numbers with a rate, dates, and times of day."""

from __future__ import annotations

import re
from datetime import datetime, timezone
from decimal import Decimal, InvalidOperation

from ctr_dynamics.csv_import.column_layout import TimeColumn
from ctr_dynamics.errors import InputError
from ctr_dynamics.units import factor

_CLOCK = re.compile(r"(\d{1,2}):(\d{2}):(\d{2}(?:[.,]\d+)?)")
_DATE = re.compile(r"(\d{4}-\d{2}-\d{2}[T ]\d{2}:\d{2}:\d{2})([.,]\d+)?\s*(Z|[-+]\d{2}:\d{2})?")
_DAY = 86400


class TimeCells:
    """Reads the times of one log, row by row.

    Attributes:
        seconds_per_unit: what a time is multiplied by to be in s; text: what it is in, for messages.
    """

    def __init__(self, column: TimeColumn, where: str) -> None:
        self._column, self._where = column, where
        self._kind = ""
        self._days, self._last = 0, Decimal(0)
        self.seconds_per_unit, self.text = Decimal(1), "in s"

    def read(self, cell: str) -> Decimal:
        """The time in a cell.

        Raises:
            InputError: the first cell is a number, and neither unit nor rate are given; or one that counts frames is not whole.
            InvalidOperation: no time of the kind that the first cell was.
        """
        kind = "date" if _DATE.fullmatch(cell) else "clock" if _CLOCK.fullmatch(cell) else "number"
        if not self._kind:
            Decimal(cell) if kind == "number" else None  # a cell that is no time at all decides nothing
            self._kind = kind
            self._begin()
        if kind != self._kind:
            raise InvalidOperation
        if kind == "date":
            return _date(cell)
        if kind == "clock":
            return self._clock(cell)
        number = Decimal(cell)
        if self._column.rate_hz is not None and number.is_finite() and number != number.to_integral_value():
            raise InputError(
                f"column '{self._column.column}' holds {cell[:30]}, and frames have whole numbers",
                do="give the column's unit in place of rate_hz",
                where=self._where,
            )
        return number

    def _begin(self) -> None:
        column = self._column
        if self._kind == "date":
            self.text = "as date and time"
        elif self._kind == "clock":
            self.text = "of day"
        elif column.rate_hz is not None:
            self.seconds_per_unit, self.text = (
                1 / Decimal(repr(column.rate_hz)),
                f"in frames of {column.rate_hz:g} Hz",
            )
        elif not column.unit:
            raise InputError(
                f"column '{column.column}' holds numbers of no stated unit",
                do=f"name it '{column.column} [s]', or give unit or rate_hz in a layout",
                where=self._where,
            )
        else:
            self.seconds_per_unit = Decimal(repr(factor(column.unit, "s", self._where)))
            self.text = f"in {column.unit}"

    def _clock(self, cell: str) -> Decimal:
        """s since the first midnight; a clock that falls by half a day has passed another one."""
        match = _CLOCK.fullmatch(cell)
        assert match is not None
        time = int(match[1]) * 3600 + int(match[2]) * 60 + Decimal(match[3].replace(",", "."))
        if time < self._last - _DAY // 2:
            self._days += 1
        self._last = time
        return time + self._days * _DAY


def _date(cell: str) -> Decimal:
    """s since 1970, UTC unless the cell names an offset."""
    match = _DATE.fullmatch(cell)
    assert match is not None
    try:
        whole = datetime.fromisoformat(match[1] + ("+00:00" if match[3] in (None, "Z") else match[3]))
    except ValueError:
        raise InvalidOperation from None
    since = whole - datetime(1970, 1, 1, tzinfo=timezone.utc)
    return since.days * _DAY + since.seconds + Decimal("0" + (match[2] or ".0").replace(",", "."))
