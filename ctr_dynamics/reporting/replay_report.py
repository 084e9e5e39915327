"""The report of a replay: traces before and after fusion, innovations, NIS, step times, the backbone's motion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics import chi_square
from ctr_dynamics.io.messages.cdr import PoseIn
from ctr_dynamics.parameters import PARAMETERS
from ctr_dynamics.reporting.animation import add_animation
from ctr_dynamics.reporting.figures import Panel, figure_svg
from ctr_dynamics.reporting.page import Page
from ctr_dynamics.sensing.tracker_tips import tracker_tips

if TYPE_CHECKING:
    from ctr_dynamics.estimation.step_output import Innovation, StepOutput
    from ctr_dynamics.sensing.tracker import TrackerModel

Floats = NDArray[np.float64]
SHAPES_HZ = 30.0
BAND = 2.0  # deviations
STEP_MS = 3.0
_AXES = "xyz"


@dataclass
class ReplayLog:
    """What a report needs of every step; backbones only as often as they are shown."""

    tracker: TrackerModel
    first_ns: int | None = None
    t: list[float] = field(default_factory=list)
    fused: list[Floats] = field(default_factory=list)
    sigma: list[Floats] = field(default_factory=list)
    open_loop: list[Floats] = field(default_factory=list)
    force: list[Floats] = field(default_factory=list)
    force_sigma: list[Floats] = field(default_factory=list)
    valid: list[bool] = field(default_factory=list)
    innovations: list[Innovation] = field(default_factory=list)
    shapes: list[tuple[float, Floats]] = field(default_factory=list)
    turned: list[Floats] = field(default_factory=list)
    poses: list[PoseIn] = field(default_factory=list)
    _next_shape_ns: int = 0

    def step(self, out: StepOutput) -> None:
        """Take in one step."""
        if self.first_ns is None:
            self.first_ns = out.stamp_ns
        t = (out.stamp_ns - self.first_ns) * 1e-9
        nothing = np.full(3, np.nan)
        self.t.append(t)
        self.valid.append(out.valid)
        self.innovations += out.innovations
        good = out.valid
        self.fused.append(np.array(out.tip_position) if good else nothing)
        variance = np.diag(out.tip_covariance)[:3] if good else nothing
        self.sigma.append(np.sqrt(np.maximum(variance, 0.0)))
        self.open_loop.append(np.array(out.predicted_position) if good else nothing)
        self.turned.append(np.array(out.predicted_quaternion_wxyz) if good else np.full(4, np.nan))
        self.force.append(np.array(out.disturbance_force) if good else nothing)
        self.force_sigma.append(np.array(out.disturbance_sigma) if good else nothing)
        if good and out.stamp_ns >= self._next_shape_ns:
            self._next_shape_ns = out.stamp_ns + round(1e9 / SHAPES_HZ)
            self.shapes.append((t, out.backbone[:, 1:4].astype(float)))

    def pose(self, pose: PoseIn) -> None:
        """Take in one tracker measurement."""
        self.poses.append(pose)

    def samples(self) -> tuple[Floats, Floats]:
        """Times (s,) s and positions (s, 3) m of the tip in `ctr_base` that the usable tracker measurements show."""

        def turned(t: float) -> Floats:
            return self.turned[min(int(np.searchsorted(self.t, t)), len(self.t) - 1)]

        return tracker_tips(self.poses, self.first_ns or 0, self.tracker, turned)


def replay_page(log: ReplayLog, summary: dict[str, Any], step_times_s: Sequence[float]) -> Page:
    """The report.

    Args:
        log: filled by a replay with at least one step.
        summary: content of summary.json.
        step_times_s: (steps,) s spent on each step.
    """
    names = ", ".join(item["name"] for item in summary["inputs"])
    page = Page(f"Replay of {names}")
    page.paragraph(
        f"Robot {summary['robot']['name']}, {summary['steps']} steps of 3 ms, {summary['duration_s']:.2f} s."
    )
    _verdict(page, summary)
    page.table(_figures_of(summary))
    t, fused, open_loop, sigma = (
        np.array(log.t),
        np.array(log.fused),
        np.array(log.open_loop),
        np.array(log.sigma),
    )
    sample_t, sample_p = log.samples()
    dark = _stretches(t, np.array(log.valid))
    page.heading("Backbone")
    _animation(page, log, t, open_loop, sample_t, sample_p)
    page.heading("Tip before and after fusion")
    traces = []
    for i, axis in enumerate(_AXES):
        panel = Panel(f"tip {axis} (mm)", shaded=dark)
        panel.line(sample_t, 1e3 * sample_p[:, i], "tracker", "tracker", dots=True)
        panel.line(t, 1e3 * open_loop[:, i], "open loop", "open_loop")
        panel.line(t, 1e3 * fused[:, i], "fused", "fused", band=BAND * 1e3 * sigma[:, i])
        traces.append(panel)
    page.figure(
        figure_svg(traces),
        "Position of the tip in ctr_base. The band is two standard deviations as published; red stretches are invalid. "
        "Tracker measurements are taken to the tip by the robot file's registration, lever arm and delay.",
    )
    inside = (sample_t >= t[0]) & (sample_t <= t[-1]) if len(sample_t) else np.zeros(0, bool)
    if inside.any():
        page.heading("Distance from the tracker")
        page.figure(
            figure_svg(_residual_panels(t, fused, open_loop, sigma, sample_t[inside], sample_p[inside])),
            _RESIDUAL_CAPTION,
        )
    _innovations(page, log.innovations, log.first_ns or 0)
    page.heading("Unknown tip force")
    force, force_sigma = np.array(log.force), np.array(log.force_sigma)
    panels = [
        Panel(f"{axis} (mN)").line(
            t, 1e3 * force[:, i], "estimate", "fused", band=BAND * 1e3 * force_sigma[:, i]
        )
        for i, axis in enumerate(_AXES)
    ]
    page.figure(
        figure_svg(panels, height=1.4),
        "Estimated force on the tip beside the known load, with two standard deviations.",
    )
    page.heading("Time per step")
    spent = 1e3 * np.asarray(step_times_s, float)
    if len(spent) == len(t):
        panel = Panel("ms", limits=[(STEP_MS, "real time, 3 ms")], log=True).line(
            t, spent, "time spent", "open_loop"
        )
        page.figure(
            figure_svg([panel]),
            "Time that each step took on this machine, roll-back for late measurements included.",
        )
    _provenance(page, summary)
    return page


_RESIDUAL_CAPTION = (
    "Tracker measurement minus tip at its time, before fusion (open loop) and after. The band is two standard deviations of the fused "
    "tip; the tracker's own noise comes on top."
)


def _verdict(page: Page, summary: dict[str, Any]) -> None:
    """What a reader should know before the figures."""
    nis = summary["nis"]
    if nis.get("mean") is not None and nis.get("within") is False:
        page.paragraph(
            f"NIS per degree of freedom is {nis['mean']:.3f}, outside {nis['lower95']:.3f} to {nis['upper95']:.3f}: "
            + (
                "the tracker is noisier than stated, its delay or frame is wrong, or the model misses something."
                if nis["mean"] > nis["upper95"]
                else "the stated noise is too large."
            ),
            "warning",
        )
    for stretch in summary["invalid"]["stretches"]:
        page.paragraph(
            f"Invalid from {stretch['from_s']:.3f} s to {stretch['to_s']:.3f} s: {stretch['reason']}", "error"
        )
    for note in summary["notes"]:
        page.paragraph(note, "note")


def _figures_of(summary: dict[str, Any]) -> list[tuple[str, Any]]:
    residual, nis, step = summary["residual_rms_m"], summary["nis"], summary["step_ms"]

    def millimetres(value: float | None) -> str:
        return "-" if value is None else f"{1e3 * value:.3f} mm"

    return [
        ("residual rms, open loop", millimetres(residual.get("predicted"))),
        ("residual rms, fused", millimetres(residual.get("fused"))),
        ("NIS per degree of freedom", nis.get("mean")),
        (
            "tracker measurements rejected, late, dropped",
            f"{summary['rejected']}, {summary['late']}, {summary['dropped']}",
        ),
        ("invalid steps", summary["invalid"]["steps"]),
        ("steps that failed", summary["solver"]["failures"]),
        ("time per step", f"p50 {step['p50']:.2f} ms, p99 {step['p99']:.2f} ms, max {step['max']:.2f} ms"),
        ("times real time", summary["realtime_ratio"]),
    ]


def _stretches(t: Floats, valid: NDArray[np.bool_]) -> list[tuple[float, float]]:
    """(from, to) in s where steps are invalid."""
    edges = np.flatnonzero(np.diff(np.concatenate([[True], valid, [True]]).astype(int)))
    return [(t[a], t[min(b, len(t) - 1)]) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def _at(t: Floats, values: Floats, when: Floats) -> Floats:
    return np.stack([np.interp(when, t, values[:, i]) for i in range(3)], axis=1)


def _residual_panels(
    t: Floats, fused: Floats, open_loop: Floats, sigma: Floats, sample_t: Floats, sample_p: Floats
) -> list[Panel]:
    before, after = sample_p - _at(t, open_loop, sample_t), sample_p - _at(t, fused, sample_t)
    panels = []
    for i, axis in enumerate(_AXES):
        panel = Panel(f"{axis} (mm)")
        panel.line(sample_t, 1e3 * before[:, i], "open loop", "open_loop")
        panel.line(sample_t, 1e3 * after[:, i], "fused", "fused", dots=True)
        zero = np.zeros(len(t))
        panel.line(t, zero, "", "fused", band=BAND * 1e3 * np.nan_to_num(sigma[:, i]))
        panels.append(panel)
    return panels


def _innovations(page: Page, found: list[Innovation], first_ns: int) -> None:
    page.heading("Innovations")
    usable = [item for item in found if item.dof > 0 and np.isfinite(item.nis)]
    if not usable:
        page.paragraph("No tracker measurement was compared with the model.")
        return
    t = np.array([(item.stamp_ns - first_ns) * 1e-9 for item in usable])
    order = np.argsort(t, kind="stable")
    t = t[order]
    residual = np.array([usable[k].residual for k in order])
    deviation = np.sqrt(np.array([usable[k].variance for k in order]))
    panels = []
    for i, name in enumerate(("x (mm)", "y (mm)", "z (mm)", "rx (deg)", "ry (deg)", "rz (deg)")):
        if np.isfinite(residual[:, i]).any():
            factor = 1e3 if i < 3 else float(np.degrees(1.0))
            panel = Panel(name).line(t, factor * residual[:, i], "", "open_loop", dots=True)
            panel.line(
                t, np.zeros(len(t)), "", "tracker", band=BAND * factor * np.nan_to_num(deviation[:, i])
            )
            panels.append(panel)
    page.figure(
        figure_svg(panels, height=1.25),
        "Measured minus expected pose of each measurement, with two standard deviations as the filter expects them. About 95 % of the dots "
        "lie within.",
    )
    page.heading("NIS")
    nis = np.array([usable[k].nis / usable[k].dof for k in order])
    accepted = np.array([usable[k].accepted for k in order])
    dof = round(float(np.median([item.dof for item in usable])))
    limits = [(chi_square.quantile(p, dof) / dof, label) for p, label in ((0.025, "95 %"), (0.975, ""))]
    panel = Panel("NIS / dof", limits=limits, log=True)
    panel.line(t[accepted], nis[accepted], "fused", "open_loop", dots=True)
    if not accepted.all():
        panel.line(t[~accepted], nis[~accepted], "rejected", "fused", dots=True)
    page.figure(
        figure_svg([panel]),
        f"Normalised innovation squared per degree of freedom, with the band that holds 95 % of a consistent filter's ({dof} degrees).",
    )
    reasons: dict[str, int] = {}
    for item in found:
        if item.reason:
            reasons[item.reason] = reasons.get(item.reason, 0) + 1
    if reasons:
        page.table(
            sorted(reasons.items(), key=lambda entry: -entry[1])[:20],
            header=("why measurements were rejected or marked", "measurements"),
        )


def _animation(
    page: Page, log: ReplayLog, t: Floats, open_loop: Floats, sample_t: Floats, sample_p: Floats
) -> None:
    if not log.shapes:
        page.paragraph("No valid step.")
        return
    times = np.array([when for when, _ in log.shapes])
    tips = _at(t, np.nan_to_num(open_loop), times)
    nearest: list[Floats | None] = []
    for when in times:
        k = int(np.argmin(np.abs(sample_t - when))) if len(sample_t) else -1
        nearest.append(sample_p[k] if k >= 0 and abs(sample_t[k] - when) < 0.05 else None)
    add_animation(page, times, [points for _, points in log.shapes], list(tips), nearest)
    page.paragraph(
        "Fused backbone (red) with its tip's last second, tip in open loop (blue), tracker (grey)."
    )


def _provenance(page: Page, summary: dict[str, Any]) -> None:
    page.heading("Provenance")
    page.table([(item["name"], item["sha256"]) for item in summary["inputs"]], header=("file", "SHA-256"))
    page.table(
        [
            ("robot", summary["robot"]["source"] or summary["robot"]["name"]),
            ("SHA-256", summary["robot"]["sha256"]),
        ]
    )
    defaults = {p.name: list(p.default) if isinstance(p.default, tuple) else p.default for p in PARAMETERS}
    changed = [(name, value) for name, value in summary["parameters"].items() if value != defaults.get(name)]
    page.table(changed or [("none", "")], header=("parameter that is not at its default", "value"))
