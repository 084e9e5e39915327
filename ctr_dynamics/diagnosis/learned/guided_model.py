"""Guided model: a forward model whose tip hangs on its measured path by a spring and a damper.

In: a forward model and a point. Out: a forward model of the same recording, of which residuals and derivatives can be asked in the same way.
By itself a simulation with a missing force runs away from the measurement, in phase above all, and derivatives along it tell little. On the
measured path it stays near, its errors decay, and its residual is nearly linear in the missing force (output injection: Luenberger 1971).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline, CubicSpline, make_smoothing_spline
from scipy.optimize import brentq

from ctr_dynamics.diagnosis.forward_model import ForwardModel, Point
from ctr_dynamics.diagnosis.learned.dictionary import Features
from ctr_dynamics.effects import Plant, effect_quantities
from ctr_dynamics.errors import InputError
from ctr_dynamics.model.trajectory import InputRows

Floats = NDArray[np.float64]


def measured_tip(forward_model: ForwardModel, point: Point) -> tuple[Floats, Floats]:
    """Times (k,) s and positions (k, 3) m in base axes of the tip, as the tracker at ``point`` shows them.

    Raises:
        InputError: the model cannot be simulated at ``point``.
    """
    recording, plant = forward_model.recording, forward_model.plant(point)
    prediction = forward_model.predict(point)
    good = np.isfinite(recording.position).all(axis=1) & np.isfinite(prediction.position).all(axis=1)
    if prediction.failure or good.sum() < 5:
        raise InputError("the model cannot be simulated to the end of the recording")
    # rotations turn the short lever arm only: those of the prediction are good enough, and always there
    found = [
        plant.tracker.inverse(stamp, position, quaternion)
        for stamp, position, quaternion in zip(
            recording.stamps[good], recording.position[good], prediction.quaternion[good], strict=True
        )
    ]
    times, first = np.unique([time for time, _, _ in found], return_index=True)
    return times, np.array([position for _, position, _ in found])[first]


def smoothed(t: Floats, values: Floats, noise: float) -> BSpline:
    """The smoothest cubic spline that leaves of ``values`` (k,) at ``t`` (k,) what the ``noise`` does (Reinsch 1967)."""

    def beyond(log_penalty: float) -> float:
        left = make_smoothing_spline(t, values, lam=math.exp(log_penalty))(t) - values
        return float(np.mean(left**2)) - noise**2

    # in s^3: from an interpolating spline to a straight line
    low, high = 3.0 * math.log(1e-3 * float(np.median(np.diff(t)))), 3.0 * math.log(float(np.ptp(t)))
    if beyond(high) <= 0.0:
        return make_smoothing_spline(t, values, lam=math.exp(high))
    if beyond(low) >= 0.0:
        return make_smoothing_spline(t, values, lam=math.exp(low))
    return make_smoothing_spline(t, values, lam=math.exp(brentq(beyond, low, high, xtol=0.1)))


class GuidedModel(ForwardModel):
    """A forward model on the measured path, with a force that follows from this path.

    Args:
        forward_model: without guidance. point: where the path is seen from, and the tip's stiffness.
        features: of the force. delays_s: of what they remember.
    Attributes:
        tip_stiffness: N/m, against a force. stiffness: N/m of the spring, that of the tip to begin with.
    Raises:
        InputError: the model cannot be simulated at ``point``, or its tip does not give way.
    """

    def __init__(
        self, forward_model: ForwardModel, point: Point, features: Features, delays_s: Sequence[float]
    ) -> None:
        super().__init__(
            forward_model.recording, forward_model.robot, forward_model.options, forward_model.steps
        )
        times, positions = measured_tip(forward_model, point)
        noise = max(self.robot.tracker.noise.position.value, 1e-6)
        self._path = [smoothed(times, axis, noise) for axis in positions.T]
        self._velocity = [axis.derivative() for axis in self._path]
        self._span = times[0], times[-1]
        pushes = [q for q in effect_quantities(self.robot) if q.effect == "tip_force"]
        _, columns = forward_model.jacobian(point, pushes)
        compliance = np.linalg.norm(columns[:, :3] / np.array([q.scale for q in pushes]), axis=(1, 2))
        if not np.median(compliance) > 0.0:
            raise InputError("the tip does not give way to a force")
        self.stiffness = self.tip_stiffness = 1.0 / float(np.median(compliance))
        body = self.robot.tubes[0].end_body
        tubes = sum(tube.density.value * tube.area for tube in self.robot.tubes) * self.robot.exposed_length
        # a quarter of a cantilever's mass moves with its tip
        self._mass = (body.mass.value if body else 0.0) + 0.25 * tubes
        self._features, self._force = features, np.zeros(len(features.names))
        self._remembered = [self._delayed(delay) for delay in delays_s]

    @property
    def damping(self) -> float:
        """N s/m, such that the guided tip comes to rest within a few periods."""
        return math.sqrt(self.stiffness * self._mass)

    def _delayed(self, delay: float) -> CubicSpline:
        """What follows the measured path with ``delay`` (s)."""
        t = np.arange(0.0, self.recording.duration + self.scheme.dt, self.scheme.dt)
        p, keep = self._at(t)[0], math.exp(-self.scheme.dt / delay)
        z = [p[0]]
        for mean in 0.5 * (p[:-1] + p[1:]):
            z.append(keep * z[-1] + (1.0 - keep) * mean)
        return CubicSpline(t, np.array(z))

    def set_guidance(self, strength: float, coefficients: Floats) -> None:
        """A spring of ``strength`` times the stiffness of the tip; the force of the features with ``coefficients`` (names,) N acts on the tip."""
        self.stiffness, self._force = strength * self.tip_stiffness, coefficients

    def _at(self, times: Floats) -> tuple[Floats, Floats]:
        """Position and velocity (k, 3) of the measured path; held outside."""
        at = np.clip(times, *self._span)
        inside = (times > self._span[0]) & (times < self._span[1])
        position = np.stack([axis(at) for axis in self._path], axis=1)
        velocity = np.stack([axis(at) for axis in self._velocity], axis=1)
        return position, np.where(inside[:, None], velocity, 0.0)

    def _columns_of_force(self, rows: Floats, times: Floats) -> Floats:
        """(k, 3, names) N by coefficient, with the inputs ``rows`` at ``times`` (k,)."""
        n = self.nominal.n
        p, v = self._at(times)
        z = [path(times) for path in self._remembered]
        return self._features(p, v, z, rows[:, :n], rows[:, 2 * n : 3 * n])

    def plant(self, point: Point) -> Plant:
        """Plant at ``point`` with the spring and the damper of the guidance."""
        plant = super().plant(point)
        plant.add("spring_stiffness", self.stiffness)
        plant.add("spring_damping", self.damping)
        plant.extended = True
        return plant

    def inputs(self, plant: Plant, extended: bool) -> InputRows:
        """Actuators and load, the pull of spring and damper towards the measured path, and the force of the features."""
        rows = super().inputs(plant, extended)
        force = slice(3 * plant.n, 3 * plant.n + 3)

        def guided(times: Floats) -> Floats:
            out = rows(times)
            position, velocity = self._at(times)
            out[:, force] += self.stiffness * position + self.damping * velocity
            if self._force.any():
                out[:, force] += self._columns_of_force(out, times) @ self._force
            return out

        return guided

    def force_jacobian(self, point: Point, which: slice) -> Floats | None:
        """(s, 6, k) derivatives of the prediction at ``point`` by ``which`` coefficients; None where it cannot be simulated."""
        plant = self.plant(point)
        rows, n = self.inputs(plant, True), plant.n
        count, width = len(self._features.names[which]), self.models[True].input_count

        def input_effect(times: Floats) -> Floats:
            out = np.zeros((len(times), width, count))
            out[:, 3 * n : 3 * n + 3] = self._columns_of_force(rows(times), times)[:, :, which]
            return out

        effect = np.zeros((plant.layout.size, count))
        trajectory = self._run(plant, True, effect=effect, input_effect=input_effect)
        return None if trajectory.failure else np.nan_to_num(self._through(plant, trajectory))
