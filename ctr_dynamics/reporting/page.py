"""One HTML file with everything in it. All text is escaped; only `Markup`, which this package makes itself, is not.

The page carries a content security policy that allows its own style and its own scripts by their hashes and nothing else: no
network, no further script, whatever text was put in.
"""

from __future__ import annotations

import base64
import hashlib
import json
import math
from collections.abc import Sequence
from html import escape
from typing import Any

from ctr_dynamics import __version__

_STYLE = """
:root { color-scheme: light; }
body { font: 15px/1.5 system-ui, "DejaVu Sans", sans-serif; color: #1b1f24; background: #fff; max-width: 1080px; margin: 2em auto; padding: 0 1em; }
h1 { font-size: 1.6em; margin-bottom: 0.2em; } h2 { font-size: 1.2em; margin-top: 2em; border-bottom: 1px solid #d0d7de; }
table { border-collapse: collapse; margin: 0.8em 0; } th, td { text-align: left; padding: 0.2em 1.2em 0.2em 0; vertical-align: top; }
th { font-weight: 600; } tr + tr > * { border-top: 1px solid #eaeef2; } td.number { font-variant-numeric: tabular-nums; text-align: right; }
figure { margin: 1em 0; } figure svg, figure img { width: 100%; height: auto; } figcaption { color: #57606a; font-size: 0.92em; }
.note { border-left: 4px solid #0969da; } .warning { border-left: 4px solid #bf8700; } .error { border-left: 4px solid #cf222e; }
.note, .warning, .error { padding: 0.3em 0.8em; margin: 0.6em 0; background: #f6f8fa; }
pre { background: #f6f8fa; padding: 0.6em; overflow-x: auto; } footer { color: #57606a; margin-top: 3em; font-size: 0.9em; }
canvas { width: 100%; border: 1px solid #d0d7de; } .controls { display: flex; gap: 0.8em; align-items: center; } .controls input { flex: 1; }
"""


class Markup(str):
    """HTML that is put into the page as it is."""

    __slots__ = ()


def cell(value: Any) -> Markup:
    """Escaped text of anything; numbers that are not finite become a dash."""
    if isinstance(value, Markup):
        return value
    if value is None or (isinstance(value, float) and not math.isfinite(value)):
        return Markup("-")
    return Markup(escape(f"{value:.4g}" if isinstance(value, float) else str(value)))


class Page:
    """A page that is filled from top to bottom.

    Args:
        title: of the page, shown as its first heading.
    """

    def __init__(self, title: str) -> None:
        self.title = title
        self._body: list[str] = []
        self._scripts: list[str] = []
        self._names: set[str] = set()

    def heading(self, text: str, level: int = 2) -> None:
        self._body.append(f"<h{level:d}>{escape(text)}</h{level:d}>")

    def paragraph(self, text: str, kind: str = "") -> None:
        """Text; `kind` note, warning or error puts it into a box."""
        mark = f' class="{escape(kind)}"' if kind else ""
        self._body.append(f"<p{mark}>{cell(text)}</p>")

    def preformatted(self, text: str) -> None:
        self._body.append(f"<pre>{escape(text)}</pre>")

    def table(self, rows: Sequence[Sequence[Any]], header: Sequence[str] = ()) -> None:
        """A table; without a header the first column holds the names of the rows."""
        lines = ["<table>"]
        if header:
            lines.append("<tr>" + "".join(f"<th>{cell(name)}</th>" for name in header) + "</tr>")
        for row in rows:
            first, *others = row
            tag = "td" if header else "th"
            lines.append(
                f"<tr><{tag}>{cell(first)}</{tag}>"
                + "".join(_data_cell(item, bool(header)) for item in others)
                + "</tr>"
            )
        self._body.append("\n".join([*lines, "</table>"]))

    def figure(self, content: Markup, caption: str) -> None:
        """A figure with its caption; see `figures.figure_svg` and `png`."""
        self._body.append(f"<figure>{content}<figcaption>{cell(caption)}</figcaption></figure>")

    def add(self, content: Markup) -> None:
        """Markup of this package's own."""
        self._body.append(content)

    def data(self, name: str, value: Any) -> None:
        """Data for a script, as a JSON block with the id `name`.

        Raises:
            ValueError: the name is taken, or a number is not finite.
        """
        if name in self._names:
            raise ValueError(f"the page has data '{name}' already")
        self._names.add(name)
        text = json.dumps(value, separators=(",", ":"), allow_nan=False)
        for sign in "<>&":  # nothing in it may end the block
            text = text.replace(sign, f"\\u{ord(sign):04x}")
        self._body.append(f'<script type="application/json" id="{escape(name)}">{text}</script>')

    def script(self, code: str) -> None:
        """A script of this package's own, run when the page is complete."""
        if "</script" in code.lower():
            raise ValueError("a script cannot hold its own end")
        self._scripts.append(code)

    def text(self) -> str:
        """The page as HTML."""
        hashes = " ".join(
            f"'sha256-{base64.b64encode(hashlib.sha256(code.encode()).digest()).decode()}'"
            for code in self._scripts
        )
        policy = f"default-src 'none'; style-src 'unsafe-inline'; img-src data:; script-src {hashes or chr(39) + 'none' + chr(39)}"
        return "\n".join(
            [
                "<!DOCTYPE html>",
                '<html lang="en"><head><meta charset="utf-8">',
                f'<meta http-equiv="Content-Security-Policy" content="{policy}">',
                '<meta name="viewport" content="width=device-width, initial-scale=1">',
                f"<title>{escape(self.title)}</title><style>{_STYLE}</style></head><body>",
                f"<h1>{escape(self.title)}</h1>",
                *self._body,
                f"<footer>ctr_dynamics {escape(__version__)}</footer>",
                *(f"<script>{code}</script>" for code in self._scripts),
                "</body></html>\n",
            ]
        )


def _data_cell(item: Any, aligned: bool) -> str:
    number = aligned and isinstance(item, (int, float)) and not isinstance(item, bool)
    return f"<td{' class=number' if number else ''}>{cell(item)}</td>"
