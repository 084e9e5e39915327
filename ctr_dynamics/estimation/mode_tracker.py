"""The vibration modes of a moving robot: refreshed now and then as idle work, part by part, and read in every step."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.estimation.filter.covariance_factor import Vibrating
from ctr_dynamics.estimation.step_output import Modes
from ctr_dynamics.estimation.timeline import seconds
from ctr_dynamics.estimation.vibration_modes import ModalBasis, lanes_of, modal_parts
from ctr_dynamics.kernels.structures import SweepBuffers
from ctr_dynamics.model.mesh import Key, Mesh
from ctr_dynamics.model.mesh_interpolation import MeshInterpolation, mesh_interpolation
from ctr_dynamics.model.model import Model
from ctr_dynamics.model.state import State, at_inputs
from ctr_dynamics.model.statics import Equilibrium, Statics

Floats = NDArray[np.float64]
_END = object()


@dataclass(frozen=True)
class RefreshOptions:
    """When modes are found again.

    Attributes:
        nodes: on which they are found at most: the slow modes need no more.
        moved_m, moved_rad: of any node and of any tube's base. A robot that has moved less has the same modes.
        most_reused: refreshes in a row that renew the equilibrium alone.
        tolerance: of the equilibrium's residual.
    """

    nodes: int = 16
    moved_m: float = 5e-4
    moved_rad: float = 1e-2
    most_reused: int = 4
    tolerance: float = 1e-6


class ModeTracker:
    """The modes of one robot.

    They are found on a coarse mesh; the equilibrium that amplitudes count from is the model's own. Where the robot has hardly moved, that is all that
    is refreshed.

    Args:
        model: the robot.
        every: steps between refreshes.
    """

    def __init__(self, model: Model, every: int) -> None:
        self.model, self.every, self.options = model, every, RefreshOptions()
        nodes = self.options.nodes
        self.coarse = model if model.nodes <= nodes else Model(model.robot, nodes, model.base_cells)
        self._interpolations: dict[tuple[Key, Key], MeshInterpolation] = {}
        self._buffers: dict[Key, SweepBuffers] = {}
        self._former: ModalBasis | None = None  # the last modes found, on the coarse mesh
        self._mesh: Mesh | None = None  # that
        self.clear()

    def clear(self) -> None:
        """Forget the modes, but for what continues them in order and sign."""
        self._basis: ModalBasis | None = None
        self._load: tuple[int, tuple[float, ...]] | None = None  # step and load (6,) of the last measurement
        self._age = self.every
        self._pending: Iterator[ModalBasis | None] | None = None
        self._own: Equilibrium | None = None
        self._interpolation: MeshInterpolation | None = None
        self._alpha = np.zeros(self.model.n)  # where the modes were found
        self._reused = (
            self.options.most_reused
        )  # refreshes since then; the most where there is nothing to reuse

    @property
    def refreshing(self) -> bool:
        """Whether a refresh has begun and has parts left."""
        return self._pending is not None

    def measure(self, state: State, k: int) -> Modes:
        """Modes in ``state`` at step ``k``; to be called once a step."""
        self._age += 1
        if self._own is not None and self._own.key != state.key:
            self.clear()
        if self._basis is None:
            return Modes.none()
        force, torque = state.inputs.force, state.inputs.torque
        load = (*force.tolist(), *torque.tolist())
        before, self._load = self._load, (k, load)
        rate = None
        if before is not None and before[0] < k and load != before[1]:
            rate = (np.array(load) - np.array(before[1])) / seconds(k - before[0])
        return self._basis.measure(state.fields, state.inputs, rate)

    def refresh(self, state: State, parameters: Floats) -> None:
        """A part of the work that renews the modes, where they are old, about ``state`` with the parameter block (NP,)."""
        if self._pending is not None:
            part = next(self._pending, _END)
            if part is _END:
                self._pending = None
            elif isinstance(part, ModalBasis):
                assert self._own is not None
                if self._former is not None:
                    part = part.aligned_with(self._former)
                self._former = part
                readout = (
                    part.readout
                    if self._interpolation is None
                    else part.readout @ self._interpolation.restrict
                )
                self._basis, self._pending = replace(part, readout=readout, rest=self._own.fields), None
                self._reused = 0
        elif self._age > self.every:
            self._age = 0
            self._begin(state, parameters)

    def vibrating(self, state: State, parameters: Floats, deviation: float) -> Vibrating | None:
        """Vibrations that the robot in ``state`` may have, of the ``deviation`` (m) at the tip; None where no modes are found."""
        self.clear()
        self._begin(state, parameters)
        while self._pending is not None:
            self.refresh(state, parameters)
        if self._basis is None:
            return None
        assert self._former is not None
        assert self._mesh is not None
        return Vibrating(self._former.vibrating(deviation), self._mesh)

    def _begin(self, state: State, parameters: Floats) -> None:
        now = state.inputs
        equilibrium = Statics(self.model, self.options.tolerance).solve_at(
            now, guess=state.unknowns_at_base, parameters=parameters, key=state.key
        )
        if not equilibrium.converged or equilibrium.key != state.key:
            return
        if self._reused < self.options.most_reused and not self._moved(equilibrium, now.alpha):
            assert self._basis is not None
            inputs = np.concatenate([now.alpha, now.beta, now.force, now.torque])
            self._basis = replace(self._basis, rest=equilibrium.fields, inputs=inputs)
            self._reused += 1
            return
        par = at_inputs(self.model, parameters, now)
        on = equilibrium
        if self.coarse is not self.model:
            on = Statics(self.coarse, self.options.tolerance).solve_at(
                now, guess=equilibrium.x, parameters=parameters
            )
            if not on.converged:
                return
            pair = (equilibrium.key, on.key)
            if pair not in self._interpolations:
                self._interpolations[pair] = mesh_interpolation(self.model.n, equilibrium.mesh, on.mesh)
            self._interpolation = self._interpolations[pair]
        self._mesh = on.mesh
        self._own, self._alpha, self._reused = equilibrium, now.alpha, self.options.most_reused
        if on.key not in self._buffers:
            self._buffers[on.key] = self.coarse.sweep_buffers(on.mesh, lanes_of(self.coarse).count)
        self._pending = modal_parts(self.coarse, on, par, now.beta.copy(), self._buffers[on.key])

    def _moved(self, equilibrium: Equilibrium, alpha: Floats) -> bool:
        """Whether ``equilibrium`` at ``alpha`` (N,) is another than the one that the modes are about."""
        assert self._own is not None
        path = np.abs(equilibrium.nodes[:, :3] - self._own.nodes[:, :3]).max()
        turn = np.abs(alpha - self._alpha).max()
        return bool(path > self.options.moved_m or turn > self.options.moved_rad)
