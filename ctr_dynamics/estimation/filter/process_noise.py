"""Process noise: the unknown tip force, the model error and the tracker's drift decay (Gauss-Markov) and get new randomness.

With the time constant T and n steps of dt, a state x of stationary variance s^2 becomes d x + w, with d = exp(-n dt / T) and
var w = (1 - d^2) s^2. The tip force moves the fields, so its randomness is appended to the covariance factor as columns of its own. The model error
and the drift are tracker states.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.estimation.filter.adapted_variances import AdaptedVariances
from ctr_dynamics.estimation.filter.covariance_factor import CovarianceFactor
from ctr_dynamics.estimation.filter.factor_reduction import APPENDED
from ctr_dynamics.estimation.filter.filter_records import ModelErrorSize
from ctr_dynamics.kernels.factor_operations import decay
from ctr_dynamics.robot import Robot
from ctr_dynamics.sensing.tracker import DRIFT, MODEL_POSITION, MODEL_ROTATION, STATES

Floats = NDArray[np.float64]


class ProcessNoise:
    """Process noise of one filter.

    Args:
        robot: with its model error and the tracker's drift.
        dt: s, one step.
        force_rows: rows of the tip force among the uncertain parameters.
        force_time: s, time constant of the tip force.
        adapted: variances of force and tracker.
    """

    def __init__(
        self, robot: Robot, dt: float, force_rows: slice, force_time: float, adapted: AdaptedVariances
    ) -> None:
        self.dt, noise = dt, robot.tracker.noise
        self._drift = (DRIFT, noise.drift.value, noise.drift_time.value)
        self.model_error = ModelErrorSize.of_robot(robot)
        self._rows, self._time = force_rows, force_time
        self.adapted = adapted
        self._decay = math.exp(-dt / force_time)

    def decay_force(self, theta: Floats, factor: CovarianceFactor) -> None:
        """The tip force of the parameters ``theta`` (p,) and its rows of the factor decay over one step, in place."""
        decay(self._decay, theta[self._rows], factor.theta[self._rows])

    def add(self, steps: int, pi: Floats, bias: Floats, factor: CovarianceFactor) -> Floats:
        """Process noise of the last ``steps`` steps.

        The tracker states ``bias`` (22,) and the covariance ``pi`` (r + 22, r + 22) change in place. The factor gets a column for each axis of
        the force, and the covariance with them is returned.
        """
        error = self.model_error
        for part, sigma, time in (
            self._drift,
            (MODEL_POSITION, error.position, error.time),
            (MODEL_ROTATION, error.rotation, error.time),
        ):
            self._wander(part, sigma, math.exp(-steps * self.dt / time), pi, bias)
        return self._force(steps, pi, factor)

    def _wander(self, part: slice, sigma: float, remains: float, pi: Floats, bias: Floats) -> None:
        """The tracker states ``part`` of stationary deviation ``sigma`` decay by ``remains``, and get the randomness that keeps it."""
        first = len(pi) - STATES
        rows = slice(first + part.start, first + part.stop)
        bias[part] *= remains
        pi[rows, :] *= remains
        pi[:, rows] *= remains
        pi[rows, rows] += np.eye(3) * ((1 - remains**2) * sigma**2)
        self.adapted.decay(rows, remains)

    def _force(self, steps: int, pi: Floats, factor: CovarianceFactor) -> Floats:
        """The new columns move nothing but the force so far; their coefficients have the variance 1 - d^2."""
        remains2 = math.exp(-2 * steps * self.dt / self._time)
        r = factor.theta.shape[1]
        wide = r + APPENDED
        theta = np.zeros((len(factor.theta), wide))
        theta[:, :r] = factor.theta
        theta[self._rows, r:] = self.adapted.sigma * np.eye(3)
        factor.theta = theta
        wider = np.zeros((wide + STATES, wide + STATES))
        wider[:r, :r], wider[:r, wide:] = pi[:r, :r], pi[:r, r:]
        wider[wide:, :r], wider[wide:, wide:] = pi[r:, :r], pi[r:, r:]
        np.fill_diagonal(wider[r:wide, r:wide], 1.0 - remains2)
        self.adapted.append(r, APPENDED, 1.0 - remains2)
        return wider
