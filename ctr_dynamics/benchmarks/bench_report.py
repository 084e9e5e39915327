"""Figures of a benchmark as text and plots."""

from __future__ import annotations

from pathlib import Path
from typing import Any

Result = dict[str, Any]


def _number(value: float | None, form: str) -> str:
    return "-" if value is None else format(value, form)


def text(result: Result) -> str:
    """The figures as short tables."""
    made = result["machine"]
    lines = [
        f"{made['processor']}, {made['cores']} cores, load {_number(made['load_1min'], '.2f')}",
        ", ".join(f"{name} {number}" for name, number in made["versions"].items()),
        "",
        "cost of a sweep (us)",
        "tubes  nodes  lanes    sweep     lane  lane / plain sweep",
    ]
    lines += [
        f"{r['tubes']:5d}  {r['nodes']:5d}  {r['lanes']:5d}  {r['sweep_us']:7.1f}  {r['lane_us']:7.2f}  "
        f"{r['lane_ratio_to_plain_sweep']:8.2f}"
        for r in result["sweeps"]
    ]
    lines += [
        "",
        "release test, sdirk3 at 3 ms",
        "nodes  sweeps/solve  sweeps/step  Jacobians/step  step (us)  plain sweeps  times real time  in a compiled loop",
    ]
    lines += [
        f"{r['nodes']:5d}  {r['sweeps_per_solve']:12.2f}  {r['sweeps_per_step']:11.2f}  {r['jacobians_per_step']:14.2f}  "
        f"{r['step_us']:9.0f}  {r['step_ratio_to_plain_sweep']:12.1f}  {r['realtime_ratio']:15.1f}  {r['compiled_realtime_ratio']:18.1f}"
        for r in result["simulate"]
    ]
    lines += ["", "a simulation with derivatives, in simulations without", "nodes  parameters  simulations"]
    lines += [
        f"{r['nodes']:5d}  {r['columns']:10d}  {r['simulations']:11.2f}" for r in result["sensitivities"]
    ]
    lines += [
        "",
        "replay with fusion and the open loop beside it",
        "nodes  rank  columns  times real time  p50 (ms)  p99 (ms)  p99.9 (ms)  max (ms)",
    ]
    for r in [*result["replay"], *result["rank"]]:
        tick = r["tick_ms"]
        lines.append(
            f"{r['nodes']:5d}  {r['rank']:4d}  {r['columns']:7d}  {r['realtime_ratio']:15.1f}  {tick['p50']:8.2f}  {tick['p99']:8.2f}  "
            f"{tick['p99.9']:10.2f}  {tick['max']:8.2f}"
        )
    error = result["time_error"]
    lines += [
        "",
        f"error at 3 ms against {error['reference']['scheme']} at {1e3 * error['reference']['dt_s']:g} ms, {error['nodes']} nodes (tip, rms, mm)",
    ]
    lines += [
        f"{r['scheme']:15s}  {_number(None if r['error_m'] is None else 1e3 * r['error_m'], '.4f'):>8s}"
        f"{'  ' + r['failure'] if r['failure'] else ''}"
        for r in error["schemes"]
    ]
    lines += [
        "",
        "error of sdirk3 over the step (tip, rms, mm)",
        "step (ms)  as the steps fall  divided at the cut",
    ]
    lines += [
        f"{1e3 * r['dt_s']:9.2f}  {_number(None if r['error_m'] is None else 1e3 * r['error_m'], '.4f'):>17s}"
        f"  {_number(None if r['divided_error_m'] is None else 1e3 * r['divided_error_m'], '.4f'):>18s}"
        for r in error["steps"]
    ]
    lines += ["", "real-time ratio over time step and node spacing (release test, steps from Python)"]
    steps = sorted({r["dt_s"] for r in result["figure_13"]})
    lines += ["spacing (mm)" + "".join(f"{1e3 * dt:9g} ms" for dt in steps)]
    for spacing in sorted({r["spacing_m"] for r in result["figure_13"]}, reverse=True):
        found = {r["dt_s"]: r for r in result["figure_13"] if r["spacing_m"] == spacing}
        cells = [
            _number(None if found[dt]["failure"] else found[dt]["realtime_ratio"], ".1f") for dt in steps
        ]
        lines += [f"{1e3 * spacing:12.2f}" + "".join(f"{cell:>12s}" for cell in cells)]
    space = result["figure_14"]
    lines += [
        "",
        f"error over node spacing against {space['reference_nodes']} nodes (tip, rms, mm)",
        "nodes  spacing (mm)  Runge-Kutta 4    Euler",
    ]
    lines += [
        f"{r['nodes']:5d}  {1e3 * r['spacing_m']:12.2f}  {_number(None if r['error_m'] is None else 1e3 * r['error_m'], '.2e'):>13s}"
        f"  {_number(None if r['euler_error_m'] is None else 1e3 * r['euler_error_m'], '.2e'):>8s}"
        for r in space["rows"]
    ]
    snap = result["snap"]
    lines += [
        "",
        f"snap-through, finite differences, {snap['unknowns']} unknowns at {1e6 * snap['dt_s']:g} us (ms)",
        "  step  of processor time  iterations  Jacobians  residual  Jacobian  back solve  published program",
        f"{snap['step_ms']:6.2f}  {snap['step_cpu_ms']:17.2f}  {snap['iterations_per_step']:10.2f}  {snap['jacobians_per_step']:9.2f}  "
        f"{snap['residual_ms']:8.3f}  {snap['jacobian_ms']:8.2f}  {snap['back_solve_ms']:10.3f}  "
        f"{'{:g} to {:g}'.format(*snap['published_program_ms']):>17s}",
    ]
    return "\n".join(lines)


def page(result: Result) -> str:
    """The figures as a page of documentation, Markdown."""
    return (
        "# Performance\n\n"
        "This page is written by `ctr-dynamics bench --page FILE`; do not edit it by hand.\n\n"
        "The machine and its load are part of the figures. Compare ratios to a plain sweep, which the same run has measured, rather than times.\n"
        "A sweep is one integration of the rod equations from base to tip. Where something else may have run at the same time, the fastest of\n"
        "some repetitions counts.\n\n"
        "`ctr-dynamics bench --output DIR` writes the same figures as JSON and as plots:\n\n"
        "- real-time ratio over step and spacing (Till et al. 2020, Fig. 13);\n"
        "- error over spacing (Fig. 14);\n"
        "- histogram of the times of the steps.\n\n"
        "The default time scheme, `radau`, has the smallest error at 3 ms below.\n\n"
        f"```text\n{text(result)}\n```\n"
    )


def plots(result: Result, folder: Path) -> list[Path]:
    """Draw every figure into `folder` as PNG; returns the files."""
    # imported late: it takes longer than the rest of the command line, and needs no display
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    written: list[Path] = []

    def save(name: str, figure: Figure) -> None:
        FigureCanvasAgg(figure)
        figure.tight_layout()
        written.append(folder / name)
        figure.savefig(written[-1], dpi=120)

    figure = Figure(figsize=(6, 4))
    axes = figure.subplots()
    for tubes, lanes in sorted({(r["tubes"], r["lanes"]) for r in result["sweeps"]}):
        rows = [r for r in result["sweeps"] if (r["tubes"], r["lanes"]) == (tubes, lanes)]
        axes.loglog(
            [r["nodes"] for r in rows],
            [r["lane_us"] for r in rows],
            "o-",
            label=f"{tubes} tubes, {lanes} lanes",
        )
    axes.set(xlabel="nodes", ylabel="cost of a lane (us)", title="One sweep from base to tip")
    axes.legend(fontsize=7)
    save("sweeps.png", figure)

    figure = Figure(figsize=(6, 4))
    axes = figure.subplots()
    for r in result["replay"]:
        edges, counts = r["histogram"]["edges_ms"], r["histogram"]["counts"]
        axes.stairs(
            [c / max(r["steps"], 1) for c in counts],
            edges,
            label=f"{r['nodes']} nodes, p99.9 {r['tick_ms']['p99.9']:.2f} ms",
        )
    axes.axvline(3.0, color="k", lw=0.8, ls="--")
    axes.set(
        xscale="log",
        yscale="log",
        xlabel="time of a step (ms)",
        ylabel="share of steps",
        title="Replay with fusion",
    )
    axes.legend(fontsize=8)
    save("ticks.png", figure)

    figure = Figure(figsize=(6, 4))
    axes = figure.subplots()
    for dt in sorted({r["dt_s"] for r in result["figure_13"]}):
        rows = [
            r for r in result["figure_13"] if r["dt_s"] == dt and r["realtime_ratio"] and not r["failure"]
        ]
        axes.loglog(
            [1e3 * r["spacing_m"] for r in rows],
            [r["realtime_ratio"] for r in rows],
            "o-",
            label=f"step {1e3 * dt:g} ms",
        )
    axes.axhline(1.0, color="k", lw=0.8, ls="--")
    axes.set(
        xlabel="node spacing (mm)",
        ylabel="real-time ratio",
        title="Real-time ratio over step and spacing (Till et al. 2020, Fig. 13)",
    )
    axes.legend(fontsize=8)
    save("figure_13.png", figure)

    figure = Figure(figsize=(6, 4))
    axes = figure.subplots()
    rows = [r for r in result["figure_14"]["rows"] if r["error_m"]]
    axes.loglog([1e3 * r["spacing_m"] for r in rows], [1e3 * r["error_m"] for r in rows], "o-", label="RK4")
    euler = [r for r in rows if r["euler_error_m"]]
    axes.loglog(
        [1e3 * r["spacing_m"] for r in euler], [1e3 * r["euler_error_m"] for r in euler], "s-", label="Euler"
    )
    if rows:
        first = rows[0]
        axes.loglog(
            [1e3 * r["spacing_m"] for r in rows],
            [1e3 * first["error_m"] * (r["spacing_m"] / first["spacing_m"]) ** 4 for r in rows],
            "k--",
            lw=0.8,
            label="fourth order",
        )
    axes.set(
        xlabel="node spacing (mm)",
        ylabel="tip error, rms (mm)",
        title=f"Error over spacing against {result['figure_14']['reference_nodes']} nodes (Till et al. 2020, Fig. 14)",
    )
    axes.legend(fontsize=8)
    save("figure_14.png", figure)

    figure = Figure(figsize=(6, 4))
    axes = figure.subplots()
    schemes = [r for r in result["time_error"]["schemes"] if r["error_m"] is not None]
    axes.bar([r["scheme"] for r in schemes], [1e3 * r["error_m"] for r in schemes])
    axes.set(yscale="log", ylabel="tip error, rms (mm)", title="Time schemes at 3 ms on the release test")
    axes.tick_params(axis="x", rotation=30)
    save("time_error.png", figure)
    return written
