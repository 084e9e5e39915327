"""Watch over elastic stability while a robot moves: how far the equilibrium of the present actuators is from its fold, and when it is reached.

The measure is det(d alpha / d psi_L) of :meth:`ctr_dynamics.model.statics.Statics.stability` at the static equilibrium that belongs to the
present actuators and load, followed from call to call. It is positive on stable branches and 0 where the robot snaps. Near a fold it falls
like the square root of the remaining actuator motion, so that its square runs to zero along a straight line: that line gives the time to
the snap.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ctr_dynamics.model.mesh import Mesh
from ctr_dynamics.model.model import Model
from ctr_dynamics.model.statics import StaticProblem

TOLERANCE = 1e-6  # of the scaled residual: the measure then has five digits
HELD = 1e-4  # change of the measure between calls, relative, below which the robot counts as standing


def time_to_snap(t0: float, s0: float, t1: float, s1: float) -> float | None:
    """Seconds from ``t1`` until the stability measure is 0, from its values ``s0`` at ``t0`` and ``s1`` at ``t1``; None when it does not fall.

    s^2 is linear in the actuators' way to a fold (the normal form of a saddle-node).
    """
    if not (t1 > t0 and s1 > 0.0 and s0 - s1 > HELD * abs(s0)):
        return None
    fall = (s0 * s0 - s1 * s1) / (t1 - t0)
    return s1 * s1 / fall


@dataclass(frozen=True)
class Stability:
    """What the watch says.

    Attributes:
        measure: det(d alpha / d psi_L); NaN when ``lost``.
        time_to_snap: s, None while the robot does not move towards a fold.
        lost: there is no equilibrium near the last one: the fold has been passed.
    """

    measure: float
    time_to_snap: float | None
    lost: bool

    @property
    def stable(self) -> bool:
        """Whether the robot rests on a stable branch."""
        return not self.lost and self.measure > 0.0


class StabilityWatch:
    """Follows the static equilibrium of moving actuators and its stability.

    One call solves the statics from the last solution and takes one sweep of 16 lanes: some tenths of a millisecond at 24 nodes.

    Args:
        model: the robot; shared with the estimator.
        parameters: (NP,) block instead of the robot file's.
    """

    def __init__(self, model: Model, parameters: np.ndarray | None = None) -> None:
        self.model = model
        self.parameters = (model.parameters if parameters is None else parameters).copy()
        self._x: np.ndarray | None = None
        self._solved: StaticProblem | None = None  # what that was found with
        self._last: tuple[float, float] | None = None
        self._problems: dict[int, tuple[Mesh, StaticProblem]] = {}

    def reset(self) -> None:
        """Forget the last equilibrium, as after a snap or a restart."""
        self._x = self._last = None

    def update(
        self,
        t: float,
        beta: np.ndarray,
        alpha: np.ndarray,
        force: np.ndarray | None = None,
        torque: np.ndarray | None = None,
        guess: np.ndarray | None = None,
    ) -> Stability:
        """Stability at time ``t`` (s) for beta (N,) m, alpha (N,) rad and a wrench on the tip (N, N m, ``ctr_base``).

        ``guess`` (5 + N,): unknowns of the shooting problem to start from where there is no last equilibrium, or none near it, such as those of
        the dynamic model's last step.

        Raises:
            InputError: translations out of range.
        """
        layout, par = self.model.layout, self.parameters
        problem = self._problem(beta)
        par[layout["alpha"]], par[layout["alpha_rate"]], par[layout["beta"]] = alpha, 0.0, beta
        par[layout["force"]] = 0.0 if force is None else force
        par[layout["torque"]] = 0.0 if torque is None else torque
        followed = self._x is not None
        found, x = False, np.zeros(self.model.unknown_count)
        for start in (self._x, guess, None if followed else x):
            if start is not None and not found:
                x = np.array(start, float)
                known = start is self._x and problem is self._solved  # then so is the Jacobian, nearly
                found = bool(np.isfinite(x).all()) and problem.newton(par, x, fresh=not known)
                if found and start is not self._x:
                    self._last = None  # another branch: no common line
        if not found:
            self.reset()
            return Stability(math.nan, None, True)
        self._x, self._solved = x, problem
        measure = problem.stability(par, x)
        ahead = time_to_snap(*self._last, t, measure) if self._last is not None else None
        if self._last is None or t > self._last[0]:
            self._last = (t, measure)
        return Stability(measure, ahead, not math.isfinite(measure))

    def _problem(self, beta: np.ndarray) -> StaticProblem:
        if self._solved is not None and np.array_equal(beta, self._solved.beta):
            return self._solved
        _, mesh = self.model.mesh(beta)
        kept = self._problems.get(id(mesh))
        if kept is None or kept[0] is not mesh:
            if len(self._problems) > 8:
                self._problems.clear()
            kept = (mesh, StaticProblem(self.model, mesh, beta, TOLERANCE))
            self._problems[id(mesh)] = kept
        problem = kept[1]
        problem.move(beta)
        return problem
