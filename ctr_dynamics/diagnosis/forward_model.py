"""Forward model: one recording seen through the model.

In: a recording, a robot, and coordinates of effects. Out: what the tracker should have measured, and its derivatives. The way is the
estimator's: encoder readings to actuators (:class:`ctr_dynamics.effects.Plant`), the dynamic model, tip to tracker. Derivatives by
quantities that move the model go through the tangent of every step; those of the tracker are differences of the tracker model only.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from joblib import delayed
from numpy.typing import NDArray

from ctr_dynamics.diagnosis.diagnosis_options import ForwardModelOptions
from ctr_dynamics.diagnosis.recording import Recording
from ctr_dynamics.diagnosis.run_context import count_workers, run_jobs
from ctr_dynamics.diagnosis.time_steps import TimeSteps
from ctr_dynamics.effects import EFFECTS, EffectQuantity, Plant, make_plant
from ctr_dynamics.errors import InputError
from ctr_dynamics.kernels.kinds import SIMD_WIDTH
from ctr_dynamics.kernels.rotations import conjugate_rows, multiply_rows, to_vector_rows
from ctr_dynamics.model.collocation_steps import RESCUE
from ctr_dynamics.model.collocation_trajectory import run_collocation
from ctr_dynamics.model.model import Model
from ctr_dynamics.model.time_scheme import collocation, make_scheme
from ctr_dynamics.model.trajectory import InputRows, Trajectory, run
from ctr_dynamics.robot import Robot
from ctr_dynamics.sensing.interpolation import Signal
from ctr_dynamics.sensing.tracker import free_axis, pose_differences

Floats = NDArray[np.float64]
MANY = 8  # columns from which two simulations are worth the second one's run
Key = tuple[str, str]
"""Effect and name of a quantity."""
Point = Mapping[Key, float]
"""Coordinates of quantities that are not at their off-values, on top of the extensions of the robot file."""


@dataclass(frozen=True)
class Prediction:
    """What the tracker should have measured.

    Attributes:
        position: (s, 3) m; quaternion: (s, 4) wxyz, at the recording's stamps. trajectory: the tip behind it. failure: empty when whole.
    """

    position: Floats
    quaternion: Floats
    trajectory: Trajectory
    failure: str


class ForwardModel:
    """A recording and a robot.

    Args:
        options: resolution of the model.
        steps: in time; None where all are those of the options.
    Attributes:
        models: without extended physics and with it. nominal: plant of the robot file.
    """

    def __init__(
        self,
        recording: Recording,
        robot: Robot,
        options: ForwardModelOptions | None = None,
        steps: TimeSteps | None = None,
    ) -> None:
        self.recording, self.robot, self.steps = recording, robot, steps
        self.options = options or ForwardModelOptions()
        nodes, dt = self.options.nodes, self.options.dt_s
        self.nodes = nodes
        self.scheme = collocation(dt)
        self.models = {False: Model(robot, nodes=nodes), True: Model(robot, nodes=nodes, extended=True)}
        self.nominal = make_plant(robot)
        self._free = free_axis(np.array(recording.axes))
        load = Signal(6)
        for time, *wrench in recording.load.tolist():
            load.add(round(time * 1e9), np.array(wrench))
        # a step across a slope discontinuity of the load would make the error of the prediction depend on where in the step it lies, and the
        # misfit a rough function of every delay
        discontinuities = load.slope_changes(-np.inf, np.inf, self.models[False].load_slope_limit / dt)
        self._load_events = 1e-9 * np.array(discontinuities, dtype=float)

    def resolved(self, nodes: int, dt: float) -> ForwardModel:
        """The same at another resolution; longer steps change as ``dt`` (s), the shortest."""
        options = replace(self.options, nodes=nodes, dt_s=dt)
        if options == self.options:
            return self
        steps = None if self.steps is None else self.steps.scaled(dt / self.options.dt_s)
        return ForwardModel(self.recording, self.robot, options, steps)

    def with_steps(self, steps: TimeSteps | None) -> ForwardModel:
        """The same with other steps in time."""
        return self if steps == self.steps else ForwardModel(self.recording, self.robot, self.options, steps)

    def with_least_step(self, dt: float) -> ForwardModel:
        """The same with steps of ``dt`` (s) where they are shorter."""
        if self.steps is None:
            return self.resolved(self.nodes, max(dt, self.scheme.dt))
        return self.with_steps(self.steps.at_least(dt))

    @property
    def shortest_step(self) -> float:
        """s"""
        return self.scheme.dt if self.steps is None else self.steps.shortest

    @property
    def longest_step(self) -> float:
        """s"""
        return self.scheme.dt if self.steps is None else self.steps.longest

    def until(self, end: float) -> ForwardModel:
        """The same up to ``end`` (s)."""
        return ForwardModel(self.recording.until(end), self.robot, self.options, self.steps)

    # -- the chain --

    def plant(self, point: Point) -> Plant:
        """Plant at ``point``."""
        return make_plant(self.robot, values_at(point))

    def inputs(self, plant: Plant, extended: bool) -> InputRows:
        """Actuators and load at any times, as the model takes them."""
        n, joints, load, actuators = plant.n, self.recording.joints, self.recording.load, plant.actuators
        t = joints[:, 0]
        position = actuators.behind_backlash(actuators.forward(joints[:, 1 : 1 + 2 * n]))
        alpha, beta = position[:, :n], position[:, n:]
        steps = np.diff(t)
        turned = smooth(t, alpha, self.options.joint_gap_s)
        slides = np.diff(beta, axis=0) / steps[:, None]
        width = (4 if extended else 3) * n + 6

        def rows(times: Floats) -> Floats:
            out = np.zeros((len(times), width))
            out[:, :n], out[:, n : 2 * n] = turned(times - actuators.delay)
            for i in range(n):
                out[:, 2 * n + i] = np.interp(times, t, beta[:, i])
            if len(load):
                for i in range(6):
                    out[:, 3 * n + i] = np.interp(times - plant.load_delay, load[:, 0], load[:, 1 + i])
            out[:, 3 * n : 3 * n + 3] += plant.tip_force
            if extended:
                interval = np.clip(np.searchsorted(t, times, side="left") - 1, 0, len(steps) - 1)
                out[:, 3 * n + 6 :] = np.where(
                    ((times > t[0]) & (times <= t[-1]))[:, None], slides[interval], 0.0
                )
            return out

        return rows

    def _observe(self, plant: Plant, trajectory: Trajectory) -> tuple[Floats, Floats]:
        """(position (s, 3), quaternion (s, 4)) that the tracker reports of a trajectory."""

        def tip_at(times: Floats) -> Floats:
            tip = at_times(trajectory.tip[:, :7], trajectory.t, times)
            tip[:, 3:] /= np.linalg.norm(tip[:, 3:], axis=1, keepdims=True)
            return tip

        return plant.tracker.forward(self.recording.stamps, tip_at)

    # -- predictions --

    def predict(self, point: Point) -> Prediction:
        """What the tracker measures at ``point``; NaN after the end of a simulation that fails."""
        plant = self.plant(point)
        trajectory = self._run(plant, plant.extended)
        position, quaternion = self._observe(plant, trajectory)
        if trajectory.failure:
            late = self.recording.stamps > trajectory.t[-1]
            position[late], quaternion[late] = np.nan, np.nan
        return Prediction(position, quaternion, trajectory, trajectory.failure)

    def _run(self, plant: Plant, extended: bool, **columns: Any) -> Trajectory:
        """The estimator's steps; where these cannot be taken to the end, as with friction of tens of times the usual, steps of one stage after the
        other, each with its own Jacobian."""
        rows, events = self.inputs(plant, extended), (self._load_events + plant.load_delay).tolist()
        model, duration = self.models[extended], self.recording.duration
        steps = duration if self.steps is None else self.steps.lengths(duration)
        found = run_collocation(model, self.scheme, plant.block, rows, steps, events=events, **columns)
        if found.failure:
            scheme = make_scheme(RESCUE, self.shortest_step)
            other = run(model, scheme, plant.block, rows, duration, events=events, **columns)
            if not other.failure:
                return other
        return found

    def residual(self, prediction: Prediction) -> Floats:
        """(s, 6) measurement minus prediction: position in m in the tracker's axes, rotation vector in rad in the sensor's axes, without the turn
        about the one axis that is not measured."""
        measured = self.recording
        return pose_differences(
            measured.position, measured.quaternion, prediction.position, prediction.quaternion, self._free
        )

    def residual_at(self, point: Point) -> Floats | None:
        """(s, 6) residual of the prediction at ``point``; None where it cannot be simulated to the end."""
        try:
            prediction = self.predict(point)
        except InputError:  # no equilibrium to start from
            return None
        return None if prediction.failure else self.residual(prediction)

    def jacobian(
        self, point: Point, wanted: Sequence[EffectQuantity], workers: int = 1
    ) -> tuple[Prediction, Floats]:
        """Prediction at ``point`` and its derivatives (s, 6, len(wanted)) by the coordinates of ``wanted``, each times its ``scale``.

        With several ``workers`` many columns are computed in two simulations at once, which changes them by no more than their accuracy.
        """
        plant = self.plant(point)
        changed = [self.plant(moved(point, q, self.options.difference)) for q in wanted]
        kinds: list[str] = []
        for other in changed:
            model = not np.array_equal(other.block, plant.block) or not other.has_inputs_of(plant)
            needs = model and (plant.extended or other.extended)
            kinds.append("tracker" if not model else "extended" if needs else "plain")
        numbers = {kind: [i for i, k in enumerate(kinds) if k == kind] for kind in ("plain", "extended")}
        if numbers["extended"] and len(numbers["plain"]) <= -len(numbers["extended"]) % SIMD_WIDTH:
            # the extended model has the same derivatives, and room left in its last batch of columns
            numbers["extended"] += numbers["plain"]
            numbers["plain"] = []
        columns = np.zeros((len(self.recording.stamps), 6, len(wanted)))
        prediction: Prediction | None = None
        several = count_workers(workers) > 1
        parts = [(kind, part) for kind, chosen in numbers.items() for part in _parts(chosen, several)]
        if not parts:
            parts = [("extended", [])]
        trajectories = run_jobs(
            (
                delayed(self._columns)(
                    plant,
                    [changed[i] for i in chosen],
                    kind == "extended" and (bool(chosen) or plant.extended),
                )
                for kind, chosen in parts
            ),
            workers,
        )
        for (_, chosen), trajectory in zip(parts, trajectories, strict=True):
            position, quaternion = self._observe(plant, trajectory)
            if trajectory.failure:
                position[self.recording.stamps > trajectory.t[-1]] = np.nan
            if prediction is None or trajectory.failure:
                prediction = Prediction(position, quaternion, trajectory, trajectory.failure)
            if chosen:
                columns[:, :, chosen] = self._through(plant, trajectory)
        assert prediction is not None
        for i, kind in enumerate(kinds):
            if kind == "tracker":
                position, quaternion = self._observe(changed[i], prediction.trajectory)
                columns[:, :3, i] = (position - prediction.position) / self.options.difference
                columns[:, 3:, i] = (
                    to_vector_rows(multiply_rows(conjugate_rows(prediction.quaternion), quaternion))
                    / self.options.difference
                )
        return prediction, np.nan_to_num(columns)

    def _columns(self, plant: Plant, changed: Sequence[Plant], extended: bool) -> Trajectory:
        if not changed:
            return self._run(plant, extended)
        effect = np.stack(
            [(other.block - plant.block) / self.options.difference for other in changed], axis=1
        )
        base = self.inputs(plant, extended)
        moving = [
            (i, self.inputs(other, extended))
            for i, other in enumerate(changed)
            if not other.has_inputs_of(plant)
        ]
        width = self.models[extended].input_count

        difference = self.options.difference

        def input_effect(times: Floats) -> Floats:
            out = np.zeros((len(times), width, len(changed)))
            here = base(times)
            for i, rows in moving:
                out[:, :, i] = (rows(times) - here) / difference
            return out

        return self._run(plant, extended, effect=effect, input_effect=input_effect)

    def _through(self, plant: Plant, trajectory: Trajectory) -> Floats:
        """Columns of the tip as columns of the measurements, (s, 6, r)."""
        assert trajectory.columns is not None
        tip, flat = trajectory.tip[:, :7], trajectory.columns[:, :7].reshape(len(trajectory.t), -1)
        return plant.tracker.derivative(
            self.recording.stamps,
            lambda times: at_times(tip, trajectory.t, times),
            lambda times: at_times(flat, trajectory.t, times),
        )


def _parts(numbers: list[int], several: bool) -> list[list[int]]:
    """``numbers`` of columns, in two halves of whole pairs where there are many and ``several`` workers; none where there are none."""
    if len(numbers) < MANY or not several:
        return [numbers] if numbers else []
    middle = (len(numbers) + 2) // 4 * 2
    return [numbers[:middle], numbers[middle:]]


def values_at(point: Point) -> dict[str, dict[str, float]]:
    """Values by effect and parameter of the coordinates of ``point``."""
    values: dict[str, dict[str, float]] = {}
    for (effect, name), coordinate in point.items():
        values.setdefault(effect, {})[name] = EFFECTS[effect].find(name).value(coordinate)
    return values


def moved(point: Point, quantity: EffectQuantity, fraction: float) -> dict[Key, float]:
    """``point`` with one coordinate changed by ``fraction`` of its scale."""
    other = dict(point)
    other[quantity.key] = other.get(quantity.key, quantity.off) + fraction * quantity.scale
    return other


def at_times(values: Floats, t: Floats, times: Floats) -> Floats:
    """Rows of ``values`` (K, c) at the rising ``t`` (K,) at ``times``, by cubics through four neighbours; held outside."""
    if len(t) < 4:  # a simulation that failed at once
        return np.repeat(values[-1:], len(times), axis=0)
    x = np.clip(times, t[0], t[-1])
    first = np.clip(np.searchsorted(t, x, side="right") - 2, 0, len(t) - 4)
    knots = [t[first + k] for k in range(4)]
    out = np.zeros((len(times), values.shape[1]))
    for k, knot in enumerate(knots):
        weight = np.ones(len(times))
        for other in (knots[j] for j in range(4) if j != k):
            weight *= (x - other) / (knot - other)
        out += weight[:, None] * values[first + k]
    return out


def smooth(t: Floats, values: Floats, gap_s: float) -> Callable[[Floats], tuple[Floats, Floats]]:
    """Values and rates at any times (k,) of samples (s, n) at ``t`` (s,).

    Cubic between samples with the slope of the two neighbours at each (Catmull and Rom), a straight line across gaps of more than ``gap_s``,
    held outside. Encoders are noisy. Straight lines have a slope discontinuity at each sample, which steps of about the same length meet or
    miss; the misfit would be a rough function of every delay.
    """
    h = np.diff(t)[:, None]
    secants = np.diff(values, axis=0) / h
    slopes = np.vstack(
        [secants[:1], (h[:-1] * secants[1:] + h[1:] * secants[:-1]) / (h[:-1] + h[1:]), secants[-1:]]
    )
    gap = h > gap_s
    first, last = (np.where(gap, secants, s) for s in (slopes[:-1], slopes[1:]))

    def at(times: Floats) -> tuple[Floats, Floats]:
        i = np.clip(np.searchsorted(t, times, side="left") - 1, 0, len(h) - 1)
        x = np.clip((times - t[i]) / h[i, 0], 0.0, 1.0)[:, None]
        a, b, d = first[i] - secants[i], last[i] - secants[i], secants[i]
        value = values[i] + h[i] * x * (d + (1.0 - x) * ((1.0 - x) * a - x * b))
        rate = d + (1.0 - x) * (1.0 - 3.0 * x) * a - x * (2.0 - 3.0 * x) * b
        inside = (times > t[0]) & (times <= t[-1])
        return value, np.where(inside[:, None], rate, 0.0)

    return at
