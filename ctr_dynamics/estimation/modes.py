"""Slowest vibration modes about the current equilibrium, and how much of each the robot is in now.

One backward Euler step of size h maps a perturbation of the fields by (1 - h A)^-1 with A the linearised dynamics, so
block Arnoldi on the tangent of that step is shift-invert Arnoldi with the shift 1/h: the slowest modes come out first.
For an eigenvalue lambda of the step, mu = (1 - 1/lambda) / h.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dgeev

from ctr_dynamics.estimation.filter.energy_norm import field_weights
from ctr_dynamics.estimation.step_output import Modes
from ctr_dynamics.kernels.filter_steps import modal_coordinates
from ctr_dynamics.kernels.rotations import matrix
from ctr_dynamics.kernels.shooting import lanes_for
from ctr_dynamics.kernels.tangent import linearise
from ctr_dynamics.model.mesh import Key
from ctr_dynamics.model.mesh_interpolation import Transfer, transfer
from ctr_dynamics.model.model import Model
from ctr_dynamics.model.simulator import Inputs, State
from ctr_dynamics.model.statics import Equilibrium, Statics

Floats = NDArray[np.float64]
SHIFT_STEP = 0.02  # s: the shift 50 / s lies among the slow bending modes
BLOCK = 8
ROUNDS = 4
MODE_NODES = 16
MOVED = 5e-4, 0.01  # m of any node, rad of any tube's base: modes of a robot that has moved less are kept
MOST_KEPT = 4  # refreshes in a row
_END = object()
MAX_DAMPING = 0.7  # more is no vibration


@dataclass(frozen=True)
class ModalBasis:
    """Modes about one equilibrium.

    Attributes:
        frequency_hz, damping: (m,). exponent: (m,) complex mu in 1/s.
        readout: (2m, fields) real, then imaginary parts of the modal coordinate z = readout (y - rest): the tip's displacement along the mode's
            main direction is 2 Re z and its speed 2 Re(mu z).
        rest: (fields,) fields of the equilibrium; inputs (2N + 6,): alpha, beta, force and torque there.
        follow: (2m, 2N + 6) modal coordinates of the equilibrium that moves with alpha, beta, force and torque.
        direction: (m, 3) unit, main direction of the tip's motion in ``ctr_base``; zero where a mode does not move it.
    """

    frequency_hz: Floats
    damping: Floats
    exponent: NDArray[np.complex128]
    readout: Floats
    rest: Floats
    direction: Floats
    inputs: Floats
    follow: Floats

    def measure(self, fields: Floats, now: Inputs) -> Modes:
        """Amplitude and rate of each mode in ``fields`` (fields,) at the actuators and load ``now``."""
        by_fields, by_inputs, at_rest = self._rows
        m = len(self.damping)
        values = modal_coordinates(
            by_fields, fields, by_inputs, now.alpha, now.beta, now.force, now.torque, at_rest
        )
        return Modes(self.frequency_hz, self.damping, values[:m], values[m:])

    @cached_property
    def _rows(self) -> tuple[Floats, Floats, Floats]:
        """Amplitudes and rates (2m,) by fields (2m, fields), by inputs (2m, 2N + 6), and in the fields and inputs of the equilibrium (2m,)."""
        m = len(self.damping)
        turn = 2.0 * np.block(
            [[np.eye(m), np.zeros((m, m))], [np.diag(self.exponent.real), np.diag(-self.exponent.imag)]]
        )
        by_fields, by_inputs = turn @ self.readout, turn @ self.follow
        return by_fields, by_inputs, by_fields @ self.rest - by_inputs @ self.inputs


def lanes_of(model: Model) -> tuple[int, ...]:
    """Lane tuple of the tangents: the base case and the unknowns, and as many columns as a block has."""
    return lanes_for(6 + model.n + BLOCK)


def equilibrium_slope(
    model: Model, equilibrium: Equilibrium, par: Floats, big: tuple[Floats, ...]
) -> Floats | None:
    """d(equilibrium's fields)/d(alpha, beta, force, torque), (fields, 2N + 6); ``big``: buffers of :func:`lanes_of` lanes."""
    n, layout = model.n, model.layout
    rows = np.concatenate([layout.rows(name) for name in ("alpha", "beta", "force", "torque")])
    m, count = 5 + n, len(rows)
    lanes = lanes_of(model)
    L = 8 * len(lanes)
    main, base = len(big[4]) // L, len(big[5]) // L
    scale = np.array([1e-2] * n + [1e-4] * n + [1e-4] * 3 + [1e-6] * 3)
    dpar = np.zeros((layout.size, count))
    dpar[rows, range(count)] = scale
    fields, nodes = np.zeros((main + base, count)), np.zeros((equilibrium.nodes.size, count))
    ok = linearise(
        model.tubes, lanes, equilibrium.mesh, 0.0, par, dpar, equilibrium.x, np.zeros(main), np.zeros(base),
        np.zeros((main + base, count)), 1e-3, model.tangent_step, big, np.zeros((m, m)), np.zeros((m, count)), fields, nodes,
    )  # fmt: skip
    return fields / scale if ok else None


def modal_basis(
    model: Model,
    equilibrium: Equilibrium,
    par: Floats,
    beta: Floats,
    count: int = 4,
) -> ModalBasis | None:
    """The ``count`` slowest modes about ``equilibrium`` with the parameter block ``par`` (NP,), actuators and load included; None if there are none.

    Friction enters as its slope at rest.
    """
    found = None
    big = model.buffers(equilibrium.mesh, 8 * len(lanes_of(model)))
    for part in modal_parts(model, equilibrium, par, beta, big, count):
        found = part
    return found


def modal_parts(
    model: Model, equilibrium: Equilibrium, par: Floats, beta: Floats, big: tuple[Floats, ...], count: int = 4
) -> Iterator[ModalBasis | None]:
    """The work of :func:`modal_basis` in parts of about equal cost, each ended by a None; the last item is the result. ``big``: buffers of
    :func:`lanes_of` lanes, in use until then."""
    mesh = equilibrium.mesh
    n, m = model.n, 5 + model.n
    lanes = lanes_of(model)
    L = 8 * len(lanes)
    main, base = len(big[4]) // L, len(big[5]) // L
    size = main + base
    c0 = 1.0 / SHIFT_STEP
    hist = -c0 * equilibrium.fields
    inverse, dx = np.zeros((m, m)), np.zeros((m, BLOCK))
    dfields, dnodes = np.zeros((size, BLOCK)), np.zeros((equilibrium.nodes.size, BLOCK))
    weights = np.sqrt(field_weights(model, mesh, beta))

    def apply(columns: Floats, dpar: Floats) -> Floats | None:
        scale = 1e-4
        ok = linearise(
            model.tubes, lanes, mesh, c0, par, dpar, equilibrium.x, hist[:main], hist[main:], -c0 * scale * columns, 1e-3, model.tangent_step,
            big, inverse, dx, dfields, dnodes,
        )  # fmt: skip
        return dfields / scale if ok else None

    follow = equilibrium_slope(model, equilibrium, par, big)
    if follow is None:
        return
    yield None
    # start: responses to a force and a moment on the tip and a turn of each actuator
    layout = model.layout
    dpar = np.zeros((layout.size, BLOCK))
    for i in range(3):
        dpar[layout["force"].start + i, i] = 1e-6
        dpar[layout["torque"].start + i, 3 + i] = 1e-8
    for i in range(min(n, BLOCK - 6)):
        dpar[layout["torsional_stiffness"].start + i, 6 + i] = (
            1e-4 * par[layout["torsional_stiffness"].start + i]
        )
    start = apply(np.zeros((size, BLOCK)), dpar)
    if start is None:
        return
    yield None
    dpar[:] = 0.0
    basis: list[Floats] = []
    whole: list[Floats] = []
    images: list[Floats] = []
    block = start
    for _ in range(ROUNDS):
        # Gram-Schmidt in the energy norm on whole vectors: the points at section ends have no energy of their own, but their
        # history carries the bodies' inertia
        block = block / np.maximum(np.linalg.norm(weights[:, None] * block, axis=0), 1e-300)
        for _ in range(2):
            for q, v in zip(basis, whole, strict=True):
                block = block - v @ (q.T @ (weights[:, None] * block))
        left_vectors, sizes, turn = np.linalg.svd(weights[:, None] * block, full_matrices=False)
        keep = sizes > 1e-9 * sizes.max()
        q = np.where(keep, left_vectors, 0.0)
        v = np.where(keep, block @ turn.T / np.where(keep, sizes, 1.0), 0.0)
        image = apply(v, dpar)
        if image is None:
            return
        basis.append(q)
        whole.append(v)
        images.append(image)
        block = image
        yield None
    Q, image = np.concatenate(basis, axis=1), np.concatenate(images, axis=1)
    reduced = Q.T @ (weights[:, None] * image)
    if not np.isfinite(reduced).all():
        return
    real, imaginary, left, right, failed = dgeev(reduced)
    if failed:
        return
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
        return
    left, right = (left[:, slowest] / overlap[slowest]).T, right[:, slowest]
    chosen, factor = mu[order[slowest]], values[order[slowest]]
    coordinates = ((left.real @ Q.T) + 1j * (left.imag @ Q.T)) * weights  # of the modes, in any fields
    tip = matrix(equilibrium.tip_quaternion) @ image[main - (7 + 2 * n) :][:3]  # velocity of the images
    moved = (tip @ (right / (factor * chosen))).T  # displacement: an ellipse
    # its main axis: the real part at the phase that makes real and imaginary part perpendicular
    axis = (moved * np.exp(-0.5j * np.angle((moved**2).sum(1)))[:, None]).real
    axis /= np.maximum(np.linalg.norm(axis, axis=1), 1e-300)[:, None]
    axis *= np.where(axis[range(len(axis)), np.abs(axis).argmax(1)] < 0.0, -1.0, 1.0)[:, None]
    readout = coordinates * (axis * moved).sum(1)[:, None]
    rows = np.concatenate([readout.real, readout.imag])
    yield ModalBasis(
        np.abs(chosen.imag) / (2 * np.pi),
        -chosen.real / np.abs(chosen),
        chosen,
        rows,
        equilibrium.fields,
        axis,
        np.concatenate([par[layout["alpha"]], beta, par[layout["force"]], par[layout["torque"]]]),
        rows @ follow,
    )


class ModeTracker:
    """The modes of a moving robot: refreshed now and then, part by part between the steps, and read in every step.

    They are found on at most ``MODE_NODES`` nodes; the equilibrium that amplitudes count from is the model's own. Where the robot has hardly
    moved, that is all that is refreshed.
    """

    def __init__(self, model: Model, every: int) -> None:
        self.model, self.every = model, every
        self.coarse = model if model.nodes <= MODE_NODES else Model(model.robot, MODE_NODES, model.base_cells)
        self._transfers: dict[tuple[Key, Key], Transfer] = {}
        self._buffers: dict[Key, tuple[Floats, ...]] = {}
        self.clear()

    def clear(self) -> None:
        """Forget the modes."""
        self._basis: ModalBasis | None = None
        self._age = self.every
        self._pending: Iterator[ModalBasis | None] | None = None
        self._own: Equilibrium | None = None
        self._transfer: Transfer | None = None
        self._alpha = np.zeros(self.model.n)  # where the modes were found
        self._kept = MOST_KEPT  # refreshes since then; MOST_KEPT where there are none to keep

    def measure(self, state: State) -> Modes:
        """Modes in ``state``; to be called once a step."""
        self._age += 1
        if self._own is not None and self._own.key != state.key:
            self.clear()
        if self._basis is None:
            return Modes.none()
        return self._basis.measure(state.fields, state.inputs)

    def refresh(self, state: State, parameters: Floats) -> None:
        """A part of the work that renews the modes, where they are old, about ``state`` with the parameter block (NP,)."""
        if self._pending is not None:
            part = next(self._pending, _END)
            if part is _END:
                self._pending = None
            elif isinstance(part, ModalBasis):
                assert self._own is not None
                readout = part.readout if self._transfer is None else part.readout @ self._transfer.restrict
                self._basis, self._pending = replace(part, readout=readout, rest=self._own.fields), None
                self._kept = 0
        elif self._age > self.every:
            self._age = 0
            self._begin(state, parameters)

    def _begin(self, state: State, parameters: Floats) -> None:
        now, layout = state.inputs, self.model.layout
        equilibrium = Statics(self.model, 1e-6).solve(
            now.beta,
            now.alpha,
            now.force,
            now.torque,
            guess=state.unknowns[-1],
            parameters=parameters,
            key=state.key,
        )
        if not equilibrium.converged or equilibrium.key != state.key:
            return
        if self._kept < MOST_KEPT and not self._moved(equilibrium, now.alpha):
            assert self._basis is not None
            inputs = np.concatenate([now.alpha, now.beta, now.force, now.torque])
            self._basis = replace(self._basis, rest=equilibrium.fields, inputs=inputs)
            self._kept += 1
            return
        par = parameters.copy()
        par[layout["alpha"]], par[layout["beta"]], par[layout["alpha_rate"]] = now.alpha, now.beta, 0.0
        par[layout["force"]], par[layout["torque"]] = now.force, now.torque
        on = equilibrium
        if self.coarse is not self.model:
            on = Statics(self.coarse, 1e-6).solve(
                now.beta, now.alpha, now.force, now.torque, guess=equilibrium.x, parameters=parameters
            )
            if not on.converged:
                return
            pair = (equilibrium.key, on.key)
            if pair not in self._transfers:
                self._transfers[pair] = transfer(self.model.n, equilibrium.mesh, on.mesh)
            self._transfer = self._transfers[pair]
        self._own, self._alpha, self._kept = equilibrium, now.alpha, MOST_KEPT
        if on.key not in self._buffers:
            self._buffers[on.key] = self.coarse.buffers(on.mesh, 8 * len(lanes_of(self.coarse)))
        self._pending = modal_parts(self.coarse, on, par, now.beta.copy(), self._buffers[on.key])

    def _moved(self, equilibrium: Equilibrium, alpha: Floats) -> bool:
        """Whether ``equilibrium`` at ``alpha`` (N,) is another than the one that the modes are about."""
        assert self._own is not None
        path = np.abs(equilibrium.nodes[:, :3] - self._own.nodes[:, :3]).max()
        turn = np.abs(alpha - self._alpha).max()
        return bool(path > MOVED[0] or turn > MOVED[1])
