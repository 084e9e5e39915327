"""Contact plane: looked for in the data, from the time at which measurement and model diverge.

In: a problem. Out: a candidate with a plane and stiffnesses to begin with, or none. After an impact a model without the plane is out of phase
for good, and so is one with a plane in the wrong place: the misfit over a whole recording says little of where to go. The first moments do. Up
to the impact both agree, the first difference points along the normal, and the tip is at the plane. From there on plane and stiffness are
fitted to a span of time that grows.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from joblib import delayed
from numpy.typing import NDArray
from scipy.optimize import least_squares

from ctr_dynamics.diagnosis.diagnosis_options import ContactPlaneOptions
from ctr_dynamics.diagnosis.forward_model import ForwardModel, Key
from ctr_dynamics.diagnosis.inference.candidates import Candidate
from ctr_dynamics.diagnosis.inference.fit_problem import Problem
from ctr_dynamics.diagnosis.recording import Recording
from ctr_dynamics.diagnosis.run_context import RunContext
from ctr_dynamics.diagnosis.whitening import noise_floor
from ctr_dynamics.effects import EffectQuantity
from ctr_dynamics.kernels.rotations import matrix

Floats = NDArray[np.float64]
EFFECT = "contact"
FAILED = 1e3  # noise floors: residual where the model cannot be simulated


def find_contact_plane(
    problem: Problem, known: Sequence[EffectQuantity], context: RunContext
) -> Candidate | None:
    """A candidate whose plane explains the first moments after measurement and nominal model diverge; None where no plane does."""
    own = [q for q in known if q.effect == EFFECT]
    options = problem.options.contact_plane
    for forward_model in problem.forward_models:
        residual = forward_model.residual_at({})
        found = None
        if residual is not None:
            found = _Search(forward_model, residual[:, :3], options).run(context)
        if found is not None:
            start = {(EFFECT, name): value for name, value in _values(found).items()}
            shapes = tuple(replace(q, off=start[q.key]) for q in own if q.parameter.shape)
            amplitudes = tuple(q for q in own if not q.parameter.shape)
            stiffness = start[amplitudes[0].key]
            return Candidate(
                EFFECT,
                amplitudes,
                shapes,
                tuple((q.key, start[q.key]) for q in shapes),
                tuple(factor * stiffness for factor in options.factors),
            )
    return None


def time_of_divergence(forward_model: ForwardModel, options: ContactPlaneOptions) -> float | None:
    """s at which measurement and nominal model diverge; None where they do not, or the model cannot be simulated."""
    residual = forward_model.residual_at({})
    if residual is None:
        return None
    sizes = _sizes(forward_model.recording, residual[:, :3])
    diverged = _diverged(sizes, noise_floor(forward_model.robot), options)
    return None if diverged is None else float(forward_model.recording.stamps[diverged])


def _sizes(recording: Recording, residual: Floats) -> Floats:
    """(s,) m of the residual (s, 3), zero where there is no measurement."""
    good = np.isfinite(recording.position).all(axis=1)
    return np.where(good, np.linalg.norm(residual, axis=1), 0.0)


def _diverged(sizes: Floats, floor: float, options: ContactPlaneOptions) -> int | None:
    """First pose at which a residual is large; None where none is."""
    large = sizes > max(options.diverged * float(np.quantile(sizes, 0.95)), options.diverged_noise * floor)
    return int(np.argmax(large)) if large.any() else None


class _Search:
    """Search for a plane in one recording. A plane is (5,): logarithm of the stiffness (N/m), normal (3,), offset (cm).

    Args:
        residual: (s, 3) m of the nominal model.
    """

    def __init__(self, forward_model: ForwardModel, residual: Floats, options: ContactPlaneOptions) -> None:
        self.forward_model, self.residual, self.options = forward_model, residual, options
        self.floor = noise_floor(forward_model.robot)

    def run(self, context: RunContext) -> Floats | None:
        """The plane; None where there is none."""
        o, recording = self.options, self.forward_model.recording
        sizes = _sizes(recording, self.residual)
        diverged = _diverged(sizes, self.floor, o)
        if diverged is None:
            return None
        first = diverged
        while first > 0 and sizes[first - 1] > o.first * self.floor:
            first -= 1
        begin = recording.stamps[diverged]
        if begin - recording.stamps[first] > o.sudden_s:
            return None
        best: tuple[float, Floats] | None = None
        for k in dict.fromkeys((first, diverged)):
            if best is not None and best[0] < o.sure:
                break
            jobs = [
                delayed(self._from_start)(self._start(k, first, diverged, stiffness), begin)
                for stiffness in o.stiffnesses
            ]
            for left, x in context.run(jobs):
                if left < (best[0] if best else 1.0 - o.explained):
                    best = left, x
        if best is None:
            return None
        left, x = best
        for span in o.spans_s:
            longer, left = self._fitted(x, begin, span)
            if left > 1.0 - o.explained:
                break
            x = longer
        return x

    def _start(self, k: int, first: int, diverged: int, stiffness: float) -> Floats:
        """The plane that the residual of pose ``k`` points to, near the tip's places between ``first`` and ``diverged``."""
        recording, tracker = self.forward_model.recording, self.forward_model.nominal.tracker
        back = matrix(tracker.rotation).T  # tracker's axes to base axes
        calm = self.residual[max(first - 3, 0)] if first else np.zeros(3)
        normal = back @ (self.residual[k] - calm)
        normal = normal / max(float(np.linalg.norm(normal)), 1e-12)
        near = slice(max(first - 1, 0), diverged + 3)
        places = (recording.position[near] - tracker.translation) @ back.T @ normal
        return np.array([math.log(stiffness), *normal, 1e2 * (np.nanmin(places) + self.options.depth_m)])

    def _from_start(self, x: Floats, begin: float) -> tuple[float, Floats]:
        """Fraction of the squares that is left in the first spans after ``begin`` (s), and the plane that leaves it, from ``x`` on."""
        left = math.inf
        for span in self.options.first_spans_s:
            x, left = self._fitted(x, begin, span)
            if left > self.options.no_plane:
                break
        return left, x

    def _fitted(self, x: Floats, begin: float, span: float) -> tuple[Floats, float]:
        """The plane near ``x`` that leaves least from shortly before ``begin`` (s) to ``span`` behind it, and the fraction of the squares."""
        short = self.forward_model.until(begin + span)
        stamps = short.recording.stamps
        counted = (stamps > begin - self.options.lead_s) & np.isfinite(short.recording.position).all(axis=1)

        def residual(x: Floats | None) -> Floats:
            point: dict[Key, float] = (
                {} if x is None else {(EFFECT, name): value for name, value in _values(x).items()}
            )
            whole = short.residual_at(point)
            if whole is None:  # as where the robot rests behind the plane
                return np.full(3 * int(counted.sum()) + 1, FAILED)
            left = whole[counted, :3].ravel() / self.floor
            return np.append(left, 0.0 if x is None else np.linalg.norm(x[1:4]) - 1.0)

        found = least_squares(
            residual,
            x,
            diff_step=1e-3,
            max_nfev=self.options.evaluations,
            loss="soft_l1",
            f_scale=3.0,
            x_scale=(0.3, 0.1, 0.1, 0.1, 0.2),
        )
        free, left = residual(None), residual(found.x)
        return found.x, float(left @ left) / max(float(free @ free), 1e-12)


def _values(x: Floats) -> dict[str, float]:
    """Parameters of the effect for a plane (5,)."""
    normal = x[1:4] / max(float(np.linalg.norm(x[1:4])), 1e-12)
    return {
        "stiffness_N_per_m": math.exp(min(max(float(x[0]), 0.0), 12.0)),
        **{"n" + axis: float(part) for axis, part in zip("xyz", normal, strict=True)},
        "offset_m": 1e-2 * float(x[4]),
    }
