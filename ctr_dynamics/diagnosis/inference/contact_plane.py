"""Where a wall may be that the tip runs into: looked for in the data, from the moment at which measurement and model part.

After an impact a model without the wall is out of step for good, and so is one with a wall in the wrong place: the misfit over a whole recording
says little of where to go. The first moments do: up to the impact both agree, the first difference points along the normal, and the tip is at the
plane. From there on plane and stiffness are fitted to a span of time that grows.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from joblib import Parallel, delayed
from numpy.typing import NDArray
from scipy.optimize import least_squares

from ctr_dynamics.diagnosis.forward_model import ForwardModel
from ctr_dynamics.diagnosis.inference.candidates import Candidate
from ctr_dynamics.diagnosis.inference.map_fit import Key, Problem
from ctr_dynamics.diagnosis.recording import Recording
from ctr_dynamics.diagnosis.whitening import noise_floor
from ctr_dynamics.effects import Quantity
from ctr_dynamics.kernels.rotations import matrix

Floats = NDArray[np.float64]
EFFECT = "contact"
PARTED = 0.3  # of the large residuals: beyond, measurement and model have parted
FIRST = 2.0  # of the noise: from there on the residual shows the way
SUDDEN = 0.1  # s from there to the parting: what grows slower is no impact
LEAD = 0.06  # s before the parting from which on the span counts
FIRST_SPANS, SPANS = (0.05, 0.13), (0.25, 0.5, 1.0)  # s after it
STIFFNESSES = (120.0, 400.0)  # N/m to begin with
FACTORS = (1.0, 0.5, 2.0)  # on the stiffness that is found, for the fits with all nuisances
SURE = 2e-3  # of the squares there: a wall that leaves no more needs no other start
NO_WALL = 0.5  # of the squares in the first span: what leaves more there is none
EXPLAINED = 0.9  # of the squared misfit in a span that a wall must explain there
INSIDE_M = 2e-3  # m that the tip is behind the plane where it is noticed first
FAILED = 1e3  # noise floors: residual where the model cannot be simulated
EVALUATIONS = 12  # of the residual's derivatives, a span


def wall(problem: Problem, known: Sequence[Quantity], workers: int) -> Candidate | None:
    """A candidate whose plane explains the first moments after measurement and nominal model part; None where no wall does."""
    own = [q for q in known if q.effect == EFFECT]
    for forward_model in problem.forward_models:
        residual = forward_model.residual_at({})
        found = None
        if residual is not None:
            found = _search(forward_model, residual[:, :3], noise_floor(problem.robot), workers)
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
                tuple(factor * stiffness for factor in FACTORS),
            )
    return None


def parting(forward_model: ForwardModel) -> float | None:
    """s at which measurement and nominal model part; None where they do not, or the model cannot be simulated."""
    residual = forward_model.residual_at({})
    if residual is None:
        return None
    parted = _parted(_sizes(forward_model.recording, residual[:, :3]), noise_floor(forward_model.robot))
    return None if parted is None else float(forward_model.recording.stamps[parted])


def _sizes(recording: Recording, residual: Floats) -> Floats:
    """(s,) m of the residual (s, 3), zero where there is no measurement."""
    good = np.isfinite(recording.position).all(axis=1)
    return np.where(good, np.linalg.norm(residual, axis=1), 0.0)


def _parted(sizes: Floats, floor: float) -> int | None:
    """First sample at which a residual is large; None where none is."""
    large = sizes > max(PARTED * float(np.quantile(sizes, 0.95)), 5.0 * floor)
    return int(np.argmax(large)) if large.any() else None


def _search(forward_model: ForwardModel, residual: Floats, floor: float, workers: int) -> Floats | None:
    """Logarithm of the stiffness (N/m), normal (3,) and offset (cm) of a wall; None where there is none."""
    recording = forward_model.recording
    sizes = _sizes(recording, residual)
    parted = _parted(sizes, floor)
    if parted is None:
        return None
    first = parted
    while first > 0 and sizes[first - 1] > FIRST * floor:
        first -= 1
    if recording.stamps[parted] - recording.stamps[first] > SUDDEN:
        return None
    back = matrix(forward_model.nominal.tracker.rotation).T  # tracker's axes to base axes
    calm = residual[max(first - 3, 0)] if first else np.zeros(3)
    begin = recording.stamps[parted]

    def start(k: int, stiffness: float) -> tuple[float, Floats]:
        normal = back @ (residual[k] - calm)
        normal = normal / max(float(np.linalg.norm(normal)), 1e-12)
        near = slice(max(first - 1, 0), parted + 3)
        places = (recording.position[near] - forward_model.nominal.tracker.translation) @ back.T @ normal
        x = np.array([math.log(stiffness), *normal, 1e2 * (np.nanmin(places) + INSIDE_M)])
        left = math.inf
        for span in FIRST_SPANS:
            x, left = _fitted(forward_model, x, begin, span, floor)
            if left > NO_WALL:
                break
        return left, x

    best: tuple[float, Floats] | None = None
    for k in dict.fromkeys((first, parted)):
        if best is not None and best[0] < SURE:
            break
        for left, x in Parallel(workers, prefer="threads")(delayed(start)(k, s) for s in STIFFNESSES):
            if left < (best[0] if best else 1.0 - EXPLAINED):
                best = left, x
    if best is None:
        return None
    left, x = best
    for span in SPANS:
        longer, left = _fitted(forward_model, x, begin, span, floor)
        if left > 1.0 - EXPLAINED:
            break
        x = longer
    return x


def _fitted(
    forward_model: ForwardModel, x: Floats, begin: float, span: float, floor: float
) -> tuple[Floats, float]:
    """The wall near ``x`` that leaves least from ``LEAD`` before ``begin`` (s) to ``span`` behind it, and the share of the squares that it leaves."""
    short = ForwardModel(
        forward_model.recording.until(begin + span),
        forward_model.robot,
        forward_model.nodes,
        forward_model.scheme.dt,
    )
    stamps = short.recording.stamps
    counted = (stamps > begin - LEAD) & np.isfinite(short.recording.position).all(axis=1)

    def residual(x: Floats | None) -> Floats:
        point: dict[Key, float] = (
            {} if x is None else {(EFFECT, name): value for name, value in _values(x).items()}
        )
        whole = short.residual_at(point)
        if whole is None:  # as where the robot rests behind the wall
            return np.full(3 * int(counted.sum()) + 1, FAILED)
        left = whole[counted, :3].ravel() / floor
        return np.append(left, 0.0 if x is None else np.linalg.norm(x[1:4]) - 1.0)

    found = least_squares(
        residual, x, diff_step=1e-3, max_nfev=EVALUATIONS, loss="soft_l1", f_scale=3.0, x_scale=(0.3, 0.1, 0.1, 0.1, 0.2)
    )  # fmt: skip
    free, left = residual(None), residual(found.x)
    return found.x, float(left @ left) / max(float(free @ free), 1e-12)


def _values(x: Floats) -> dict[str, float]:
    normal = x[1:4] / max(float(np.linalg.norm(x[1:4])), 1e-12)
    return {
        "stiffness_N_per_m": math.exp(min(max(float(x[0]), 0.0), 12.0)),
        **{"n" + axis: float(part) for axis, part in zip("xyz", normal, strict=True)},
        "offset_m": 1e-2 * float(x[4]),
    }
