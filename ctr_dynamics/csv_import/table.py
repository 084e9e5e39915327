"""Rows of a CSV file: delimiter found, header read, bad rows named and left out."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TextIO

from ctr_dynamics.errors import InputError
from ctr_dynamics.io.text_files import check_regular

MAX_LINE = 100_000  # characters; longer is no log
EXAMPLES = 5  # rows that are named
_DELIMITERS = ",;\t"
_DECIMAL_COMMA = re.compile(r"[-+]?\d*,\d+(?:[eE][-+]?\d+)?")


@dataclass
class Faults:
    """Rows that were left out, the first few by line."""

    count: int = 0
    examples: list[str] = field(default_factory=list)

    def add(self, line: int, why: str) -> None:
        """Count the row of that line, which is left out."""
        self.count += 1
        if len(self.examples) < EXAMPLES:
            self.examples.append(f"line {line}: {why}")

    def __str__(self) -> str:
        more = self.count - len(self.examples)
        return "; ".join([*self.examples, *([f"and {more} more"] if more else [])])


class CsvTable:
    """A CSV file with a header line; blank lines and lines that begin with # are passed over.

    Cells are separated by commas, semicolons, tabs or white space. Between other separators a comma may stand for the decimal point.

    Args:
        path: of the file.
        header_line: number of the line with the names of the columns, from 1; 0 where there is none, and columns are named "1", "2", ..;
            None to find it.

    Attributes:
        header: names of the columns, as written. A name that is there again is followed by #2, #3, ..

    Raises:
        InputError: the file cannot be read, is not text, or has no header.
    """

    def __init__(self, path: Path, header_line: int | None = None) -> None:
        self.path = path
        with self._open() as stream:
            self._first, line = (
                _header_line(stream, path) if header_line is None else _line(stream, path, header_line)
            )
        if not line.strip():
            raise InputError("the file is empty", do="give a CSV file with a header", where=str(path))
        most = max(_DELIMITERS, key=line.count)
        self.delimiter = most if most in line else " "
        cells = self._cells(line)
        self.header = [str(i + 1) for i in range(len(cells))] if header_line == 0 else _distinct(cells)
        if header_line == 0:
            self._first = 0
        elif all(_is_number(cell) for cell in cells):
            raise InputError(
                f"line {self._first} holds numbers, not names of columns",
                do="name the line with the names as header_line in a layout; 0 where there is none, and columns are '1', '2', ..",
                where=str(path),
            )

    def _cells(self, line: str) -> list[str]:
        """Cells of a line.

        Raises:
            ValueError, csv.Error: no row of a CSV file.
        """
        if self.delimiter == " ":
            return line.split()
        [cells] = csv.reader([line.strip("\r\n")], delimiter=self.delimiter)
        return [cell.strip() for cell in cells]

    def _open(self) -> TextIO:
        check_regular(self.path, "give a CSV file")
        try:
            return self.path.open(encoding="utf-8-sig", newline="")
        except OSError as error:
            raise InputError(f"cannot be read ({error.strerror})", where=str(self.path)) from None

    def rows(self, wanted: list[str], faults: Faults) -> Iterator[tuple[int, list[str]]]:
        """Line number and the cells of the columns `wanted`, in that order.

        A row whose wanted cells are all empty is passed over: two logs may share one file.

        Raises:
            InputError: the file is not UTF-8 text.
        """
        places = [self.header.index(name) for name in wanted]
        with self._open() as stream:
            for number, line in enumerate(_lines(stream, self.path), 1):
                if number <= self._first or not line.strip() or line.startswith("#"):
                    continue
                try:
                    cells = self._cells(line)
                except (csv.Error, ValueError):
                    faults.add(number, "is not a row of a CSV file")
                    continue
                spare = any(cells[len(self.header) :])  # an empty one is what a separator at the end leaves
                if spare or len(cells) < len(self.header):
                    commas = spare and self.delimiter == ","
                    hint = " (decimal commas need another separator)" if commas else ""
                    faults.add(number, f"{len(cells)} cells for {len(self.header)} columns{hint}")
                    continue
                chosen = [cells[place] for place in places]
                if self.delimiter != ",":
                    chosen = [
                        cell.replace(",", ".") if _DECIMAL_COMMA.fullmatch(cell) else cell for cell in chosen
                    ]
                if any(chosen[1:]):
                    yield number, chosen


def _header_line(stream: TextIO, path: Path) -> tuple[int, str]:
    """Number and text of the header: the first line, or the last comment before numbers begin."""
    comment = (0, "")
    for number, line in enumerate(_lines(stream, path), 1):
        text = line.strip("\r\n\ufeff")
        if text.startswith("#"):
            comment = (number, text.lstrip("# \t"))
        elif text.strip():
            first = re.split(f"[{_DELIMITERS}]", text)[0]
            return comment if comment[1] and _is_number(first) else (number, text)
    return comment


def _line(stream: TextIO, path: Path, wanted: int) -> tuple[int, str]:
    """Number and text of the line ``wanted``; of the first row where that is 0."""
    for number, line in enumerate(_lines(stream, path), 1):
        if number == wanted or (not wanted and line.strip() and not line.startswith("#")):
            return number, line.strip("\r\n\ufeff").lstrip("# \t" if wanted else "\ufeff")
    raise InputError(
        f"has no line {wanted or 'of numbers'}", do="check header_line in the layout", where=str(path)
    )


def _distinct(cells: list[str]) -> list[str]:
    """The names, each once: those that are there before are followed by #2, #3, .."""
    return [
        name if name not in cells[:i] else f"{name}#{cells[:i].count(name) + 1}"
        for i, name in enumerate(cells)
    ]


def _lines(stream: TextIO, path: Path) -> Iterator[str]:
    """Lines of bounded length."""
    try:
        while line := stream.readline(MAX_LINE):
            if len(line) == MAX_LINE:
                raise InputError(
                    f"has a line of more than {MAX_LINE} characters", do="give a CSV file", where=str(path)
                )
            yield line
    except UnicodeDecodeError as error:
        raise InputError(
            f"not UTF-8 at byte {error.start}", do="save as UTF-8 text", where=str(path)
        ) from None


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
