"""S-curves: static end angle against base angle of tube 1, its folds, and the stability on the way (Gilbert et al. 2016).

The curve is followed in the end angle theta_f = psi_L2 - psi_L1, in which it is single-valued: beside the unknowns of the shooting problem
the actuator angle of tube 1 is unknown too, and theta_f is prescribed. Both solvers share robot, model and static equations; the fourth-order
sweep of :mod:`ctr_dynamics.model.statics` is the one used here.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ctr_dynamics.errors import InputError
from ctr_dynamics.kernels.layout import state_rows
from ctr_dynamics.model.model import Model
from ctr_dynamics.model.statics import StaticProblem, Statics
from ctr_dynamics.robot import Robot

NODES = 100  # of the sweep: the curve then lies within 1e-9 rad of a refined one


@dataclass(frozen=True)
class SCurve:
    """A static S-curve.

    Attributes:
        theta_b: (k,) rad, base angle alpha_2 - alpha_1; theta_f: (k,) rad, end angle psi_L2 - psi_L1.
        stability: (k,) det(d alpha / d psi_L) with the loads held; positive where the equilibrium is stable.
    """

    theta_b: np.ndarray
    theta_f: np.ndarray
    stability: np.ndarray

    def folds(self) -> list[tuple[float, float, bool]]:
        """(theta_b, theta_f, opens) of every fold, by parabolas; ``opens`` where stability is lost as theta_f grows."""
        rising = np.sign(np.diff(self.theta_b))
        found = []
        for i in np.flatnonzero(rising[1:] * rising[:-1] < 0) + 1:
            x = self.theta_f[i - 1 : i + 2] - self.theta_f[i]
            c2, c1, c0 = np.polyfit(x, self.theta_b[i - 1 : i + 2], 2)
            at = -c1 / (2 * c2)
            found.append((float(c0 + 0.5 * c1 * at), float(self.theta_f[i] + at), bool(rising[i - 1] > 0)))
        return found

    @property
    def snap(self) -> tuple[float, float] | None:
        """(theta_b, theta_f) rad of the first snap while theta_b grows, None without a fold."""
        return next(((b, f) for b, f, opens in self.folds() if opens), None)


def s_curve(
    robot: Robot,
    beta: np.ndarray,
    alpha_2: float = 0.0,
    points: int = 1000,
    last: float = 2.0 * np.pi,
    nodes: int = NODES,
) -> SCurve:
    """S-curve of ``points`` end angles from 0 to ``last`` rad at the translations ``beta`` (N,) m, the outer tubes held at ``alpha_2`` rad.

    Raises:
        InputError: fewer than two tubes, or a point that Newton's method does not reach.
    """
    if robot.n_tubes < 2:
        raise InputError(f"robot {robot.name} has one tube", do="an S-curve needs two")
    model = Model(robot, nodes=nodes)
    n, m = model.n, model.unknown_count
    layout = model.layout
    beta = np.asarray(beta, float)
    alpha = np.full(n, alpha_2)
    start = Statics(model).solve(beta, alpha)
    if not start.converged:
        raise InputError("no static equilibrium with all tubes aligned", do="check the robot file")
    par = model.parameters.copy()
    par[layout["beta"]] = beta
    problem = StaticProblem(model, start.mesh, beta, 1e-9)
    z = np.concatenate([start.x, [alpha_2]])
    unit = np.concatenate([model.perturbation * 1e6, [1.0]])  # of each unknown
    before = z
    targets = np.linspace(0.0, last, points)
    theta_b, stability = np.empty(points), np.empty(points)
    for k, target in enumerate(targets):
        guess = 2.0 * z - before if k > 1 else z.copy()
        joint = np.empty(0)
        for _ in range(20):
            alpha[0] = guess[m]
            par[layout["alpha"]] = alpha
            problem.sweep(par, guess[:m])
            b = problem.single
            psi = problem.end_angles(b.fields[:, None], b.nodes.reshape(-1, state_rows(n).size, 1))[:, 0]
            value = np.concatenate([b.residual / model.scale, [psi[1] - psi[0] - target]])
            if np.abs(value).max() < 1e-10:
                break
            joint = problem.joint_jacobian(par, guess[:m])
            jacobian = np.vstack(
                [joint[:m, : m + 1] / model.scale[:, None], joint[m + 1, : m + 1] - joint[m, : m + 1]]
            )
            guess = guess - unit * np.linalg.solve(jacobian * unit, value)
            if not np.isfinite(guess).all():
                raise InputError(
                    f"S-curve: no equilibrium found at theta_f {target:.4f} rad", do="take more points"
                )
        else:
            raise InputError(
                f"S-curve: no equilibrium found at theta_f {target:.4f} rad", do="take more points"
            )
        before, z = z, guess
        theta_b[k] = alpha_2 - z[m]
        stability[k] = problem.stability(par, z[:m])
    return SCurve(theta_b, targets, stability)
