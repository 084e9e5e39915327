"""Sentence lengths of the documentation: `python -m tools.prose` lists the pages and fails on long sentences.

A page passes while its mean sentence has at most 20 words and none has more than 40. Headings, code blocks, indented equations and
generated blocks are left out. Cells of tables count towards the longest sentence and not towards the mean, since most are fragments.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

MEAN_LIMIT = 20.0
LONGEST_LIMIT = 40
PAGES = ("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "docs/*.md", "msg_docs/*.md", "examples/**/*.md")

_GENERATED = re.compile(r"<!-- (\w+): generated -->.*?<!-- \1: end -->", re.DOTALL)
_FENCE = re.compile(r"^ *```.*?^ *```[^\n]*$", re.DOTALL | re.MULTILINE)
_ITEM = re.compile(r"^ *(?:[-*+]|\d+\.) +")
_RULE = re.compile(r"^\s*\|[\s|:-]+\|\s*$")
_LINK = re.compile(r"!?\[([^\]]*)\]\([^)]*\)")
_CODE = re.compile(r"`[^`]*`")
_ABBREVIATION = re.compile(r"\b(al|Fig|Figs|Eq|Eqs|Sec|No|vs|e\.g|i\.e|cf|approx)\.(?= )")
_END = re.compile(r"(?<=[.!?])[)\"'*_]*\s+(?=[\"'(\[*_]*[A-Z0-9_`])")
_WORD = re.compile(r"[A-Za-z0-9]")


@dataclass(frozen=True)
class Sentence:
    """One sentence.

    Attributes:
        text: as written, without links and markup.
        words: how many words it has; a piece of code is one word.
        in_table: whether it stands in a cell of a table.
    """

    text: str
    words: int
    in_table: bool


@dataclass(frozen=True)
class Lengths:
    """Lengths of the sentences of one page.

    Attributes:
        sentences: sentences outside tables.
        mean: their mean number of words; 0 for a page without any.
        long: sentences with more than `LONGEST_LIMIT` words, tables included.
    """

    sentences: int
    mean: float
    long: tuple[Sentence, ...]

    @property
    def passes(self) -> bool:
        """Whether the page keeps both limits."""
        return self.mean <= MEAN_LIMIT and not self.long


def prose(text: str) -> str:
    """A page without headings, code blocks, generated blocks and comments."""
    text = re.sub(r"<!--.*?-->", "\n", _FENCE.sub("\n", _GENERATED.sub("\n", text)), flags=re.DOTALL)
    kept: list[str] = []
    indented = True  # whether an indented line here is a block of code or an equation
    for line in text.splitlines():
        if line.startswith("#"):
            kept.append("")
            indented = True
        elif indented and line.startswith("    ") and not _ITEM.match(line):
            kept.append("")
        else:
            kept.append(line)
            indented = not line.strip()
    return "\n".join(kept)


def paragraphs(text: str) -> Iterator[tuple[str, bool]]:
    """Paragraphs, list items and cells of tables, each with whether it is a cell."""
    current: list[str] = []
    for line in [*prose(text).splitlines(), ""]:
        if line.lstrip().startswith("|"):
            if not _RULE.match(line):
                yield from (
                    (cell.strip(), True) for cell in line.strip().strip("|").split(" | ") if cell.strip()
                )
        elif line.strip() and not _ITEM.match(line):
            current.append(line.strip())
            continue
        if current:
            yield " ".join(current), False
        current = [_ITEM.sub("", line).strip()] if _ITEM.match(line) else []


def sentences(text: str) -> Iterator[Sentence]:
    """All sentences of a page in Markdown."""
    for paragraph, in_table in paragraphs(text):
        plain = _CODE.sub(
            lambda code: f"`{re.sub(r'[^A-Za-z0-9_]', '', code[0]) or 'code'}`", _LINK.sub(r"\1", paragraph)
        )
        plain = _ABBREVIATION.sub(r"\1", plain)
        for piece in _END.split(plain):
            count = sum(1 for word in piece.split() if _WORD.search(word))
            if count:
                yield Sentence(piece, count, in_table)


def lengths(text: str) -> Lengths:
    """Sentence lengths of a page in Markdown."""
    found = list(sentences(text))
    counted = [sentence.words for sentence in found if not sentence.in_table]
    return Lengths(
        len(counted),
        sum(counted) / len(counted) if counted else 0.0,
        tuple(sentence for sentence in found if sentence.words > LONGEST_LIMIT),
    )


def pages(root: Path) -> list[Path]:
    """Every page below `root` that the limits hold for."""
    return [path for pattern in PAGES for path in sorted(root.glob(pattern))]


def main(argv: list[str] | None = None) -> int:
    """Print the lengths of every page; 1 when one exceeds a limit."""
    parser = argparse.ArgumentParser(prog="python -m tools.prose", description=__doc__)
    parser.add_argument("--root", type=Path, default=Path(), help="the source tree")
    parser.add_argument("--all", action="store_true", help="print the pages that pass, too")
    options = parser.parse_args(argv)
    failed = False
    for path in pages(options.root):
        found = lengths(path.read_text(encoding="utf-8"))
        failed |= not found.passes
        if options.all or not found.passes:
            name = path.relative_to(options.root)
            print(f"{name}: {found.sentences} sentences, mean {found.mean:.1f} words, limit {MEAN_LIMIT:g}")
        for sentence in found.long:
            print(f"  {sentence.words} words, limit {LONGEST_LIMIT}: {sentence.text}")
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
