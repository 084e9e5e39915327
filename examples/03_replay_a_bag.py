"""A recorded bag through the estimator, message by message: the fused tip with its uncertainty against the truth.

    python examples/03_replay_a_bag.py [PICTURE.png]

`ctr_dynamics.replay` does the same in one call and writes bag, summary and report; here every step is at hand.
"""

from __future__ import annotations

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from ctr_dynamics import Estimator, Settings, load_robot, open_bag
from ctr_dynamics.io.shipped_bags import shipped_bag, shipped_truth
from ctr_dynamics.runtime.replay import Player


def main(picture: Path) -> dict[str, float]:
    """Replay, compare with the truth and draw; returns 3-D rms errors of the tip in m."""
    estimator = Estimator(load_robot("till2020_tissue"), Settings({"output.policy": "wait"}))
    steps = [out for out in Player(estimator).play(open_bag(shipped_bag())) if out.valid]
    t = np.array([out.stamp_ns - steps[0].stamp_ns for out in steps]) * 1e-9
    fused = np.array([out.tip_position for out in steps])
    open_loop = np.array([out.predicted_position for out in steps])
    sigma = np.array([np.sqrt(np.trace(out.tip_covariance[:3, :3])) for out in steps])  # 3-D, m

    truth = shipped_truth()  # of the simulator that made the bag
    if truth is None:
        raise RuntimeError("this installation lacks the truth of the shipped bag")
    with np.load(truth) as data:
        # where a tracker without errors would see the tip
        tip = np.column_stack([np.interp(t, data["t"], data["p_trk"][:, axis]) for axis in range(3)])
    errors = {
        "open loop": np.linalg.norm(open_loop - tip, axis=1),
        "fused": np.linalg.norm(fused - tip, axis=1),
    }
    for name, error in errors.items():
        plt.plot(t, 1e3 * error, label=name)
    plt.fill_between(t, 0.0, 2e3 * sigma, alpha=0.2, label="two standard deviations, fused")
    plt.xlabel("time (s)")
    plt.ylabel("tip error, 3-D (mm)")
    plt.legend()
    plt.savefig(picture, dpi=110)
    plt.close()
    rms = {name: float(np.sqrt(np.mean(error[t > 0.5] ** 2))) for name, error in errors.items()}
    for name, value in rms.items():
        print(f"{name:10s} {1e3 * value:.2f} mm rms after 0.5 s")
    return rms


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "replay.png"))
