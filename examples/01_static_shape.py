"""Static shapes: a robot at rest, with its outer tube turned, and with a force on its tip. Draws them and prints the tips.

python examples/01_static_shape.py [PICTURE.png]
"""

from __future__ import annotations

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from ctr_dynamics import Model, Statics, load_robot


def main(picture: Path) -> dict[str, np.ndarray]:
    """Solve three equilibria and draw their backbones; returns the tips (3,) m in ``ctr_base``."""
    robot = load_robot("till2020_tissue")
    statics = Statics(Model(robot, nodes=60))
    beta = np.array(robot.rest.beta.value)  # m, translations of the tubes' bases, innermost first
    alpha = np.array(robot.rest.alpha.value)  # rad, their angles
    cases = {
        "at rest": statics.solve(beta, alpha),
        "outer tube turned by 90 deg": statics.solve(beta, alpha + [0.0, np.pi / 2]),
        "0.2 N downwards on the tip": statics.solve(beta, alpha, force=(0.0, -0.2, 0.0)),
    }
    axes = plt.figure(figsize=(7, 6)).add_subplot(projection="3d")
    for name, shape in cases.items():
        if not shape.converged:
            raise RuntimeError(f"no equilibrium: {name}")
        x, y, z = 1e3 * shape.nodes[:, :3].T
        axes.plot(z, x, y, label=name)
        print(f"{name:28s} tip at {np.round(1e3 * shape.tip_position, 2)} mm")
    axes.set(xlabel="z (mm)", ylabel="x (mm)", zlabel="y (mm)", title=robot.name)
    axes.set_aspect("equal")
    axes.legend()
    plt.savefig(picture, dpi=110)
    plt.close()
    return {name: shape.tip_position for name, shape in cases.items()}


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "static_shape.png"))
