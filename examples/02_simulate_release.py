"""A weight is cut off the tip: the model steps in time, and the tip swings. Compares two time schemes at the same step of 3 ms.

python examples/02_simulate_release.py [PICTURE.png]
"""

from __future__ import annotations

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from ctr_dynamics import Inputs, Model, Simulator, load_robot
from ctr_dynamics.model.time_scheme import make_scheme

STEP_S, CUT_S, END_S = 0.003, 0.1, 1.0
FORCE_N = 60e-3 * 9.81  # a weight of 60 g


def main(picture: Path) -> dict[str, np.ndarray]:
    """Simulate with each scheme and draw the tip's height; returns the tips (steps + 1, 3) m."""
    robot = load_robot("till2020_tissue")
    alpha, beta, still = np.array(robot.rest.alpha.value), np.array(robot.rest.beta.value), np.zeros(2)

    def inputs_at(t: float) -> Inputs:
        """The tubes stand still; the weight goes within 10 ms."""
        share = min(max((CUT_S + 0.01 - t) / 0.01, 0.0), 1.0)
        return Inputs(alpha, still, beta, still, force=np.array([0.0, -share * FORCE_N, 0.0]))

    tips = {}
    for scheme in ("sdirk3", "bdf2"):
        simulator = Simulator(Model(robot), make_scheme(scheme, STEP_S))
        state = simulator.rest(inputs_at(0.0))
        path = [state.nodes[-1, :3].copy()]
        for k in range(round(END_S / STEP_S)):
            result = simulator.step(state, k * STEP_S, inputs_at, events=[CUT_S, CUT_S + 0.01])
            if not result.ok:
                raise RuntimeError(f"step {k}: {result.reason}")
            path.append(state.nodes[-1, :3].copy())
        tips[scheme] = np.array(path)
        plt.plot(STEP_S * np.arange(len(path)), 1e3 * tips[scheme][:, 1], label=scheme)
    plt.xlabel("time (s)")
    plt.ylabel("height of the tip (mm)")
    plt.title("60 g cut off at 0.1 s")
    plt.legend()
    plt.savefig(picture, dpi=110)
    plt.close()
    difference = np.linalg.norm(tips["sdirk3"] - tips["bdf2"], axis=1).max()
    print(f"the tip swings over {1e3 * np.ptp(tips['sdirk3'][:, 1]):.1f} mm")
    print(f"bdf2 differs from the third-order scheme by up to {1e3 * difference:.1f} mm")
    return tips


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "release.png"))
