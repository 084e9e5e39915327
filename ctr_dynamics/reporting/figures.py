"""Figures over time as inline SVG: lines, bands, dots, limits; small however long the recording is."""

from __future__ import annotations

import io
import itertools
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullFormatter
from numpy.typing import NDArray

from ctr_dynamics.reporting.page import Markup

Floats = NDArray[np.float64]
COLOURS = {
    "fused": "#cf222e",
    "open_loop": "#0969da",
    "tracker": "#8c959f",
    "limit": "#bf8700",
    "other": "#1a7f37",
}
MAX_POINTS = 1200  # of one line; what a figure is wide in pixels
_numbers = itertools.count()


@dataclass
class Line:
    """y (n,) over t (n,); `band` (n,) is drawn on both sides of it."""

    t: Floats
    y: Floats
    label: str
    colour: str
    band: Floats | None = None
    dots: bool = False


@dataclass
class Panel:
    """One set of axes. Horizontal `limits` are (value, label)."""

    ylabel: str
    lines: list[Line] = field(default_factory=list)
    limits: list[tuple[float, str]] = field(default_factory=list)
    shaded: list[tuple[float, float]] = field(default_factory=list)
    log: bool = False

    def line(self, t: Floats, y: Floats, label: str, colour: str, **more: Any) -> Panel:
        """Add a line; returns the panel."""
        self.lines.append(
            Line(np.asarray(t, float), np.asarray(y, float), label, COLOURS.get(colour, colour), **more)
        )
        return self


def thinned(t: Floats, y: Floats, points: int = MAX_POINTS) -> tuple[Floats, Floats]:
    """At most about `points` of a line, so that every peak stays: least and largest of each stretch, in order."""
    if len(t) <= points:
        return t, y
    keep: list[int] = []
    for part in np.array_split(np.arange(len(t)), points // 2):
        values = np.where(np.isfinite(y[part]), y[part], 0.0)
        keep += sorted({int(part[np.argmin(values)]), int(part[np.argmax(values)])})
    return t[keep], y[keep]


def figure_svg(panels: Sequence[Panel], xlabel: str = "time (s)", height: float = 1.9) -> Markup:
    """Panels above each other with one axis of time.

    Args:
        height: of a panel in inches; the width is 10.
    """
    figure = Figure(figsize=(10, height * len(panels) + 0.4), layout="constrained")
    axes = figure.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0]
    for panel, ax in zip(panels, axes, strict=True):
        for begin, end in panel.shaded:
            ax.axvspan(begin, end, color="#cf222e", alpha=0.12, lw=0)
        for line in panel.lines:
            _draw(ax, line)
        for value, label in panel.limits:
            ax.axhline(value, color=COLOURS["limit"], lw=0.9, ls="--", label=label or None)
        ax.set_ylabel(panel.ylabel)
        if panel.log:
            ax.set_yscale("log")
            ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
            ax.yaxis.set_minor_formatter(NullFormatter())
        ax.grid(alpha=0.25)
        ax.margins(x=0.01)
        if ax.get_legend_handles_labels()[0]:
            ax.legend(
                fontsize=8, loc="lower right", bbox_to_anchor=(1, 1), borderaxespad=0, ncols=5, frameon=False
            )
    axes[-1].set_xlabel(xlabel)
    return to_svg(figure)


def _draw(ax: Any, line: Line) -> None:
    if line.dots:
        every = max(1, len(line.t) // (3 * MAX_POINTS))
        ax.plot(line.t[::every], line.y[::every], ".", ms=2.5, color=line.colour, label=line.label)
        return
    if line.band is not None and len(line.t):
        every = max(1, len(line.t) // MAX_POINTS)
        t, y, band = line.t[::every], line.y[::every], line.band[::every]
        ax.fill_between(t, y - band, y + band, color=line.colour, alpha=0.18, lw=0)
    ax.plot(*thinned(line.t, line.y), color=line.colour, lw=1, label=line.label)


def to_svg(figure: Figure) -> Markup:
    """A figure as inline SVG. Its text stays text; its identifiers differ from those of other figures."""
    number = next(_numbers)
    stream = io.StringIO()
    with rc_context({"svg.fonttype": "none", "svg.hashsalt": "ctr_dynamics", "text.parse_math": False}):
        figure.savefig(stream, format="svg", metadata={"Date": None, "Creator": None})
    svg = stream.getvalue()
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    return Markup(re.sub(r'(\bid="|href="#|url\(#)', rf"\g<1>f{number}-", svg))
