"""What a live run has shown: tip errors in open loop and fused, punctuality, and a picture."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.effects import make_plant
from ctr_dynamics.io.bag_reader import open_bag
from ctr_dynamics.io.messages.cdr import PoseIn, decode_point_cloud, decode_pose_stamped
from ctr_dynamics.io.messages.topics import STEP_NS
from ctr_dynamics.io.truth_files import read_truth
from ctr_dynamics.robot import Robot
from ctr_dynamics.sensing import TrackerModel
from ctr_dynamics.sensing.tracker_tips import tracker_tips

SETTLE_S = 0.5
"""Left out at the start of comparisons with the truth."""

Floats = NDArray[np.float64]


class Received(NamedTuple):
    """A serialised message with its moment of arrival (ns, system clock)."""

    arrival_ns: int
    data: bytes


@dataclass(frozen=True)
class Trace:
    """A point over time: `t` (n,) in s from the start of the bag, `p` (n, 3) in m in the base frame."""

    t: Floats
    p: Floats

    def at(self, t: Floats) -> Floats:
        """Linear in between, (len(t), 3)."""
        return np.column_stack([np.interp(t, self.t, self.p[:, axis]) for axis in range(3)])

    def covers(self, t: Floats) -> NDArray[np.bool_]:
        """Whether each of ``t`` (k,) lies on a sample or between two of steps that followed each other; outputs that are invalid leave a gap."""
        after = np.clip(np.searchsorted(self.t, t), 1, len(self.t) - 1)
        within = (t >= self.t[0]) & (t <= self.t[-1])
        found: NDArray[np.bool_] = within & (self.t[after] - self.t[after - 1] < 1.5e-9 * STEP_NS)
        return found


@dataclass(frozen=True)
class LiveErrors:
    """Distances (m) of the open-loop and of the fused tip from a reference over its samples."""

    reference: str
    samples: int
    open_loop_rms: float
    open_loop_max: float
    fused_rms: float
    fused_max: float

    def as_json(self) -> dict[str, Any]:
        """The numbers under the names of demo.json."""
        return {
            "reference": self.reference,
            "samples": self.samples,
            "alone_rms": self.open_loop_rms,
            "alone_max": self.open_loop_max,
            "fused_rms": self.fused_rms,
            "fused_max": self.fused_max,
        }


def trace_of(messages: Sequence[Received], start_ns: int) -> Trace:
    """Positions in pose messages (with or without covariance) relative to `start_ns`, in order of stamp."""
    poses = sorted(decode_pose_stamped(message.data) for message in messages)
    return Trace(
        np.array([(pose.stamp_ns - start_ns) * 1e-9 for pose in poses]),
        np.array([pose.position for pose in poses]).reshape(-1, 3),
    )


def nominal_tracker(robot: Robot) -> TrackerModel:
    """The tracker of a robot file."""
    return make_plant(robot).tracker


def tracker_trace(bag: Path, start_ns: int, tracker: TrackerModel) -> Trace:
    """The tip in the base frame as the usable poses of a bag show it, relative to its own `start_ns`."""
    poses = sorted(m.message for m in open_bag(bag).inputs() if isinstance(m.message, PoseIn))
    return Trace(*tracker_tips(poses, start_ns, tracker))


def truth_traces(file: Path) -> list[Trace]:
    """Candidate traces of a truth file: the tip `p`, and `p_trk` where the drawn registration is in it.

    Raises:
        InputError: not such a file.
    """
    truth = read_truth(file)
    found = (truth.position, truth.tracker_position)
    return [Trace(truth.t, positions) for positions in found if positions is not None]


def compare(
    reference: str, target: Trace, open_loop: Trace, fused: Trace, since_s: float = 0.0
) -> LiveErrors:
    """Distances from `target` at its samples within both runs, from `since_s` on.

    Raises:
        ValueError: no sample of the reference lies in the run.
    """
    inside = (target.t >= since_s) & open_loop.covers(target.t) & fused.covers(target.t)
    if not inside.any():
        raise ValueError(f"no sample of the {reference} lies where both runs have outputs")
    t, p = target.t[inside], target.p[inside]
    a = np.linalg.norm(open_loop.at(t) - p, axis=1)
    f = np.linalg.norm(fused.at(t) - p, axis=1)
    return LiveErrors(reference, len(t), _rms(a), float(a.max()), _rms(f), float(f.max()))


def compare_truth(candidates: Sequence[Trace], open_loop: Trace, fused: Trace) -> LiveErrors:
    """The comparison with whichever candidate the fused tip is nearer to over the run."""
    found = [compare("truth", candidate, open_loop, fused, SETTLE_S) for candidate in candidates]
    return min(found, key=lambda comparison: comparison.fused_rms)


def comparisons(tracker: Trace, truth: Sequence[Trace], open_loop: Trace, fused: Trace) -> list[LiveErrors]:
    """With the tracker and the truth, as far as they have samples in the time of the run."""
    found = []
    if len(tracker.t):
        with contextlib.suppress(ValueError):
            found.append(compare("tracker", tracker, open_loop, fused))
    if truth:
        with contextlib.suppress(ValueError):
            found.append(compare_truth(truth, open_loop, fused))
    return found


def _rms(distances: Floats) -> float:
    return float(np.sqrt(np.mean(distances**2)))


def backbones(messages: Sequence[Received], start_ns: int, count: int) -> list[tuple[float, Floats]]:
    """Up to `count` evenly spaced backbones: time in s and points (n, 3) in m."""
    if not messages:
        return []
    chosen = np.unique(np.linspace(0, len(messages) - 1, count).astype(int))
    shapes = []
    for index in chosen:
        cloud = decode_point_cloud(messages[index].data)
        shapes.append(((cloud.stamp_ns - start_ns) * 1e-9, cloud.rows[:, 1:4].astype(float)))
    return shapes


def draw(
    file: Path,
    shapes: Sequence[tuple[float, Floats]],
    open_loop: Trace,
    fused: Trace,
    tracker: Trace,
    title: str,
) -> None:
    """Backbones, tip traces and distances from the tracker as a PNG; millimetres."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure = plt.figure(figsize=(14, 8), layout="constrained")
    grid = figure.add_gridspec(4, 2, width_ratios=(1, 1.6))
    views = {"side view": (2, 1, "z", "y"), "top view": (2, 0, "z", "x")}
    colours = plt.get_cmap("viridis")(np.linspace(0, 0.9, max(len(shapes), 1)))
    for row, (name, (across, up, across_name, up_name)) in enumerate(views.items()):
        axes = figure.add_subplot(grid[2 * row : 2 * row + 2, 0])
        for colour, (t, points) in zip(colours, shapes, strict=False):
            axes.plot(1e3 * points[:, across], 1e3 * points[:, up], color=colour, lw=1.5, label=f"{t:.1f} s")
        axes.plot(1e3 * fused.p[:, across], 1e3 * fused.p[:, up], color="tab:red", lw=0.6, label="fused tip")
        axes.set(xlabel=f"{across_name} (mm)", ylabel=f"{up_name} (mm)", title=f"backbone, {name}")
        axes.set_aspect("equal", adjustable="datalim")
        axes.grid(alpha=0.3)
        if row == 0:
            axes.legend(fontsize=7, loc="best")
    for axis, name in enumerate("xyz"):
        axes = figure.add_subplot(grid[axis, 1])
        axes.plot(tracker.t, 1e3 * tracker.p[:, axis], ".", ms=2, color="0.6", label="tracker")
        axes.plot(open_loop.t, 1e3 * open_loop.p[:, axis], color="tab:blue", lw=1, label="open loop")
        axes.plot(fused.t, 1e3 * fused.p[:, axis], color="tab:red", lw=1, label="fused")
        axes.set_ylabel(f"tip {name} (mm)")
        axes.grid(alpha=0.3)
        if axis == 0:
            axes.legend(fontsize=8, ncols=3, loc="upper right")
    axes = figure.add_subplot(grid[3, 1])
    inside = (tracker.t >= fused.t[0]) & (tracker.t <= fused.t[-1])
    t, p = tracker.t[inside], tracker.p[inside]
    axes.plot(t, 1e3 * np.linalg.norm(open_loop.at(t) - p, axis=1), color="tab:blue", lw=0.8)
    axes.plot(t, 1e3 * np.linalg.norm(fused.at(t) - p, axis=1), color="tab:red", lw=0.8)
    axes.set(xlabel="time (s)", ylabel="from tracker (mm)", ylim=(0, None))
    axes.grid(alpha=0.3)
    figure.suptitle(title)
    figure.savefig(file, dpi=110)
    plt.close(figure)
