"""What the robot file is unsure of: the parameters that the filter carries, with their deviations and their effect on the model.

Model parameters and the unknown tip force move the fields and are rows of the covariance factor. Tracker errors (registration, lever arm, delay,
drift) enter the measurement only and are states of their own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.kernels.factor_operations import leaves_range
from ctr_dynamics.model.model import Model
from ctr_dynamics.robot import Robot, cantilever

Floats = NDArray[np.float64]

FORCE = ("tip_force.x", "tip_force.y", "tip_force.z")

# Ranges that a robot can have: of relative changes of a quantity, from a tenth of it to ten times, and of angles in rad (29 deg).
RELATIVE, ANGLE = (-0.9, 9.0), (-0.5, 0.5)


@dataclass(frozen=True)
class ModelUncertainty:
    """Parameters of the model that are uncertain.

    Attributes:
        names: (n_theta,) names; the last three are the tip force's axes.
        sigma: (n_theta,) prior deviations; 0 for the tip force, whose size the filter adapts.
        effect: (NP, n_theta) derivative of the parameter block.
        lowest, highest: (n_theta,) range that a robot can have; unlimited for the tip force.
    """

    names: tuple[str, ...]
    sigma: np.ndarray
    effect: np.ndarray
    lowest: np.ndarray
    highest: np.ndarray

    @property
    def force(self) -> slice:
        """Rows of the tip force among the parameters."""
        return slice(len(self.names) - 3, len(self.names))

    def confined(self, x: np.ndarray, theta: np.ndarray, rows: np.ndarray, pi: np.ndarray) -> np.ndarray:
        """The correction ``x`` (r + 22,), changed where it would move a parameter out of its range.

        It is moved along the covariance until that parameter is at the range's end. All else then takes its most likely value beside it
        (Simon 2010, projection of the estimate).

        Args:
            x: of the coefficients and the tracker states.
            theta: (p,) parameters before the correction.
            rows: (p, r) their rows of the covariance factor.
            pi: (r + 22, r + 22) covariance of what ``x`` corrects.
        """
        r = rows.shape[1]
        if not leaves_range(theta, rows, x[:r], self.lowest, self.highest):
            return x
        for _ in range(len(self.names)):
            moved = theta + rows @ x[:r]
            excess = np.clip(moved, self.lowest, self.highest) - moved
            if not excess.any():
                break
            i = int(np.argmax(np.abs(excess) / np.maximum(self.sigma, 1e-300)))
            gain = pi[:, :r] @ rows[i]
            variance = float(rows[i] @ gain[:r])
            if variance <= 1e-12 * self.sigma[i] ** 2:
                break
            x = x + gain * (excess[i] / variance)
        return x


# The range of the unknown tip force by what it does to the robot: the least moves the tip by this part of the tracker's noise, which no innovation
# shows; the most bends the robot by this part of its exposed length, about as far as small strains go.
LEAST_MOVED, MOST_MOVED = 0.005, 0.1


def force_range(robot: Robot, least: float, most: float) -> tuple[float, float]:
    """Deviations (N) between which that of the unknown tip force lies; those given as 0 come from the robot's compliance."""
    compliance = cantilever(robot).deflection
    most = most or max(MOST_MOVED * robot.exposed_length / compliance, least)
    return least or min(LEAST_MOVED * robot.tracker.noise.position.value / compliance, most), most


def model_uncertainty(model: Model) -> ModelUncertainty:
    """Uncertain parameters of ``model`` from its robot file's tolerances; those with tolerance 0 are left out."""
    robot: Robot = model.robot
    layout, nominal, n = model.layout, model.parameters, model.n
    names: list[str] = []
    sigma: list[float] = []
    effect: list[np.ndarray] = []
    ranges: list[tuple[float, float]] = []

    def add(name: str, deviation: float, column: np.ndarray, between: tuple[float, float] = RELATIVE) -> None:
        if deviation > 0.0 and np.any(column):
            names.append(name)
            sigma.append(deviation)
            effect.append(column)
            ranges.append(between)

    def scaled(*groups: tuple[str, int]) -> np.ndarray:
        column = np.zeros(layout.size)
        for group, tube in groups:
            row = layout[group].start + tube
            column[row] = nominal[row]
        return column

    for i, tube in enumerate(robot.tubes):
        stiffness = [("bending_stiffness", i)]
        if tube.shear_follows_youngs:
            stiffness.append(("torsional_stiffness", i))
        add(f"youngs_modulus.tube{i + 1}", tube.youngs_modulus.relative, scaled(*stiffness))
        if not tube.shear_follows_youngs:
            add(f"shear_modulus.tube{i + 1}", tube.shear.relative, scaled(("torsional_stiffness", i)))
        if any(np.any(segment.coefficients) for segment in tube.precurvature):
            add(f"precurvature.tube{i + 1}", tube.precurvature_tolerance, scaled(("precurvature", i)))
        if tube.end_body:
            column = np.zeros(layout.size)
            column[layout["body_mass"].start + i] = 1.0
            mass = tube.end_body.mass
            least, most = RELATIVE[0] * mass.value, RELATIVE[1] * max(mass.value, mass.tolerance)
            add(f"payload_mass.tube{i + 1}", mass.tolerance, column, (least, most))
    # densities of one alloy vary together: one scale for all tubes
    groups = [(group, i) for i in range(n) for group in ("mass_per_length", "inertia_per_length")]
    add("density", max(tube.density.relative for tube in robot.tubes), scaled(*groups))
    for name, quantity in (
        ("base_coulomb", robot.friction.base.coulomb),
        ("base_viscous", robot.friction.base.viscous),
        ("tube_coulomb", robot.friction.tubes.coulomb),
        ("tube_viscous", robot.friction.tubes.viscous),
    ):
        add(name, quantity.relative, scaled((name, 0)))
    add("friction_epsilon", robot.friction.epsilon.relative, scaled(("epsilon", 0)))
    g = np.array(robot.gravity.value)
    if np.any(g):
        across = np.linalg.svd(g[None] / np.linalg.norm(g))[2][1:]
        for axis, direction in zip("12", across, strict=True):
            column = np.zeros(layout.size)
            column[layout["gravity"]] = np.cross(direction, g)
            add(f"gravity_direction.{axis}", robot.gravity.direction_tolerance, column, ANGLE)
    actuators = model.plant.actuators
    rest = actuators.inverse(np.array([*robot.rest.alpha.value, *robot.rest.beta.value]))
    by_offset = actuators.derivative("offset", rest)
    for i in range(n):
        column = np.zeros(layout.size)
        column[layout["alpha"].start + i] = by_offset[i]
        add(f"encoder_offset.tube{i + 1}", robot.encoders.offset.tolerance, column, ANGLE)
    for number, name in enumerate(FORCE):
        column = np.zeros(layout.size)
        column[layout["force"].start + number] = 1.0
        names.append(name)
        sigma.append(0.0)
        effect.append(column)
        ranges.append((-np.inf, np.inf))
    lowest, highest = np.array(ranges).T
    return ModelUncertainty(tuple(names), np.array(sigma), np.array(effect).T, lowest, highest)


def values_and_deviations(
    names: Sequence[str], theta: Floats, rows: Floats | None, pi: Floats
) -> dict[str, dict[str, float | None]]:
    """Estimated changes ``theta`` (p,) of parameters by their ``names``, with deviations by ``rows`` (p, r) and the covariance ``pi``, or without."""
    sigma: list[float | None] = [None] * len(theta)
    if rows is not None:
        r = rows.shape[1]
        variance = np.einsum("ij,jk,ik->i", rows, pi[:r, :r], rows)
        sigma = np.sqrt(np.maximum(variance, 0.0)).tolist()
    return {
        name: {"value": float(value), "sigma": deviation}
        for name, value, deviation in zip(names, theta, sigma, strict=True)
    }
