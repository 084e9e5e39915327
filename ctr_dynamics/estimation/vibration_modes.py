"""Slowest vibration modes about an equilibrium, and how much of each is in given fields.

One backward Euler step of size h maps a perturbation of the fields by (1 - h A)^-1, with A the linearised dynamics. So block Arnoldi on the tangent
of that step is shift-invert Arnoldi with the shift 1/h: the slowest modes come out first. An eigenvalue lambda of the step belongs to
mu = (1 - 1/lambda) / h.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dgeev
from scipy.optimize import linear_sum_assignment

from ctr_dynamics.estimation.energy_norm import field_weights
from ctr_dynamics.estimation.step_output import Modes
from ctr_dynamics.kernels.kinds import Lanes, lanes_for
from ctr_dynamics.kernels.linearise import linearise
from ctr_dynamics.kernels.output_rows import modal_coordinates
from ctr_dynamics.kernels.rotations import matrix
from ctr_dynamics.kernels.structures import Derivatives, FiniteDifferences, Solution, SweepBuffers
from ctr_dynamics.kernels.tip_kinematics import tip_from_node
from ctr_dynamics.model.model import Model
from ctr_dynamics.model.simulator import Inputs
from ctr_dynamics.model.statics import Equilibrium

Floats = NDArray[np.float64]
SHIFT_STEP = 0.02  # s: the shift 50 / s lies among the slow bending modes
BLOCK = 8  # columns that are swept together: as many lanes as one vector has
ROUNDS = 4  # blocks of the Krylov space: the four slowest modes then hold to a percent
MAX_DAMPING = 0.7  # damping ratio; more is no vibration
STILL = np.zeros(6)  # rates of a load that does not change
SMALLEST = 1e-9  # of a block's largest direction; smaller ones are rounding


@dataclass(frozen=True)
class ModalBasis:
    """Modes about one equilibrium.

    Attributes:
        frequency_hz, damping: (m,). exponent: (m,) complex mu in 1/s.
        readout: (2m, fields) real, then imaginary parts of the modal coordinate z = readout (y - rest). The tip's displacement along the mode's
            main direction is 2 Re z.
        rest: (fields,) fields of the equilibrium; inputs (2N + 6,): alpha, beta, force and torque there.
        by_inputs: (2m, 2N + 6) modal coordinates of the equilibrium that moves with alpha, beta, force and torque.
        direction: (m, 3) unit, main direction of the tip's motion in ``ctr_base``; zero where a mode does not move it.
        by_input_rates: (m, 2N + 6) speed of the equilibrium along the direction, by the rates of alpha, beta, force and torque.
        twist: (m, 6) complex twist of the tip about the base axes, per unit of the modal coordinate: the tip's is 2 Re (twist z).
        shapes: (fields, m) complex, the fields in each mode where its own coordinate is 1 and all others are 0, but for a factor.
        reach: (m,) m, of the tip's displacement in each of the shapes. Of these, all have the same energy.
    """

    frequency_hz: Floats
    damping: Floats
    exponent: NDArray[np.complex128]
    readout: Floats
    rest: Floats
    direction: Floats
    inputs: Floats
    by_inputs: Floats
    by_input_rates: Floats
    twist: NDArray[np.complex128]
    shapes: NDArray[np.complex128]
    reach: Floats

    def measure(self, fields: Floats, now: Inputs, load_rate: Floats | None = None) -> Modes:
        """Amplitude and rate of each mode in ``fields`` (fields,) at the actuators and load ``now``.

        Fields hold velocities. So 2 Re(mu z) is the speed along the direction with that of the equilibrium, which follows actuators and load.
        The rate is without it.

        Args:
            load_rate: (6,) rates of force (N/s) and torque (N m/s); None where they stand still.
        """
        by_fields, by_inputs, at_rest, by_rates = self._rows
        m, still = len(self.damping), STILL if load_rate is None else load_rate
        values = np.empty(2 * m)
        modal_coordinates(
            by_fields, fields, at_rest, by_inputs, (now.alpha, now.beta, now.force, now.torque),
            by_rates, (now.alpha_rate, now.beta_rate, still[:3], still[3:]), values,
        )  # fmt: skip
        return Modes(self.frequency_hz, self.damping, values[:m], values[m:], self.direction)

    @property
    def _coordinates(self) -> NDArray[np.complex128]:
        """(m, fields) complex rows of ``readout``."""
        m = len(self.damping)
        return self.readout[:m] + 1j * self.readout[m:]

    def aligned_with(self, before: ModalBasis) -> ModalBasis:
        """The same modes in the order and with the signs of those of ``before`` that they continue; new ones follow, slowest first.

        Two modes are the same where each one's coordinate responds to the other's shape as to its own (modal assurance criterion with left and right
        eigenvectors). Fields are in the tubes' frames, so that a turning robot's shapes hardly change.
        """
        if before.readout.shape[1] != self.readout.shape[1]:
            return self  # another mesh
        here, there = self._coordinates, before._coordinates
        own, former = np.sum(here * self.shapes.T, axis=1), np.sum(there * before.shapes.T, axis=1)
        response = here @ before.shapes
        likeness = np.abs(response * (there @ self.shapes).T) / np.abs(np.outer(own, former))
        pairs = [
            (j, i) for i, j in zip(*linear_sum_assignment(-likeness), strict=True) if likeness[i, j] > 0.5
        ]
        order = [i for _, i in sorted(pairs)]
        order += [i for i in range(len(own)) if i not in order]
        sign = np.ones(len(own))
        for j, i in pairs:
            sign[i] = 1.0 if (response[i, j] / former[j]).real >= 0.0 else -1.0
        rows, signs = np.concatenate([order, np.add(order, len(own))]), np.tile(sign, 2)[:, None]
        return ModalBasis(
            self.frequency_hz[order],
            self.damping[order],
            self.exponent[order],
            (signs * self.readout)[rows],
            self.rest,
            (sign[:, None] * self.direction)[order],
            self.inputs,
            (signs * self.by_inputs)[rows],
            (sign[:, None] * self.by_input_rates)[order],
            (sign[:, None] * self.twist)[order],
            self.shapes[:, order],
            self.reach[order],
        )

    def vibrating(self, deviation: float) -> Floats:
        """(fields, 2m) fields of vibrations of any phase, in columns of one deviation: the tip's displacement has the ``deviation`` (m) in all.

        All modes have the same energy.
        """
        columns = self.shapes * (deviation / np.linalg.norm(self.reach))
        return np.concatenate([columns.real, columns.imag], axis=1)

    @cached_property
    def _rows(self) -> tuple[Floats, Floats, Floats, Floats]:
        """Amplitudes and rates (2m,) by fields (2m, fields), by inputs (2m, 2N + 6), in the fields and inputs of the equilibrium (2m,), and by the
        inputs' rates (2m, 2N + 6)."""
        m = len(self.damping)
        turn = 2.0 * np.block(
            [[np.eye(m), np.zeros((m, m))], [np.diag(self.exponent.real), np.diag(-self.exponent.imag)]]
        )
        by_fields, by_inputs = turn @ self.readout, turn @ self.by_inputs
        by_rates = np.vstack([np.zeros_like(self.by_input_rates), self.by_input_rates])
        return by_fields, by_inputs, by_fields @ self.rest - by_inputs @ self.inputs, by_rates


def lanes_of(model: Model) -> Lanes:
    """Lanes of the tangents: the base case and the unknowns, and as many columns as a block has."""
    return lanes_for(1 + model.unknown_count + BLOCK)


def equilibrium_slope(
    model: Model, equilibrium: Equilibrium, par: Floats, buffers: SweepBuffers
) -> Floats | None:
    """d(equilibrium's fields)/d(alpha, beta, force, torque), (fields, 2N + 6); ``buffers``: of :func:`lanes_of` lanes."""
    found = _static_response(model, equilibrium, par, buffers, _input_changes(model), np.zeros((0, 0)))
    return None if found is None else found[0] / _input_scale(model.n)


def tip_response(model: Model, equilibrium: Equilibrium, par: Floats, buffers: SweepBuffers) -> Floats | None:
    """d(tip of the equilibrium)/d(alpha, beta, force, torque), (6, 2N + 6): position, then rotation about the base axes."""
    found = _static_response(model, equilibrium, par, buffers, _input_changes(model), np.zeros((0, 0)))
    if found is None:
        return None
    scale, size = _input_scale(model.n), equilibrium.nodes.shape[1]
    columns = np.empty((12, len(scale)))
    tip_from_node(equilibrium.nodes[-1], found[1][-size:], 0.0, np.empty(13), columns)
    return np.asarray(columns[:6] / scale)


def _input_changes(model: Model) -> Floats:
    """(NP, 2N + 6) changes of the parameter block by those of :func:`_input_scale`."""
    layout, scale = model.layout, _input_scale(model.n)
    rows = np.concatenate([layout.rows(name) for name in ("alpha", "beta", "force", "torque")])
    dpar = np.zeros((layout.size, len(rows)))
    dpar[rows, range(len(rows))] = scale
    return dpar


def equilibrium_motion(
    model: Model, equilibrium: Equilibrium, par: Floats, buffers: SweepBuffers, slope: Floats
) -> Floats | None:
    """d(fields)/d(rates of alpha, beta, force, torque), (fields, 2N + 6), while the robot follows its equilibrium slowly.

    The strains change as ``slope`` says (:func:`equilibrium_slope`), and velocities are what that and turning bases give. Insertion is not in
    the fields.
    """
    n, layout, scale = model.n, model.layout, _input_scale(model.n)
    dpar = np.zeros((layout.size, len(scale)))
    dpar[layout.rows("alpha_rate"), range(n)] = scale[:n]
    found = _static_response(model, equilibrium, par, buffers, dpar, slope * scale)
    return None if found is None else found[0] / scale


def _input_scale(n: int) -> Floats:
    """(2N + 6,) small changes of alpha (rad), beta (m), force (N) and torque (N m)."""
    return np.array([1e-2] * n + [1e-4] * n + [1e-4] * 3 + [1e-6] * 3)


def _static_response(
    model: Model, equilibrium: Equilibrium, par: Floats, buffers: SweepBuffers, dpar: Floats, rates: Floats
) -> tuple[Floats, Floats] | None:
    """Fields (fields, k) and node states (nodes * S, k) by changes ``dpar`` (NP, k) of the parameters, where the fields' rates are ``rates``
    (fields, k); empty for none."""
    m, count = model.unknown_count, dpar.shape[1]
    lanes = lanes_of(model)
    main, base = len(buffers.history) // lanes.count, len(buffers.base_history) // lanes.count
    fields, nodes = np.zeros((main + base, count)), np.zeros((equilibrium.nodes.size, count))
    ok = linearise(
        model.kind, lanes, 0.0, equilibrium.mesh, Solution(par, equilibrium.x, np.zeros(main), np.zeros(base)), dpar,
        rates if rates.size else np.zeros((main + base, count)), FiniteDifferences(1e-3, model.tangent_perturbation), buffers,
        Derivatives(np.zeros((m, m)), np.zeros((m, count)), fields, nodes),
    )  # fmt: skip
    return (fields, nodes) if ok else None


class _InverseStep:
    """(1 - h A)^-1 about an equilibrium: the tangent of one backward Euler step.

    ``buffers``: of :func:`lanes_of` lanes, in use while this is.
    """

    def __init__(self, model: Model, equilibrium: Equilibrium, par: Floats, buffers: SweepBuffers) -> None:
        self.model, self.equilibrium, self.par, self.buffers = model, equilibrium, par, buffers
        self.lanes = lanes_of(model)
        self.main, base = (
            len(buffers.history) // self.lanes.count,
            len(buffers.base_history) // self.lanes.count,
        )
        self.size, m = self.main + base, model.unknown_count
        self.c0 = 1.0 / SHIFT_STEP
        self.history = -self.c0 * equilibrium.fields
        self._differences = FiniteDifferences(1e-3, model.tangent_perturbation)
        self._found = Derivatives(
            np.zeros((m, m)),
            np.zeros((m, BLOCK)),
            np.zeros((self.size, BLOCK)),
            np.zeros((equilibrium.nodes.size, BLOCK)),
        )

    def apply(self, columns: Floats, dpar: Floats) -> Floats | None:
        """Fields (fields, 8) after the step from perturbations ``columns`` (fields, 8) with changes ``dpar`` (NP, 8) of the parameters.

        None where the equilibrium cannot be linearised.
        """
        scale, main, equilibrium = 1e-4, self.main, self.equilibrium
        solution = Solution(self.par, equilibrium.x, self.history[:main], self.history[main:])
        ok = linearise(
            self.model.kind, self.lanes, self.c0, equilibrium.mesh, solution, dpar, -self.c0 * scale * columns, self._differences,
            self.buffers, self._found,
        )  # fmt: skip
        return self._found.fields / scale if ok else None

    def first_loads(self) -> Floats:
        """(NP, 8) parameter changes whose responses begin the Krylov space: a force and a moment on the tip, softer tubes in torsion."""
        layout, n = self.model.layout, self.model.n
        dpar = np.zeros((layout.size, BLOCK))
        for i in range(3):
            dpar[layout["force"].start + i, i] = 1e-6
            dpar[layout["torque"].start + i, 3 + i] = 1e-8
        for i in range(min(n, BLOCK - 6)):
            row = layout["torsional_stiffness"].start + i
            dpar[row, 6 + i] = 1e-4 * self.par[row]
        return dpar


def modal_basis(
    model: Model,
    equilibrium: Equilibrium,
    par: Floats,
    beta: Floats,
    count: int = 4,
) -> ModalBasis | None:
    """The ``count`` slowest modes about ``equilibrium``; None if there are none. Friction enters as its slope at rest.

    Args:
        model: the robot.
        equilibrium: of the actuators and load in ``par``.
        par: (NP,) parameter block.
        beta: (N,) m, translations.
        count: modes at most.
    """
    found = None
    buffers = model.sweep_buffers(equilibrium.mesh, lanes_of(model).count)
    for part in modal_parts(model, equilibrium, par, beta, buffers, count):
        found = part
    return found


def modal_parts(
    model: Model, equilibrium: Equilibrium, par: Floats, beta: Floats, buffers: SweepBuffers, count: int = 4
) -> Iterator[ModalBasis | None]:
    """The work of :func:`modal_basis` in parts of about equal cost, each ended by a None; the last item is the result.

    ``buffers``: of :func:`lanes_of` lanes, in use until then.
    """
    # 1. How the equilibrium moves with actuators and load.
    slope = equilibrium_slope(model, equilibrium, par, buffers)
    if slope is None:
        return
    yield None
    moving = equilibrium_motion(model, equilibrium, par, buffers, slope)
    if moving is None:
        return
    yield None
    # 2. Block Arnoldi.
    step = _InverseStep(model, equilibrium, par, buffers)
    dpar = step.first_loads()
    block = step.apply(np.zeros((step.size, BLOCK)), dpar)
    if block is None:
        return
    yield None
    dpar[:] = 0.0
    weights = np.sqrt(field_weights(model, equilibrium.mesh, beta))
    basis: list[Floats] = []
    whole: list[Floats] = []
    images: list[Floats] = []
    for _ in range(ROUNDS):
        q, v = _orthonormal(block, weights, basis, whole)
        image = step.apply(v, dpar)
        if image is None:
            return
        basis.append(q)
        whole.append(v)
        images.append(image)
        block = image
        yield None
    Q, image = np.concatenate(basis, axis=1), np.concatenate(images, axis=1)
    # 3. Eigenvalues and eigenvectors of the reduced step.
    pairs = _slow_pairs(Q.T @ (weights[:, None] * image), count)
    if pairs is None:
        return
    # 4. Readout by the left eigenvectors, along the main direction of the tip's motion.
    coordinates = (
        (pairs.left.real @ Q.T) + 1j * (pairs.left.imag @ Q.T)
    ) * weights  # of the modes, in any fields
    main = step.main - (7 + 2 * model.n)
    turn = matrix(equilibrium.tip_quaternion)
    tip = turn @ image[main:][:3]  # velocity of the images
    moved = (tip @ (pairs.right / (pairs.factor * pairs.exponent))).T  # displacement: an ellipse
    axis = _main_axes(moved)
    scale = (axis * moved).sum(1)[:, None]
    readout = coordinates * scale
    rows = np.concatenate([readout.real, readout.imag])
    layout = model.layout
    shapes = np.concatenate(whole, axis=1) @ pairs.right
    twist = np.concatenate([turn @ shapes[main:][:3], turn @ shapes[main:][3:6]]).T
    yield ModalBasis(
        np.abs(pairs.exponent.imag) / (2 * np.pi),
        -pairs.exponent.real / np.abs(pairs.exponent),
        pairs.exponent,
        rows,
        equilibrium.fields,
        axis,
        np.concatenate([par[layout["alpha"]], beta, par[layout["force"]], par[layout["torque"]]]),
        rows @ slope,
        2.0 * (pairs.exponent[:, None] * (readout @ moving)).real,
        twist / np.where(scale == 0.0, 1.0, scale) / np.sum(coordinates * shapes.T, axis=1)[:, None],
        shapes,
        np.linalg.norm(shapes[main:][:3], axis=0) / np.abs(pairs.exponent),
    )


def _orthonormal(
    block: Floats, weights: Floats, basis: list[Floats], whole: list[Floats]
) -> tuple[Floats, Floats]:
    """The columns of ``block`` (fields, 8), orthonormal in the energy norm among themselves and to all before: weighted, and whole.

    Gram-Schmidt works on whole vectors: the points at section ends have no energy of their own, but their history carries the bodies' inertia.
    """
    block = block / np.maximum(np.linalg.norm(weights[:, None] * block, axis=0), 1e-300)
    for _ in range(2):
        for q, v in zip(basis, whole, strict=True):
            block = block - v @ (q.T @ (weights[:, None] * block))
    left_vectors, sizes, turn = np.linalg.svd(weights[:, None] * block, full_matrices=False)
    regular = sizes > SMALLEST * sizes.max()
    q = np.where(regular, left_vectors, 0.0)
    v = np.where(regular, block @ turn.T / np.where(regular, sizes, 1.0), 0.0)
    return q, v


@dataclass(frozen=True)
class _Pairs:
    """Slow eigenpairs: ``left`` (m, k), ``right`` (k, m), eigenvalues of the step ``factor`` (m,) and of the dynamics ``exponent`` (m,)."""

    left: NDArray[np.complex128]
    right: NDArray[np.complex128]
    factor: NDArray[np.complex128]
    exponent: NDArray[np.complex128]


def _slow_pairs(reduced: Floats, count: int) -> _Pairs | None:
    """The ``count`` slowest vibrations of the ``reduced`` step (k, k); None where there are none."""
    if not np.isfinite(reduced).all():
        return None
    real, imaginary, left, right, failed = dgeev(reduced)
    if failed:
        return None
    values = real + 1j * imaginary
    with np.errstate(divide="ignore", invalid="ignore"):
        mu = (1.0 - 1.0 / values) / SHIFT_STEP
    # of each pair the first, whose vectors LAPACK keeps in two columns: real part, imaginary part
    wanted = (
        (imaginary > 0.0)
        & np.isfinite(mu)
        & (mu.imag > 1.0)
        & (-mu.real < MAX_DAMPING * np.abs(mu))
        & (mu.real < 0.05 * np.abs(mu))
    )
    order = np.flatnonzero(wanted)[np.argsort(np.abs(mu[wanted]))]
    left, right = left[:, order] - 1j * left[:, order + 1], right[:, order] + 1j * right[:, order + 1]
    overlap = np.einsum("ji,ji->i", left, right)
    slowest = np.flatnonzero(np.abs(overlap) > 1e-8)[:count]  # else defective
    if not len(slowest):
        return None
    left, right = (left[:, slowest] / overlap[slowest]).T, right[:, slowest]
    return _Pairs(left, right, values[order[slowest]], mu[order[slowest]])


def _main_axes(moved: NDArray[np.complex128]) -> Floats:
    """(m, 3) unit, main axis of the ellipse that each row of ``moved`` (m, 3) describes; zero where it is none."""
    # the real part at the phase that makes real and imaginary part perpendicular
    axis = (moved * np.exp(-0.5j * np.angle((moved**2).sum(1)))[:, None]).real
    axis /= np.maximum(np.linalg.norm(axis, axis=1), 1e-300)[:, None]
    axis *= np.where(axis[range(len(axis)), np.abs(axis).argmax(1)] < 0.0, -1.0, 1.0)[:, None]
    return axis
