"""Recordings of one robot, prepared for fits: in, recordings and a robot; out, whitened residuals and their derivatives."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from joblib import delayed
from numpy.typing import NDArray

from ctr_dynamics.diagnosis.diagnosis_options import DiagnosisOptions
from ctr_dynamics.diagnosis.forward_model import ForwardModel, Key
from ctr_dynamics.diagnosis.recording import Recording
from ctr_dynamics.diagnosis.run_context import RunContext
from ctr_dynamics.diagnosis.step_choice import with_chosen_steps
from ctr_dynamics.diagnosis.whitening import Whitener
from ctr_dynamics.effects import EffectQuantity
from ctr_dynamics.errors import InputError
from ctr_dynamics.robot import Robot

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Local:
    """The model around one point: whitened residual (m,), and derivatives (m,) of the prediction by coordinates."""

    residual: Floats
    columns: Mapping[Key, Floats]


@dataclass
class Problem:
    """Recordings of one robot, prepared for fits; m is the number of whitened values.

    Attributes:
        forward_models, whiteners: one for each recording.
        nuisances: quantities with a tolerance.
        numerics: (m, d) whitened directions of the discretisation error.
        offset: (m,) whitened correction of the residual towards the finer solution.
        reach: tolerances by which fits move a nuisance at most.
        tolerance_factor: by which the fits take all tolerances to be larger than the robot file says.
        options: numbers of all stages. workers: simulations at once, where nothing else runs.
        explained: the first part of the recordings that nuisances alone explain, and where; None before growing parts have been fitted.
    """

    robot: Robot
    forward_models: list[ForwardModel]
    whiteners: list[Whitener]
    nuisances: tuple[EffectQuantity, ...]
    numerics: Floats
    offset: Floats
    reach: float
    options: DiagnosisOptions
    workers: int = 1
    tolerance_factor: float = 1.0
    explained: tuple[float, dict[Key, float]] | None = None

    @property
    def size(self) -> int:
        """Number of whitened values."""
        return sum(w.size for w in self.whiteners)

    @property
    def nominal(self) -> dict[Key, float]:
        """Coordinates of the nuisances as the robot file has them."""
        return {q.key: q.off for q in self.nuisances}

    def with_least_step(self, dt: float) -> Problem:
        """The same with time steps of ``dt`` (s) where they are shorter."""
        return replace(self, forward_models=[e.with_least_step(dt) for e in self.forward_models])

    @property
    def finer(self) -> Problem:
        """The same with half of every time step."""
        models = [e.resolved(e.nodes, 0.5 * e.scheme.dt) for e in self.forward_models]
        return replace(self, forward_models=models)

    @property
    def even(self) -> Problem:
        """The same with the shortest time step all the time."""
        return replace(self, forward_models=[e.with_steps(None) for e in self.forward_models])

    def until(self, ends: Sequence[float]) -> Problem:
        """The same up to the time (s) in ``ends`` of each recording, with its time steps and before any correction."""
        shorter = self.on([e.recording.until(end) for e, end in zip(self.forward_models, ends, strict=True)])
        pairs = zip(shorter.forward_models, self.forward_models, strict=True)
        return replace(shorter, forward_models=[e.with_steps(whole.steps) for e, whole in pairs])

    def on(self, recordings: Sequence[Recording], robot: Robot | None = None) -> Problem:
        """The same nuisances with their limits, axes and resolution on other recordings, of another ``robot`` where one is given, before any
        correction."""
        options = replace(self.options, forward_model=self.forward_models[0].options)
        mask = self.whiteners[0].mask
        other = make_problem(robot or self.robot, recordings, self.nuisances, mask, options)
        return replace(other, workers=self.workers, reach=self.reach, tolerance_factor=self.tolerance_factor)

    def residual(self, point: Mapping[Key, float]) -> Floats | None:
        """(m,) whitened residual at ``point``; None where a simulation fails."""
        parts = []
        for forward_model, whiten in zip(self.forward_models, self.whiteners, strict=True):
            left = forward_model.residual_at(point)
            if left is None:
                return None
            parts.append(whiten(left))
        return np.concatenate(parts) - self.offset

    def linearise(
        self, point: Mapping[Key, float], wanted: Sequence[EffectQuantity]
    ) -> tuple[Floats, Floats] | None:
        """Whitened residual (m,) at ``point`` and derivatives (m, len(wanted)) of the prediction, each by its coordinate."""
        residuals, columns = [], []
        for forward_model, whiten in zip(self.forward_models, self.whiteners, strict=True):
            try:
                prediction, jacobian = forward_model.jacobian(point, wanted, self.workers)
            except InputError:
                return None
            if prediction.failure:
                return None
            residuals.append(whiten(forward_model.residual(prediction)))
            columns.append(whiten(jacobian))
        scale = np.array([q.scale for q in wanted])
        return np.concatenate(residuals) - self.offset, np.concatenate(columns) / scale

    def residuals(self, point: Mapping[Key, float]) -> list[Floats]:
        """Residuals (s, 6) in m and rad of every recording at ``point``, NaN after the end of a simulation that fails."""
        return [e.residual(e.predict(point)) for e in self.forward_models]


def make_problem(
    robot: Robot,
    recordings: Sequence[Recording],
    nuisances: Sequence[EffectQuantity],
    mask: NDArray[np.bool_],
    options: DiagnosisOptions | None = None,
) -> Problem:
    """Problem of ``recordings``.

    Args:
        nuisances: quantities that may move inside their tolerances.
        mask: (6,) axes that count: position, then rotation. Poses that are not finite are left out.
    """
    options = options or DiagnosisOptions()
    forward_models = [ForwardModel(r, robot, options.forward_model) for r in recordings]
    whiteners = []
    for r in recordings:
        used = np.isfinite(r.position).all(axis=1) & (r.stamps >= 0.0)
        if mask[3:].any():
            used &= np.isfinite(r.quaternion).all(axis=1)
        whiteners.append(Whitener(robot, r.stamps, mask, used))
    size = sum(w.size for w in whiteners)
    return Problem(
        robot,
        forward_models,
        whiteners,
        tuple(nuisances),
        np.zeros((size, 0)),
        np.zeros(size),
        options.calibration.reach,
        options,
    )


def choose_steps(problem: Problem, point: Mapping[Key, float], context: RunContext) -> None:
    """Give every recording of ``problem`` the steps in time that it needs at ``point``."""
    pairs = zip(problem.forward_models, problem.whiteners, strict=True)
    o = problem.options.steps
    problem.forward_models = context.run(delayed(with_chosen_steps)(e, w, point, o) for e, w in pairs)
