"""What a calibrated model still gets wrong, as a prior of the estimator.

It is measured on held-out tips. What the tracker's noise and drift do not explain is the model's: position and rotation of the tip as a Gauss-Markov
process, whose deviation and correlation time are those of the residual.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.calibration.tip_fit import lasting_of
from ctr_dynamics.calibration.tip_samples import TipSamples
from ctr_dynamics.robot import Robot
from ctr_dynamics.robot.schema import ModelError

Floats = NDArray[np.float64]


def model_error_of(residual: Floats, samples: TipSamples, robot: Robot) -> ModelError | None:
    """The model error that held-out tips show.

    Args:
        residual: (s, 6) measured minus expected position m and rotation vector rad of the held-out ``samples``; NaN where there is no tip.
        samples: they tell the axes that are measured, and the time between two of them.
        robot: with the tracker's noise.

    Returns:
        None where there are no times, or where the position's residual is no more than noise: its variance is at most twice that of the tracker.
    """
    found = np.isfinite(residual[:, 0])
    if not samples.timed or found.sum() < 2:
        return None
    noise, own = robot.tracker.noise, residual[found]
    place, turn = own[:, :3][:, samples.axes[:3]], own[:, 3:][:, samples.axes[3:]]
    tracker = noise.position.value**2 + noise.drift.value**2  # of which the estimator has states of their own
    beyond = float(np.mean(place**2)) - tracker
    if beyond <= tracker:
        return None
    turned = max(float(np.mean(turn**2)) - noise.rotation.value**2, 0.0) if turn.size else 0.0
    period = float(np.median(np.diff(samples.stamps[found])))
    return ModelError.model_validate(
        {
            "position": {"value": float(np.sqrt(beyond)), "unit": "m"},
            "rotation": {"value": float(np.sqrt(turned)), "unit": "rad"},
            # 1 + 2 sum rho_k of a process that is sampled often is twice its correlation time in samples
            "time": {"value": 0.5 * period * lasting_of(own[:, :3]), "unit": "s"},
        }
    )
