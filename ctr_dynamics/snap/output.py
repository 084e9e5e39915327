"""Files of a snap run: tables, plots and a bag of the moving backbone."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ctr_dynamics.io.atomic_files import atomic_file
from ctr_dynamics.io.bag_writer import write_bag
from ctr_dynamics.io.messages.encode import encode_joint_state
from ctr_dynamics.io.messages.templates import Template, path, stamped_numbers
from ctr_dynamics.snap.experiment import Trajectory
from ctr_dynamics.snap.features import Extremum
from ctr_dynamics.snap.scurve import SCurve

FRAME = "ctr_base"
BACKBONE, INNER, OUTER, ANGLES = (
    "/ctr/snap/backbone",
    "/ctr/snap/inner_tip",
    "/ctr/snap/outer_tip",
    "/ctr/snap/angles",
)


def write_table(file: Path, header: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    """A CSV file that appears when it is complete. Numbers are written so that they read back the same."""
    with atomic_file(file) as part, part.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(header)
        writer.writerows([[float(c) if isinstance(c, np.floating) else c for c in row] for row in rows])


def write_trajectory(file: Path, run: Trajectory) -> None:
    """One row a step: t_s, theta_b, theta_f, tips (m, ``ctr_base``), marker_angle; rad."""
    header = ["t_s", "theta_b", "theta_f"] + [
        f"{which}_tip_{axis}" for which in ("inner", "outer") for axis in "xyz"
    ]
    table = np.column_stack([run.t, run.theta_b, run.theta_f, run.inner_tip, run.outer_tip, run.marker_angle])
    # 14 digits: enough for differences of 1e-12 rad, without the noise of binary fractions in t = k dt
    rows = ([f"{value:.14g}" for value in row] for row in table)
    write_table(file, [*header, "marker_angle"], rows)


def write_scurve(file: Path, curve: SCurve) -> None:
    """theta_b, theta_f (rad) and stability, det(d alpha / d psi_L)."""
    write_table(
        file,
        ["theta_b", "theta_f", "stability"],
        zip(curve.theta_b, curve.theta_f, curve.stability, strict=True),
    )


def write_peaks(file: Path, found: Sequence[Extremum]) -> None:
    """kind, t_s, theta_f of the peaks and troughs after the snap."""
    write_table(file, ["kind", "t_s", "theta_f"], ((e.kind, e.t_s, e.theta_f) for e in found))


def write_json(file: Path, values: Mapping[str, Any]) -> None:
    """Figures as JSON."""
    with atomic_file(file) as part:
        part.write_text(json.dumps(values, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def write_backbones(file: Path, run: Trajectory, slower: float, metadata: Mapping[str, str]) -> int:
    """A bag of the kept backbones for Foxglove or RViz, ``slower`` times slower than the motion; returns the number of messages.

    nav_msgs/Path along tube 1, geometry_msgs/PoseStamped of its tip, the position of tube 2's end with the orientation of the backbone
    there, and the angles theta_b, theta_f and marker_angle as a sensor_msgs/JointState.
    """
    nodes = run.positions.shape[1]
    whole, inner, outer = (
        Template(path(BACKBONE, FRAME, nodes)),
        Template(stamped_numbers(INNER, FRAME, 7)),
        Template(stamped_numbers(OUTER, FRAME, 7)),
    )
    theta_b = np.concatenate([[run.theta_b_rest], run.theta_b])
    theta_f = np.concatenate([[run.theta_f_rest], run.theta_f])
    marker = np.concatenate([[run.theta_f_rest], run.marker_angle])
    steps = np.concatenate([[0.0], run.t])
    types = {
        BACKBONE: "nav_msgs/msg/Path",
        INNER: "geometry_msgs/msg/PoseStamped",
        OUTER: "geometry_msgs/msg/PoseStamped",
        ANGLES: "sensor_msgs/msg/JointState",
    }
    count = 0
    with write_bag(file, metadata) as bag:
        for t, positions, quaternions in zip(run.frame_t, run.positions, run.quaternions, strict=True):
            stamp = round(t * slower * 1e9)
            k = int(np.argmin(np.abs(steps - t)))
            xyzw = quaternions[:, [1, 2, 3, 0]]
            end = positions[-1] if not len(run.outer_tip) or k == 0 else run.outer_tip[k - 1]
            near = int(np.argmin(((positions - end) ** 2).sum(axis=1))) if k else nodes - 1
            messages = [
                (BACKBONE, whole.fill(stamp, np.column_stack([positions, xyzw]))[0]),
                (INNER, inner.fill(stamp, positions[-1], xyzw[-1])[0]),
                (
                    ANGLES,
                    encode_joint_state(
                        stamp,
                        ["theta_b", "theta_f", "marker_angle"],
                        [float(theta_b[k]), float(theta_f[k]), float(marker[k])],
                    ),
                ),
            ]
            if k:
                messages.append((OUTER, outer.fill(stamp, positions[near], xyzw[near])[0]))
            for topic, data in messages:
                bag.write(topic, stamp, data, types[topic])
                count += 1
    return count


def write_plots(
    folder: Path, run: Trajectory | None, curve: SCurve | None, found: Sequence[Extremum], title: str
) -> list[Path]:
    """theta_f.png and scurve.png in ``folder``; returns the files."""
    # imported late: it takes longer than the rest of the command line, and needs no display
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    files = []

    def save(figure: Figure, name: str) -> None:
        FigureCanvasAgg(figure)
        figure.tight_layout()
        with atomic_file(folder / name) as part:
            figure.savefig(part, dpi=130, format="png")
        files.append(folder / name)

    if run is not None and len(run.t):
        figure = Figure(figsize=(8, 4.5))
        axes = figure.subplots()
        axes.plot(1e3 * run.t, run.theta_f, lw=1.0, label="theta_f")
        axes.plot(1e3 * run.t, run.marker_angle, lw=0.6, alpha=0.7, label="angle between the markers")
        for e in found:
            axes.plot(1e3 * e.t_s, e.theta_f, "^" if e.kind == "peak" else "v", color="k", ms=4)
        axes.set_xlabel("time (ms)")
        axes.set_ylabel("tip angle (rad)")
        axes.set_title(title)
        axes.grid(alpha=0.3)
        axes.legend()
        save(figure, "theta_f.png")
    if curve is not None:
        figure = Figure(figsize=(6, 5))
        axes = figure.subplots()
        stable = np.where(curve.stability > 0, curve.theta_b, np.nan)
        unstable = np.where(curve.stability <= 0, curve.theta_b, np.nan)
        axes.plot(stable, curve.theta_f, color="C0", label="stable")
        axes.plot(unstable, curve.theta_f, color="C0", ls="--", label="unstable")
        if run is not None and len(run.t):
            axes.plot(run.theta_b, run.theta_f, color="C3", lw=0.8, label="motion")
        if curve.snap is not None:
            axes.plot(*curve.snap, "ko", ms=4, label=f"snap at {curve.snap[0]:.4f} rad")
        axes.set_xlabel("base angle theta_b (rad)")
        axes.set_ylabel("tip angle theta_f (rad)")
        axes.set_title(title)
        axes.grid(alpha=0.3)
        axes.legend()
        save(figure, "scurve.png")
    return files
