"""Arrays that travel together through the kernels, by name."""

from __future__ import annotations

from typing import Any, NamedTuple, TypeVar

import numpy as np
from numba import types
from numba.extending import typeof_impl

T = TypeVar("T")


def structure(cls: type[T]) -> type[T]:
    """A named tuple whose type for the compiler is found once for each object.

    Numba takes the type of every element at each call otherwise, which for a score of arrays costs as much as part of a step.
    """
    names: dict[str, Any] = {
        "__module__": cls.__module__,
        "__qualname__": cls.__qualname__,
        "__doc__": cls.__doc__,
    }
    names["__getstate__"] = lambda self: None  # the type is found again where it is loaded
    made: Any = type(cls.__name__, (cls,), names)

    @typeof_impl.register(made)
    def type_of(value: Any, context: Any) -> types.Type:
        if "numba_type" not in value.__dict__:
            elements = [typeof_impl(v, context) for v in value]
            value.__dict__["numba_type"] = types.BaseTuple.from_types(elements, made)
        return value.__dict__["numba_type"]

    return made


@structure
class Mesh(NamedTuple):
    """Arrays that describe one set of sections; the kernels read them, nothing writes them.

    ``sec_cells``, ``sec_tubes`` (sections,): cells of a section and tubes present in it. ``bp_tube``, ``bp_offset`` (sections,): the
    section ends at s = beta[bp_tube] + bp_offset. ``ust`` (points * 3N,), ``ust0`` (3N,), ``ust_base`` (N * base points,):
    precurvature in each tube's own frame, 1/m, at the points of the main part, just behind the plate, and (z only) behind the base.
    ``cut`` (cells,): number of the cut before each cell, or -1; ``owner`` (5 + N,): number of cuts before the place of each residual at the tubes'
    ends.
    """

    sec_cells: np.ndarray
    sec_tubes: np.ndarray
    bp_tube: np.ndarray
    bp_offset: np.ndarray
    ust: np.ndarray
    ust0: np.ndarray
    ust_base: np.ndarray
    base_cells: int
    cut: np.ndarray
    owner: np.ndarray


@structure
class SweepBuffers(NamedTuple):
    """What a sweep reads and writes, flat, with the lane as the last index of each.

    ``workspace``: scratch. Read: ``parameters`` (NP, L); ``section_lengths`` (sections, L) m; ``unknowns`` (5 + N, L); ``history``
    (points, F, L) and ``base_history`` (base fields, L), history parts at every Runge-Kutta stage of every cell and at section ends. Written:
    ``fields`` and ``base_fields``, as the histories; ``nodes`` (cells + sections, S, L), the state at the nodes; ``residual`` (5 + N, L).
    """

    workspace: np.ndarray
    parameters: np.ndarray
    section_lengths: np.ndarray
    unknowns: np.ndarray
    history: np.ndarray
    base_history: np.ndarray
    fields: np.ndarray
    base_fields: np.ndarray
    nodes: np.ndarray
    residual: np.ndarray


class ShootingOptions(NamedTuple):
    """How the shooting problem is solved: unit of each residual and finite-difference perturbation of each unknown, (5 + N,); largest scaled
    residual; most iterations."""

    scale: np.ndarray
    perturbation: np.ndarray
    tolerance: float
    limit: int


@structure
class ShootingSolver(NamedTuple):
    """Buffers of one lane, those of the Jacobian's lanes (:func:`~ctr_dynamics.kernels.kinds.unknown_lanes`), and options."""

    single: SweepBuffers
    jacobian: SweepBuffers
    options: ShootingOptions


@structure
class SegmentedSolver(NamedTuple):
    """Multiple shooting of single stages: buffers of one lane and of those of the Jacobian (:func:`~ctr_dynamics.kernels.kinds.segment_lanes`);
    ``units`` of the unknowns and ``scale`` of the residuals (mt,); ``step`` of the Jacobian's perturbations in those; largest scaled residual; most
    iterations."""

    single: SweepBuffers
    wide: SweepBuffers
    units: np.ndarray
    scale: np.ndarray
    step: float
    tolerance: float
    limit: int


@structure
class StageCoefficients(NamedTuple):
    """Stages of a time scheme: y_t = c0 y + h, h the sum of ``weights`` times stored fields; (stages,) 1/s and (stages, 3 + stages)."""

    c0: np.ndarray
    weights: np.ndarray


@structure
class RunArrays(NamedTuple):
    """What one run carries from step to step: parameters (NP,), stored fields ``bank`` (3 + stages, fields), ``unknowns`` (stages, 5 + N) of the
    last step and of the ``earlier`` ones (EARLIER, stages, 5 + N), the ``inverse`` (5 + N, 5 + N) Jacobian, and states at the ``nodes``."""

    parameters: np.ndarray
    bank: np.ndarray
    unknowns: np.ndarray
    earlier: np.ndarray
    inverse: np.ndarray
    nodes: np.ndarray


class Solution(NamedTuple):
    """Where a two-point problem has been solved: ``parameters`` (NP,), ``unknowns`` (m,), ``history`` and ``base_history``."""

    parameters: np.ndarray
    unknowns: np.ndarray
    history: np.ndarray
    base_history: np.ndarray


class StagePoint(NamedTuple):
    """Where a stage's Jacobian is taken: ``parameters`` (NP,), ``section_lengths`` (sections,), ``unknowns`` (mt,), ``fields`` and ``rates``
    (fields,); ``units`` of the unknowns and ``residual_units`` (mt,), and the ``step`` of the perturbations in those."""

    parameters: np.ndarray
    section_lengths: np.ndarray
    unknowns: np.ndarray
    fields: np.ndarray
    rates: np.ndarray
    units: np.ndarray
    residual_units: np.ndarray
    step: float


@structure
class CollocationCoefficients(NamedTuple):
    """Stages of a collocation step: y_t,i = sum over j of C_ij (y_j - y_n), ``C`` (stages, stages) 1/s; its eigenvalues ``rates`` (pairs,) of a
    positive imaginary part; rows ``to_modes`` (pairs, stages) and columns ``from_modes`` (stages, pairs), doubled, of its eigenvectors."""

    C: np.ndarray
    rates: np.ndarray
    to_modes: np.ndarray
    from_modes: np.ndarray


@structure
class CollocationSolver(NamedTuple):
    """For the stages of one or two runs: buffers of their lanes with the table of their ``coupling``; those of the complex Jacobian, ``wide``, with
    its ``matrix`` (2, mt, mt) and the ``point`` where it is taken; largest scaled residual; most sweeps."""

    stages: SweepBuffers
    coupling: np.ndarray
    wide: SweepBuffers
    matrix: np.ndarray
    point: StagePoint
    tolerance: float
    limit: int


@structure
class CollocationRun(NamedTuple):
    """What a run carries from step to step: parameters (NP,), fields and rates ``bank`` (3, fields), ``factors`` of its Jacobians, states at the
    ``nodes`` (rows,), and ``unknowns`` (K, mt) of the last stages at their ``times`` (K,), the newest last."""

    parameters: np.ndarray
    bank: np.ndarray
    factors: SystemFactors
    nodes: np.ndarray
    unknowns: np.ndarray
    times: np.ndarray


@structure
class CollocationTangent(NamedTuple):
    """Columns of a run: ``fields`` (r / 2, fields, 2), ``unknowns`` (r, stages, mt) of the last step in units, a ``guess`` of the next one's, which
    ``weights`` (degrees, stages, stages) extrapolate, and ``tip`` (rows, r), the first rows of the state there; with buffers of the ``lanes`` of two
    of them, ``tables`` (r / 2, size) of their couplings, and the change ``epsilon`` by which they are found. ``factors`` of a Jacobian of their own,
    which ``ready`` (1,) says to be there: the run must not depend on whether it has columns."""

    fields: np.ndarray
    unknowns: np.ndarray
    guess: np.ndarray
    weights: np.ndarray
    tip: np.ndarray
    lanes: SweepBuffers
    tables: np.ndarray
    epsilon: float
    factors: SystemFactors
    ready: np.ndarray


@structure
class RunPair(NamedTuple):
    """Two runs that take their steps together."""

    first: CollocationRun
    second: CollocationRun


class SystemFactors(NamedTuple):
    """Inverses of multiple-shooting systems, one for each of E complex rates; axes of 2 are real and imaginary part, columns come before rows.

    Condensed: ``along`` (E, cuts, 2, S, S), how the state at a cut follows from the start of its segment; ``from_base`` (E, cuts, 2, 5 + N, S), from
    the unknowns at the base; ``ends`` (E, 2, 5 + N, S), the tubes' ends by the start of their segment, by rows; ``inverse`` (E, 2, 5 + N, 5 + N).
    Or the ``whole`` inverse (E, 2, mt, mt), else of size 0.
    """

    along: np.ndarray
    from_base: np.ndarray
    ends: np.ndarray
    inverse: np.ndarray
    whole: np.ndarray


class SolvedStep(NamedTuple):
    """A step that has been solved.

    ``parameters`` (NP,), in which the inputs are written; ``inputs`` (stages, inputs), ``unknowns`` (stages, 5 + N) and ``rates`` (stages, fields) of
    its stages; stored fields ``before`` (3, fields) the step and fields ``after`` (fields,) it.
    """

    parameters: np.ndarray
    inputs: np.ndarray
    unknowns: np.ndarray
    before: np.ndarray
    rates: np.ndarray
    after: np.ndarray


class FiniteDifferences(NamedTuple):
    """Perturbations: ``column``, of a column's unit, and of each of the ``unknowns`` (5 + N,)."""

    column: float
    unknowns: np.ndarray


class Derivatives(NamedTuple):
    """Derivatives by r quantities: ``inverse`` (m, m) of the shooting Jacobian; columns of the ``unknowns`` (m, r), of the ``fields`` (fields, r),
    and of the states at the ``nodes`` (rows, r), of their last rows where these are fewer."""

    inverse: np.ndarray
    unknowns: np.ndarray
    fields: np.ndarray
    nodes: np.ndarray


@structure
class TangentBuffers(NamedTuple):
    """For the tangent of a step: buffers of the sweep; ``history``, ``base_history`` and fields ``bank`` (3 + stages, fields) of the base case;
    columns of the parameters ``dparameters`` (NP, r) and of the histories ``dhistory`` (fields, r)."""

    sweep: SweepBuffers
    history: np.ndarray
    base_history: np.ndarray
    bank: np.ndarray
    dparameters: np.ndarray
    dhistory: np.ndarray


class RunTangent(NamedTuple):
    """Columns of a run's stored fields ``bank`` (r / 8, 3 + stages, fields, 8), what they are moved with, and their ``tips`` (K, rows, r).

    ``before`` (3, fields) is scratch; columns of the parameters ``dparameters`` (NP, r) and of the inputs ``dinputs`` (K, stages, inputs, r).
    """

    before: np.ndarray
    dparameters: np.ndarray
    dinputs: np.ndarray
    differences: FiniteDifferences
    buffers: TangentBuffers
    bank: np.ndarray
    result: Derivatives
    tips: np.ndarray


class PartialFractions(NamedTuple):
    """A rational function R(z) = sum over poles of weight pole / (pole - z), with R(0) = 1.

    One real pole (0 if there is none) and one pair of complex ones. Of these the one above the real axis is named, with the weight of both.
    """

    real_pole: float
    real_weight: float
    complex_pole: complex
    complex_weight: complex


@structure
class RationalBuffers(NamedTuple):
    """For columns by partial fractions: buffers of a ``single`` lane, of the ``real`` pole's lanes, of ``near`` and ``far`` lanes of the complex
    pole; columns of the histories ``dhistory`` (fields, r)."""

    single: SweepBuffers
    real: SweepBuffers
    near: SweepBuffers
    far: SweepBuffers
    dhistory: np.ndarray
