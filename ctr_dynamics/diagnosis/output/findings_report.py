"""Findings report: report.html of a diagnosis, one page that opens offline. First the verdict in sentences, then what they rest on."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.signal import periodogram

from ctr_dynamics.diagnosis.diagnosis_result import Diagnosis
from ctr_dynamics.diagnosis.inference.candidates import Candidate
from ctr_dynamics.diagnosis.inference.map_fit import Fit
from ctr_dynamics.diagnosis.inference.residual_tests import by_axis
from ctr_dynamics.diagnosis.inference.separation import separation
from ctr_dynamics.diagnosis.output.summary_text import summary
from ctr_dynamics.diagnosis.whitening import noise_floor
from ctr_dynamics.effects import EFFECTS
from ctr_dynamics.io.atomic_files import atomic_file
from ctr_dynamics.reporting.figures import Panel, figure_svg, to_svg
from ctr_dynamics.reporting.page import Page

Floats = NDArray[np.float64]
AXES = "xyz"
NOMINAL = "#8250df"


def write_report(path: Path, diagnosis: Diagnosis, content: dict[str, Any]) -> None:
    """Write the page."""
    page = Page(f"Diagnosis of {', '.join(r.name for r in diagnosis.recordings)}")
    first, *others = summary(content)
    page.paragraph(
        first, "note" if diagnosis.verdict in ("clean", "named", "named_with_remainder") else "warning"
    )
    for text in others:
        page.paragraph(text)
    for text in content["notes"]:
        page.paragraph(text, "warning")
    if (
        diagnosis.problem is not None
        and diagnosis.recalibrated is not None
        and diagnosis.extended is not None
    ):
        _traces(page, diagnosis)
        _unexplained(page, diagnosis)
        _evidence(page, diagnosis)
        _rivals(page, diagnosis)
        _validation(page, diagnosis)
        _whiteness(page, diagnosis, diagnosis.recalibrated, diagnosis.extended)
        _values(page, diagnosis.extended)
    _learned(page, content)
    _scope(page, content)
    with atomic_file(path) as part:
        part.write_text(page.text(), encoding="utf-8", errors="backslashreplace")


def _traces(page: Page, d: Diagnosis) -> None:
    models = zip(d.recordings, d.residual_nominal, d.residual_recalibrated, d.residual_extended, strict=True)
    for recording, first, left, rest in models:
        t = recording.stamps
        as_in_file, before, after = (recording.position - r[:, :3] for r in (first, left, rest))
        band = np.full(len(t), 2e3 * noise_floor(d.robot) / np.sqrt(3.0))
        page.heading(f"Measured and simulated: {recording.name}")
        panels, errors = [], []
        for i, axis in enumerate(AXES):
            panels.append(
                Panel(f"{axis} (mm)")
                .line(t, 1e3 * recording.position[:, i], "tracker", "tracker", dots=True)
                .line(t, 1e3 * as_in_file[:, i], "nominal", NOMINAL)
                .line(t, 1e3 * before[:, i], "re-calibrated", "open_loop")
                .line(t, 1e3 * after[:, i], "extended", "fused", band=band)
            )
            explained = 1e3 * (after - before)[:, i]
            errors.append(
                Panel(f"{axis} (mm)")
                .line(t, 1e3 * left[:, i], "residual, re-calibrated", "tracker", dots=True)
                .line(t, explained, "what the causes explain", "fused")
                .line(t, 1e3 * rest[:, i], "residual, extended", "other", dots=True)
            )
        page.figure(
            figure_svg(panels),
            "Tip position in the tracker's axes; the band is two standard deviations of the tracker's noise.",
        )
        page.figure(figure_svg(errors), "Residuals, with what the causes explain of them.")
        page.figure(
            _loops(recording.joints, t, left, rest),
            "Residual length over each tube's angle: loops point to friction and backlash.",
        )
        page.figure(_envelope(t, first, left, rest), "Residual length, averaged over half a second.")


def _unexplained(page: Page, d: Diagnosis) -> None:
    if d.unexplained_force is None:
        return
    page.heading("The unexplained force")
    panels = [
        Panel(f"force {axis} (mN)").line(
            d.unexplained_force.stamps, 1e3 * d.unexplained_force.force[:, i], "at the tip", "fused"
        )
        for i, axis in enumerate(AXES)
    ]
    page.figure(figure_svg(panels), f"In the first bag, {d.unexplained_force.text}.")


def _learned(page: Page, content: dict[str, Any]) -> None:
    force = content["learned"]
    if force is None:
        return
    page.heading("The learned force")
    rows = [(t["parameter"], t["text"], t["value"], *t["ci90"], t["unit"]) for t in force["terms"]]
    page.table(rows, ("parameter", "what it is", "value", "from", "to (90 % interval)", "unit"))
    low, high = force["ci95"]
    page.paragraph(
        f"Gain on {force['held_out']}: {force['gain']:.3f} of the squared error, 95 % interval {low:.3f} to {high:.3f}. "
        f"The extended robot file has this force as extension {force['extension']}."
    )


def _loops(joints: Floats, t: Floats, left: Floats, rest: Floats):  # type: ignore[no-untyped-def]
    n = (joints.shape[1] - 1) // 2
    figure = Figure(figsize=(10, 3.2), layout="constrained")
    axes = figure.subplots(1, n, squeeze=False)[0]
    for i, ax in enumerate(axes):
        angle = np.degrees(np.interp(t, joints[:, 0], joints[:, 1 + i]))
        ax.plot(
            angle,
            1e3 * np.linalg.norm(left[:, :3], axis=1),
            ".",
            ms=2,
            color="#8c959f",
            label="re-calibrated",
        )
        ax.plot(
            angle, 1e3 * np.linalg.norm(rest[:, :3], axis=1), ".", ms=2, color="#cf222e", label="extended"
        )
        ax.set_xlabel(f"tube {i + 1} angle (deg)")
        ax.set_ylabel("residual (mm)")
        ax.grid(alpha=0.25)
    figure.legend(
        *axes[0].get_legend_handles_labels(), fontsize=8, frameon=False, ncols=2, loc="outside upper right"
    )
    return to_svg(figure)


def _envelope(t: Floats, nominal: Floats, left: Floats, rest: Floats):  # type: ignore[no-untyped-def]
    block = np.floor(t / 0.5).astype(int)
    groups = np.unique(block, return_inverse=True)[1]
    panel = Panel("residual (mm)", log=True)
    count = np.bincount(groups)
    centre = np.bincount(groups, t) / count
    models = (
        (nominal, "nominal", NOMINAL),
        (left, "re-calibrated", "open_loop"),
        (rest, "extended", "fused"),
    )
    for values, label, colour in models:
        squares = np.bincount(groups, np.sum(values[:, :3] ** 2, axis=1)) / count
        panel.line(centre, 1e3 * np.sqrt(squares), label, colour)
    return figure_svg([panel])


def _evidence(page: Page, d: Diagnosis) -> None:
    if d.search is None:
        return
    page.heading("Evidence")
    most = d.options.report.shown
    # likeliest first; of those that have no probability left, those that explain most
    ranked = sorted(
        zip(d.search.probabilities, d.search.hypotheses, strict=True),
        key=lambda x: (-round(x[0], 3), -x[1].score),
    )
    probabilities, shown = zip(*ranked[:most], strict=True)
    no_cause = next(e for e in d.search.hypotheses if not e.members)
    labels = [" + ".join(c.label for c in e.members) or "no cause" for e in shown]
    values = [max(e.score - no_cause.score, -5.0) for e in shown]
    figure = Figure(figsize=(10, 0.6 + 0.3 * len(shown)), layout="constrained")
    ax = figure.subplots()
    ax.barh(range(len(shown)), values, color="#0969da")
    ax.set_yticks(range(len(shown)), labels, fontsize=8)
    ax.invert_yaxis()
    ax.set_xscale("symlog", linthresh=5)
    ax.xaxis.set_major_formatter("{x:g}")
    ax.set_xlabel("log posterior over that of no cause")
    ax.grid(axis="x", alpha=0.25)
    page.figure(to_svg(figure), "Hypotheses that were fitted in full.")
    rows = [
        (label, f"{p:.3f}", f"{e.fit.chi2 / max(d.problem.size, 1):.3f}" if d.problem else "-")
        for label, p, e in zip(labels, probabilities, shown, strict=True)
    ]
    page.table(rows, ("hypothesis", "probability", "squares over noise"))
    linear = [(s.candidate.label, s.gain) for s in d.search.screened[:most] if np.isfinite(s.gain)]
    page.paragraph(
        "Log evidence that each single cause gains by the linear estimate at the re-calibrated model:"
    )
    page.table(linear, ("cause", "gain"))


def separations(d: Diagnosis) -> tuple[list[Candidate], list[str], Floats]:
    """Candidates of the verdict's causes, effects, and the separation (causes, effects) of each from each where they differ; empty without causes."""
    members = [c.candidate for c in d.causes if c.candidate is not None]
    if not members or d.sensitivities is None or d.problem is None or d.extended is None:
        return [], [], np.zeros((0, 0))
    names = sorted({c.effect for c in d.sensitivities.by_candidate})
    table = np.full((len(members), len(names)), np.nan)
    for i, member in enumerate(members):
        for rival in d.sensitivities.by_candidate:
            if rival.effect != member.effect:
                k = names.index(rival.effect)
                value = separation(d.problem, d.extended, (member,), rival, d.sensitivities)
                table[i, k] = np.nanmin([table[i, k], value])
    return members, names, table


def _rivals(page: Page, d: Diagnosis) -> None:
    members, names, table = separations(d)
    if not members:
        return
    figure = Figure(figsize=(10, 2.6 + 0.3 * len(members)), layout="constrained")
    ax = figure.subplots()
    image = ax.imshow(np.log10(np.maximum(table, 0.1)), aspect="auto", cmap="viridis")
    ax.set_xticks(range(len(names)), names, rotation=90, fontsize=7)
    ax.set_yticks(range(len(members)), [m.label for m in members], fontsize=8)
    figure.colorbar(image, ax=ax).set_label("log10 of separation", fontsize=8)
    page.heading("What these data cannot tell apart")
    limit = d.options.verdict.separation
    page.figure(
        to_svg(figure),
        f"Separation of each cause from every rival; below {limit:g} ({np.log10(limit):.1f} on this scale) the data do not decide.",
    )


def _validation(page: Page, d: Diagnosis) -> None:
    v = d.validation
    if v is None:
        return
    page.heading("Bags that were not fitted")
    figure = Figure(figsize=(10, 2.2), layout="constrained")
    ax = figure.subplots()
    x = np.arange(len(v.bags))
    for shift, label, colour in (
        (-0.27, "nominal", NOMINAL),
        (0.0, "recalibrated", "#0969da"),
        (0.27, "extended", "#cf222e"),
    ):
        heights = [1e3 * getattr(bag, label) for bag in v.bags]
        ax.bar(x + shift, heights, 0.27, label=label.replace("recal", "re-cal"), color=colour)
    ax.axhline(1e3 * noise_floor(d.robot), color="#bf8700", ls="--", label="noise floor")
    ax.set_xticks(x, [bag.name for bag in v.bags])
    ax.set_ylabel("rms (mm)")
    ax.legend(fontsize=8, frameon=False, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    over = f" Over the nominal model {v.gain_over_nominal:.3f}." if np.isfinite(v.gain_over_nominal) else ""
    page.figure(
        to_svg(figure),
        f"Gain over the re-calibrated model {v.gain:.3f}, 95 % interval {v.interval[0]:.3f} to {v.interval[1]:.3f}.{over}",
    )
    page.table([("NIS per degree of freedom", v.nis_before, v.nis_after)], ("", "re-calibrated", "extended"))


def noise_band(sequences: Sequence[Floats]) -> float:
    """Two deviations of the mean over ``sequences`` of the autocorrelation of noise."""
    return 2.0 * float(np.sqrt(sum(1.0 / max(len(x), 1) for x in sequences))) / len(sequences)


def _whiteness(page: Page, d: Diagnosis, recalibrated: Fit, extended: Fit) -> None:
    assert d.problem is not None
    page.heading("Is what is left noise?")
    figure = Figure(figsize=(10, 3.0), layout="constrained")
    left, right = figure.subplots(1, 2)
    for fit, label, colour in ((recalibrated, "re-calibrated", "#0969da"), (extended, "extended", "#cf222e")):
        sequences = by_axis(d.problem, fit.whitened)
        lags = np.arange(1, d.options.residual_tests.lags + 1)
        values = [[float(x[k:] @ x[:-k]) / max(float(x @ x), 1e-30) for k in lags] for x in sequences]
        left.plot(lags, np.mean(values, axis=0), ".-", color=colour, label=label)
        rate = 1.0 / np.median(np.diff(d.recordings[0].stamps))
        frequency, power = periodogram(sequences[1], rate)
        right.plot(frequency, np.cumsum(power) / max(power.sum(), 1e-30), color=colour, label=label)
    bound = noise_band(by_axis(d.problem, extended.whitened))
    left.axhspan(-bound, bound, color="#8c959f", alpha=0.3)
    left.set_xlabel("lag (samples)")
    left.set_ylabel("autocorrelation")
    figure.legend(
        *left.get_legend_handles_labels(), fontsize=8, frameon=False, ncols=2, loc="outside upper right"
    )
    right.plot([0, right.get_xlim()[1]], [0, 1], color="#8c959f", ls="--")
    right.set_xlabel("frequency (Hz)")
    right.set_ylabel("cumulative periodogram, y")
    page.figure(
        to_svg(figure),
        "Autocorrelation of the whitened residual, and the cumulative periodogram of the y axis; noise follows the dashed line.",
    )
    rows = [
        (label, w.power, w.p_correlation, w.p_power)
        for label, w in (("re-calibrated", d.whiteness_recalibrated), ("extended", d.whiteness_extended))
        if w
    ]
    page.table(rows, ("model", "mean square", "p of Ljung-Box", "p of mean square"))


def _values(page: Page, fit: Fit) -> None:
    page.heading("Values")
    causes = {q.key for q in fit.causes}
    rows = []
    for q, value, sigma in zip(fit.active, fit.values, fit.sigma, strict=True):
        pull = (value - q.off) / q.tolerance if q.tolerance > 0.0 else None
        rows.append(
            (q.effect, q.name, float(value), float(sigma), q.off, pull, "cause" if q.key in causes else "")
        )
    page.table(rows, ("effect", "parameter", "value", "deviation", "robot file", "in tolerances", ""))
    page.paragraph(
        "Values are the fit's coordinates: a stiffness that acts as a compliance is shown as its reciprocal."
    )


def _scope(page: Page, content: dict[str, Any]) -> None:
    page.heading("What was tested")
    page.table(
        [(name, EFFECTS[name].text if name in EFFECTS else "") for name in content["tested"]], ("cause", "")
    )
    if content["not_observable"]:
        page.paragraph("These data could not see: " + ", ".join(content["not_observable"]) + ".", "note")
    n = content["numerics"]
    if n["time_error_m"] is not None:
        page.paragraph(
            f"The solver's own error on these bags: {n['time_error_m'] * 1e6:.1f} um by its time step, {n['space_error_m'] * 1e6:.2f} um by its mesh."
        )
    page.heading("To reproduce")
    page.preformatted(content["reproduce"])
