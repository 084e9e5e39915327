"""Draws docs/images/estimate.png, the picture of README.md: `python -m tools.picture`.

A test bag whose robot carries 0.4 g more than its robot file says is replayed, and both runs of the estimator are compared with the truth.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from scipy.interpolate import CubicHermiteSpline

from ctr_dynamics.estimation.estimator import Estimator
from ctr_dynamics.io import open_bag
from ctr_dynamics.io.messages.cdr import PoseIn
from ctr_dynamics.parameters import Settings
from ctr_dynamics.robot_files import load_robot
from ctr_dynamics.runtime.replay import Player

ROOT = Path(__file__).parents[1]
BAGS = ROOT / "test" / "data" / "bags"
BAG = "payload_protocol"
PICTURE = ROOT / "docs" / "images" / "estimate.png"
SETTLED_S = 0.5
"""Start of the comparison, as in docs/filter_evaluation.md."""
SHOWN_S = (0.9, 3.4)
"""The release of a weight, and the vibration after it."""
BACKBONES_S = (1.0, 1.036, 1.051, 1.09)
OPEN_LOOP, FUSED, TRACKER, TRUTH = "#0969da", "#cf222e", "#8c959f", "#1b1f24"


def smooth(backbone: np.ndarray) -> np.ndarray:
    """(n, 3) points of the cubic through the nodes (P, 15) of a backbone and their tangents, mm."""
    s, points = backbone[:, 0].astype(float), 1e3 * backbone[:, 1:4].astype(float)
    x, y, z, w = backbone[:, 4:8].astype(float).T
    tangents = 1e3 * np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)]).T
    distinct = np.flatnonzero(np.diff(s, prepend=-1.0) > 1e-6)
    return CubicHermiteSpline(s[distinct], points[distinct], tangents[distinct])(
        np.linspace(s[0], s[-1], 120)
    )


def figure() -> Figure:
    """Backbone and tip of one replay, with the errors of open-loop model, tracker and fused estimate."""
    bag = open_bag(BAGS / f"{BAG}.mcap")
    estimator = Estimator(load_robot("till2020_tissue"), Settings({"output.policy": "wait"}))
    steps = list(Player(estimator).play(bag))
    poses = [item.message for item in bag.inputs() if isinstance(item.message, PoseIn)]
    first_ns = steps[0].stamp_ns
    t = 1e-9 * np.array([step.stamp_ns - first_ns for step in steps])
    fused = 1e3 * np.array([step.tip_position for step in steps])
    open_loop = 1e3 * np.array([step.predicted_position for step in steps])
    t_tracker = 1e-9 * np.array([pose.stamp_ns - first_ns for pose in poses])
    tracker = 1e3 * np.array([pose.position for pose in poses])
    recorded = np.load(BAGS / "truth" / f"{BAG}.npz")

    def truth(times: np.ndarray) -> np.ndarray:
        # the tip as the tracker would see it without noise: the estimate is in the registered frame
        return 1e3 * np.array([np.interp(times, recorded["t"], recorded["p_trk"][:, i]) for i in range(3)]).T

    runs = (
        ("open-loop model", OPEN_LOOP, t, open_loop, truth(t)),
        ("tracker", TRACKER, t_tracker, tracker, truth(t_tracker)),
        ("fused", FUSED, t, fused, truth(t)),
    )
    picture = Figure(figsize=(11.0, 4.6), layout="constrained")
    robot, motion, errors = picture.subplot_mosaic(
        [["robot", "motion"], ["robot", "errors"]], width_ratios=(1.0, 1.35), height_ratios=(1.0, 0.9)
    ).values()

    swing = (t > SHOWN_S[0]) & (t < SHOWN_S[0] + 0.25)
    for number, moment in enumerate(BACKBONES_S):
        k = int(np.searchsorted(t, moment))
        shape, alpha = smooth(steps[k].backbone), 0.3 + 0.7 * number / (len(BACKBONES_S) - 1)
        robot.plot(shape[:, 2], shape[:, 1], color=FUSED, alpha=alpha, lw=2.4, solid_capstyle="round")
        robot.plot(*fused[k, [2, 1]], "o", color=FUSED, alpha=alpha, ms=6)
    robot.plot([], [], "o-", color=FUSED, lw=2.4, label="fused backbone")
    near = (t_tracker > SHOWN_S[0]) & (t_tracker < SHOWN_S[0] + 0.25)
    robot.plot(tracker[near, 2], tracker[near, 1], ".", color=TRACKER, ms=6, label="tracker")
    robot.plot(
        open_loop[swing, 2], open_loop[swing, 1], color=OPEN_LOOP, lw=1.4, ls="--", label="open-loop tip path"
    )
    robot.plot(truth(t[swing])[:, 2], truth(t[swing])[:, 1], color=TRUTH, lw=1.0, label="true tip path")
    robot.plot([0, 0], [-12, 12], color=TRUTH, lw=5, solid_capstyle="butt")
    robot.set(xlabel="z (mm)", ylabel="y (mm)", aspect="equal")
    robot.set_title("a hanging weight is cut off", fontsize=10)
    robot.legend(loc="lower left", frameon=False, fontsize=8)

    shown = (t > SHOWN_S[0]) & (t < SHOWN_S[1])
    measured = (t_tracker > SHOWN_S[0]) & (t_tracker < SHOWN_S[1])
    motion.plot(t[shown], open_loop[shown, 1], color=OPEN_LOOP, lw=1.4, ls="--", label="open-loop model")
    motion.plot(t_tracker[measured], tracker[measured, 1], ".", color=TRACKER, ms=5, label="tracker, 40 Hz")
    motion.plot(t[shown], fused[shown, 1], color=FUSED, lw=1.6, label="fused, 333 Hz")
    motion.set(ylabel="tip y (mm)", xlim=SHOWN_S)
    motion.legend(loc="lower right", ncols=3, frameon=False, fontsize=8)

    for label, colour, times, tip, true in runs:
        error = np.linalg.norm(tip - true, axis=1)
        rms = np.sqrt(np.mean(error[times > SETTLED_S] ** 2))
        part = (times > SHOWN_S[0]) & (times < SHOWN_S[1])
        style = {"ls": "", "marker": ".", "ms": 4} if label == "tracker" else {"lw": 1.4}
        errors.semilogy(times[part], error[part], color=colour, label=f"{label}: {rms:.2f} mm rms", **style)
    errors.set(xlabel="time (s)", ylabel="tip error (mm)", xlim=SHOWN_S, ylim=(0.02, 60))
    errors.legend(loc="upper right", ncols=3, frameon=False, fontsize=8, columnspacing=1.0, handletextpad=0.4)
    for axes in (robot, motion, errors):
        axes.grid(color="#eaeef2")
        axes.spines[["top", "right"]].set_visible(False)
    return picture


def main() -> None:
    """Draw the picture."""
    picture = figure()
    FigureCanvasAgg(picture)
    PICTURE.parent.mkdir(exist_ok=True)
    picture.savefig(PICTURE, dpi=100, pil_kwargs={"optimize": True})
    print(f"wrote {PICTURE.relative_to(ROOT)}")


if __name__ == "__main__":
    main()
