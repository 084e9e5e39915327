"""Tolerances of the robot file that the estimate refutes, and updates that leave one state alone because of it.

A robot that vibrates at another frequency than its model gets out of phase with it, which a delay of the tracker explains as well. Where the file is
wrong, the filter would become certain of a delay that there is not. The delay is then a consider state (Schmidt 1966): not estimated, with
its uncertainty in the covariance.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics import chi_square
from ctr_dynamics.estimation.filter.adapted_variances import joseph
from ctr_dynamics.sensing.tracker import DELAY, LEVER, STATE_NAMES, STATES

Floats = NDArray[np.float64]
SHORT = 3.0  # times too small, up to which parameters still follow the robot, and the estimated delay is worth more than its tolerance
PROBABILITY = 0.9999  # with which parameters by their tolerances lie as near the file as they are found; that of the gate for a measurement


class Tolerances:
    """What the robot file allows parameters, registration, lever arm and delay, beside what is found of them.

    With the tolerances as independent normal deviations, the squared distance of the estimate from the file, in units of them, is at most a
    chi-square variable. Where it is far larger, the tolerances are too small, or parameters have been bent to explain what the model lacks.

    Args:
        names, robot: (p,) the model's parameters and their deviations; 0 for those that are none of the file.
        states: (22,) deviations of the tracker states.
    """

    def __init__(self, names: tuple[str, ...], robot: Floats, states: Floats) -> None:
        self._rows = np.flatnonzero(robot > 0.0)
        fixed = np.r_[0 : LEVER.stop, DELAY]  # the others change with time
        self._states = fixed[states[fixed] > 0.0]
        of_states = [name for name, axes in STATE_NAMES for _ in range(axes)]
        self._names = [names[i] for i in self._rows] + [of_states[i] for i in self._states]
        self._sigma = np.concatenate([robot[self._rows], states[self._states]])
        count = len(self._sigma)
        self._limit = max(chi_square.quantile(PROBABILITY, count), SHORT**2 * count) if count else np.inf

    def _apart(self, theta: Floats, states: Floats) -> Floats:
        return np.concatenate([theta[self._rows], states[self._states]]) / self._sigma

    def rows(self, factor: Floats) -> Floats:
        """(k, r + 22) rows that give the errors of what has a tolerance, in units of it, from those of the coefficients and tracker states.

        ``factor`` (p, r): the parameters' rows of the covariance factor.
        """
        count, r = len(self._rows), factor.shape[1]
        rows = np.zeros((len(self._sigma), r + STATES))
        rows[:count, :r] = factor[self._rows]
        rows[np.arange(count, len(rows)), r + self._states] = 1.0
        rows /= self._sigma[:, None]
        return rows

    def refuted(self, theta: Floats, states: Floats, before: bool = False) -> bool:
        """Whether the estimate is all but impossible by the tolerances, or has been ``before`` and is not back where they have it.

        Args:
            theta: (p,) parameters.
            states: (22,) tracker states, less what is expected of them.
            before: whether it was refuted at the last measurement.
        """
        apart = self._apart(theta, states)
        return float(apart @ apart) > (len(apart) if before else self._limit)

    def farthest(self, theta: Floats, states: Floats) -> tuple[str, float]:
        """Name of the parameter that lies farthest from the file, and by how many of its tolerances; arguments as of :meth:`refuted`."""
        apart = np.abs(self._apart(theta, states))
        first = int(apart.argmax())
        return self._names[first], float(apart[first])


def release(at: int, deviation: float, pi: Floats) -> Floats:
    """Gain (n,) of a measurement of the state ``at`` without noise: by it everything moves with that state, for each unit that it moves.

    Of the covariance ``pi`` (n, n), in place, what that measurement leaves, with the state as uncertain as its ``deviation`` says, beside all else.
    """
    gain: Floats = pi[:, at] / pi[at, at]
    pi -= np.multiply.outer(gain, pi[at].copy())
    pi[at, :] = pi[:, at] = 0.0
    pi[at, at] = deviation**2
    return gain


def gain_beside(at: int, pi: Floats, H: Floats, R: Floats) -> tuple[Floats, Floats]:
    """Gain (n, k) of a measurement that leaves the state ``at`` alone and goes by all else, and the covariance (n, n) after it.

    Args:
        at: index of the state.
        pi: (n, n) covariance before the measurement.
        H, R: derivative (k, n) of the measurement and its noise (k, k).
    """
    rest = H.copy()
    rest[:, at] = 0.0
    columns = pi @ rest.T
    gain = np.ascontiguousarray(np.linalg.solve(rest @ columns + R, columns.T).T, dtype=np.float64)
    gain[at] = 0.0
    return gain, joseph(pi, gain, H, R)
