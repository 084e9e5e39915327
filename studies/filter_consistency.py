"""Is the published covariance right? NEES and NIS over many clean bags, each of another robot inside the file's tolerances.

    python -m studies.filter_consistency --cases 12

One bag holds a few independent values of the tracker's drift only, so the NEES of a single bag scatters widely about 1; the mean over many bags
tells whether the filter is consistent. The bags come from the truth generator of the diagnosis tests.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline

from studies import add_truth_path

SINCE_S = 0.5
SEED = 90_000


def consistency(bag: Path, stamps_s: np.ndarray, realised: np.ndarray) -> tuple[float, float, float]:
    """(NEES per degree of freedom, its 3-D rms error in m, NIS per degree of freedom) of a replay of ``bag``.

    ``realised`` (k, 3) m: the tip as the tracker realises it at ``stamps_s`` (k,) after the bag's start, which is what the fused tip estimates.
    """
    from ctr_dynamics.estimation.estimator import Estimator
    from ctr_dynamics.io.bag_reader import open_bag
    from ctr_dynamics.parameters import Settings
    from ctr_dynamics.robot_files import load_robot
    from ctr_dynamics.runtime.replay import Player

    robot = load_robot("till2020_tissue")
    estimator = Estimator(robot, Settings({"output.policy": "wait"}))
    opened = open_bag(bag)
    outputs = [out for out in Player(estimator).play(opened) if out.valid]
    t = np.array([out.stamp_ns - outputs[0].stamp_ns for out in outputs]) * 1e-9
    late = (t >= max(SINCE_S, stamps_s[0])) & (t <= stamps_s[-1])
    error = np.array([out.tip_position for out in outputs]) - CubicSpline(stamps_s, realised)(t)
    covariance = np.array([out.tip_covariance[:3, :3] for out in outputs])
    nees = np.einsum("ki,ki->k", error, np.linalg.solve(covariance, error[..., None])[..., 0]) / 3.0
    nis = estimator.health.measurements.nis_sum / estimator.health.measurements.nis_dof
    return float(nees[late].mean()), float(np.sqrt((error[late] ** 2).sum(axis=1).mean())), nis


def main() -> None:
    """Make the cases, replay both bags of each, print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", type=int, default=12)
    options = parser.parse_args()
    add_truth_path()
    from truth.cases import make_case

    rows: dict[str, list[tuple[float, float, float]]] = {"protocol": [], "sweep": []}
    for number in range(options.cases):
        with tempfile.TemporaryDirectory() as folder_name:
            case = make_case(SEED + number, "none", folder_name)
            truth = np.load(Path(folder_name) / "truth.npz")
            for name, bag in (("protocol", case.protocol), ("sweep", case.sweep)):
                row = consistency(bag, truth[f"{name}_t"], truth[f"{name}_realised"])
                rows[name].append(row)
                print(
                    f"{number} {name}: NEES {row[0]:.2f}, error {1e3 * row[1]:.3f} mm, NIS {row[2]:.3f}",
                    flush=True,
                )
    print(
        "\n| motion | bags | NEES / dof, mean | smallest to largest | fused tip, mm rms | NIS / dof |\n|---|---|---|---|---|---|"
    )
    for name, found in rows.items():
        nees, error, nis = np.array(found).T
        spread = nees.std(ddof=1) / np.sqrt(len(nees)) if len(nees) > 1 else float("nan")
        print(
            f"| {name} | {len(nees)} | {nees.mean():.2f} +- {spread:.2f} | {nees.min():.2f} to {nees.max():.2f} "
            f"| {1e3 * np.sqrt((error**2).mean()):.2f} | {nis.mean():.2f} |"
        )


if __name__ == "__main__":
    main()
