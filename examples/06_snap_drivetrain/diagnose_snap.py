"""What the rigid model gets wrong about a recorded snap, which cause mends it, and what that is worth on a snap that was not fitted.

``python diagnose_snap.py [--data DIR] [--output DIR] [--jobs N]`` prints the table and writes ``snap_diagnosis.png`` and ``result.json``.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
from joblib import Parallel, delayed
from snap_fit import (
    DECISIVE,
    NOTHING,
    Check,
    Fit,
    Fitter,
    Snap,
    causes,
    check,
    load,
    whiteness,
)

from ctr_dynamics.robot_files import load_robot
from ctr_dynamics.snap.features import extrema, frequencies

HERE = Path(__file__).parent


def diagnose(folder: Path, jobs: int, effects: list[str] | None = None) -> dict[str, Any]:
    """Fit every hypothesis to the first snap of ``folder`` and check them on the others; ``effects`` keeps those causes only.

    Returns fits (likeliest first), the named cause or "", the snaps, and the checks of each fit.
    """
    name, snaps = load(folder)
    robot = load_robot(name)
    tried = [c for c in causes(robot) if effects is None or c is NOTHING or c.effect in effects]
    fitter = Fitter(robot, snaps[0])
    # the long ones first
    tried.sort(key=lambda c: -len(c.starts))
    fits = Parallel(n_jobs=jobs, verbose=10)(delayed(fitter.fit)(cause) for cause in tried)
    fits.sort(key=lambda fit: fit.bic)
    near = [fit for fit in fits if fit.bic < fits[0].bic + 100.0 * DECISIVE]  # the others cannot catch up
    fits[: len(near)] = Parallel(n_jobs=jobs)(delayed(fitter.fit)(fit.cause, fit) for fit in near)
    fits.sort(key=lambda fit: fit.bic)
    best, second = fits[0], fits[1]
    named = best.cause.effect if second.bic - best.bic > DECISIVE else ""
    rigid = next(fit for fit in fits if not fit.cause.effect)
    checks = {fit.cause.title: [check(robot, fit, snap) for snap in snaps[1:]] for fit in (best, rigid)}
    return {"fits": fits, "named": named, "rigid": rigid, "snaps": snaps, "checks": checks}


def lines(t: np.ndarray, theta: np.ndarray) -> tuple[list[float], list[tuple[float, float]]]:
    """Periods (s) between the first peaks, and the spectral lines (Hz, relative height) from the first peak on."""
    peaks = [e.t_s for e in extrema(t, theta, 0.1) if e.kind == "peak"][:5]
    return list(np.diff(peaks)), frequencies(t, theta, peaks[0])


def table(found: dict[str, Any]) -> list[str]:
    """Lines of the report."""
    fits: list[Fit] = found["fits"]
    snap: Snap = found["snaps"][0]
    rigid, best = found["rigid"], fits[0]
    out = [f"{'hypothesis':32s} {'rms rad':>8s} {'BIC less the least':>18s}  parameters, 99 %"]
    for fit in fits:
        values = "; ".join(
            f"{name} {v:.4g} [{low:.4g}, {high:.4g}]"
            for name in fit.cause.names
            for v, low, high in [fit.interval(name)]
        )
        out.append(f"{fit.cause.title:32s} {fit.rms:8.4f} {fit.bic - best.bic:18.0f}  {values}")
    for title, residual in (
        ("measured", np.zeros(len(snap.t))),
        ("rigid", rigid.residual),
        (best.cause.title, best.residual),
    ):
        periods, hz = lines(snap.t, snap.theta_f - residual)
        shown = ", ".join(f"{f / 1e3:.2f} kHz ({h:.2f})" for f, h in hz)
        out.append(f"{title:32s} periods {np.round(1e3 * np.array(periods), 3)} ms; lines {shown}")
    out.append(
        f"named: {found['named'] or 'nothing'}; what it leaves is white with p = {whiteness(best.residual):.2f}"
    )
    for k, other in enumerate(found["snaps"][1:]):
        old, new = (found["checks"][fit.cause.title][k] for fit in (rigid, best))
        if isinstance(old, Check) and isinstance(new, Check):
            out.append(
                f"held back, beta1 {1e3 * other.beta1:.1f} mm: rms {old.rms:.4f} -> {new.rms:.4f} rad, "
                f"gain {1 - (new.rms / old.rms) ** 2:.3f}; snap at theta_b {old.theta_b:.4f} -> {new.theta_b:.4f} rad, "
                f"recorded {other.theta_b:.4f}"
            )
    return out


def draw(found: dict[str, Any], file: Path) -> None:
    """Angle, residual and spectrum: measured, rigid, explained."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    snap, rigid, best = found["snaps"][0], found["rigid"], found["fits"][0]
    t = 1e3 * (snap.t - snap.passed)
    figure = Figure(figsize=(9, 8))
    angle, left, spectrum = figure.subplots(3, 1, height_ratios=(3, 2, 2))
    angle.plot(t, snap.theta_f, ".", ms=2.5, color="0.4", label="measured, 50 kHz (simulated)")
    for fit, color, label in (
        (rigid, "C3", "rigid bases, re-calibrated"),
        (best, "C0", best.cause.title),
    ):
        angle.plot(t, snap.theta_f - fit.residual, color=color, lw=1.0, label=label)
        left.plot(t, fit.residual, color=color, lw=0.8, label=f"rms {fit.rms:.4f} rad")
    for residual, color in ((0.0, "0.4"), (rigid.residual, "C3"), (best.residual, "C0")):
        theta = snap.theta_f - residual
        peak = next(e.t_s for e in extrema(snap.t, theta, 0.1) if e.kind == "peak")
        x = theta[snap.t > peak]
        x = (x - x[len(x) // 2 :].mean()) * np.hanning(2 * len(x))[len(x) :]
        size = 4096
        hz = np.fft.rfftfreq(size, snap.t[1] - snap.t[0])
        spectrum.plot(1e-3 * hz, np.abs(np.fft.rfft(x, size)), color=color, lw=1.2)
    angle.set(ylabel="angle between markers (rad)")
    left.set(ylabel="measured - simulated (rad)", xlabel="time after 4 rad (ms)")
    spectrum.set(ylabel="spectrum", xlabel="frequency (kHz)", xlim=(0.5, 4.0))
    for axes in (angle, left, spectrum):
        axes.grid(alpha=0.3)
    angle.legend(loc="lower right")
    left.legend(loc="upper right")
    FigureCanvasAgg(figure)
    figure.tight_layout()
    figure.savefig(file, dpi=110)


def result(found: dict[str, Any]) -> dict[str, Any]:
    """Numbers of a run for programs."""
    best: Fit = found["fits"][0]

    def numbers(c: Check | None) -> dict[str, float] | None:
        return None if c is None else {"rms_rad": c.rms, "theta_b_rad": c.theta_b}

    return {
        "named": found["named"],
        "parameters": {name: best.interval(name) for name in best.cause.names},
        "whiteness_p": whiteness(best.residual),
        "explanations": [
            {"cause": f.cause.title, "rms_rad": f.rms, "bic": f.bic, "simulations": f.simulations}
            for f in found["fits"]
        ],
        "held_back": {title: [numbers(c) for c in checks] for title, checks in found["checks"].items()},
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=HERE / "data", metavar="DIR")
    parser.add_argument("--output", type=Path, default=Path("snap_drivetrain"), metavar="DIR")
    parser.add_argument("--jobs", type=int, default=2, metavar="N", help="processes")
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    found = diagnose(options.data, options.jobs)
    print("\n".join(table(found)))
    draw(found, options.output / "snap_diagnosis.png")
    (options.output / "result.json").write_text(json.dumps(result(found), indent=1) + "\n")
    answer = options.data / "answer.json"
    if answer.is_file():
        hidden = json.loads(answer.read_text())
        print(
            f"hidden: {hidden['cause']}, {hidden['stiffness_Nm_per_rad']:.4g} N m/rad, {hidden['inertia_kgm2']:.4g} kg m^2"
        )


if __name__ == "__main__":
    main()
