"""The release test with Euler's explicit method along the tubes, for the comparison in the paper's Figure 14; nothing else uses it.

All that is not the integration of a section is the model's own sweep.
"""

from __future__ import annotations

from types import FunctionType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.benchmarks.release import DT, Release, release_robot
from ctr_dynamics.kernels import sweep as kernels
from ctr_dynamics.kernels.compiler import njit
from ctr_dynamics.kernels.kinds import ONE_LANE
from ctr_dynamics.kernels.layout import RATES, Y_NOW, field_rows, input_rows, state_rows, workspace_rows
from ctr_dynamics.kernels.sections import section_lengths
from ctr_dynamics.kernels.shooting import broyden
from ctr_dynamics.model.model import Model
from ctr_dynamics.model.statics import Statics
from ctr_dynamics.model.time_scheme import make_scheme

Floats = NDArray[np.float64]
TOLERANCE, LIMIT = 1e-7, 40


@njit(cache=False, nogil=True, error_model="numpy")
def _euler_cells(kind, W, v, present, first, last, cells, h, point, node, ust, c0):
    """As :func:`ctr_dynamics.kernels.sweep.cells_of_section`, with the slope at the beginning of every cell alone."""
    n = kind.tubes
    S, F, at = state_rows(n).size, field_rows(n).size, workspace_rows(n)
    for cell in range(first, last):
        for r in range(S):
            v.nodes[(node + cell) * S + r] = W[at.state + r]
            W[at.stage + r] = W[at.state + r]
        here = point + 4 * cell
        kernels.load_history(kind, W, v, here)
        kernels.derivative(kind, W, present, ust, here * 3 * n, c0)
        for r in range(F):
            v.fields[here * F + r] = W[at.fields + r]
        for r in range(S):
            W[at.state + r] += h * W[at.slope + r]


def _with(kernel: Any, **replaced: Any) -> Any:
    """The ``kernel`` with other functions in place of those it calls by these names."""
    function = FunctionType(kernel.py_func.__code__, {**vars(kernels), **replaced})
    return njit(cache=False, nogil=True, error_model="numpy")(function)


_section = _with(kernels.section, cells_of_section=_euler_cells)
euler_sweep = _with(kernels.sweep, sweep_batch=_with(kernels.sweep_batch, section=_section))


class _Shooting:
    """The two-point problem of one mesh, with its buffers and an inverse Jacobian that is used again."""

    def __init__(self, model: Model, test: Release) -> None:
        first = test.at(0.0)
        self.model = model
        start = Statics(model, 1e-8).solve(first.beta, first.alpha, first.force, first.torque)
        self.mesh, self.x = start.mesh, start.x.copy()
        self.buffers = model.sweep_buffers(self.mesh, 1)
        self.buffers.parameters[:] = model.parameters
        section_lengths(self.mesh.bp_tube, self.mesh.bp_offset, first.beta, self.buffers.section_lengths)
        self.inverse: Floats | None = None

    def residual(self, c0: float, x: Floats) -> Floats:
        self.buffers.unknowns[:] = x
        euler_sweep(self.model.kind, ONE_LANE, c0, self.mesh, self.buffers)
        return self.buffers.residual.copy()

    def solve(self, c0: float, given: Floats, y_hist: Floats) -> bool:
        """Unknowns and fields at the inputs ``given`` (alpha, rate, beta, force, torque) with the history ``y_hist`` (fields,)."""
        layout, main = self.model.layout, len(self.buffers.history)
        for name in ("alpha", "alpha_rate", "beta", "force", "torque"):
            self.buffers.parameters[layout[name]] = given[input_rows(self.model.n)[name]]
        self.buffers.history[:], self.buffers.base_history[:] = y_hist[:main], y_hist[main:]

        def size_of(res: Floats) -> float:
            size = np.abs(res / self.model.scale).max()
            return float(size) if np.isfinite(size) else np.inf

        res = self.residual(c0, self.x)
        size, share, newest = size_of(res), 1.0, False
        for _ in range(LIMIT):
            if size <= TOLERANCE:
                return True
            if self.inverse is None:
                steps = np.diag(self.model.perturbation)
                columns = [(self.residual(c0, self.x + step) - res) / step.sum() for step in steps]
                self.inverse = np.ascontiguousarray(np.linalg.inv(np.stack(columns, axis=1)))
                newest = True
            dx = -share * self.inverse @ res
            new = self.residual(c0, self.x + dx)
            reached = size_of(new)
            if reached < size:
                broyden(self.inverse, dx, new - res, np.empty((2, len(dx))))
                slow = reached > 0.6 * size
                self.x, res, size, share, newest = self.x + dx, new, reached, min(1.0, 2.0 * share), False
                if slow:
                    self.inverse = None
            elif newest:
                share *= 0.5
            else:
                self.inverse = None
        return False


def euler_tips(test: Release, nodes: int, duration: float) -> Floats | None:
    """Tips (steps + 1, 3) m of the release at 3 ms by the default time scheme; None if a step has no solution."""
    model, scheme = Model(release_robot(), nodes=nodes), make_scheme("sdirk3", DT)
    problem = _Shooting(model, test)

    def given(t: float) -> Floats:
        now = test.at(t)
        return np.r_[now.alpha, now.alpha_rate, now.beta, now.force, now.torque]

    b = problem.buffers
    fields = len(b.history) + len(b.base_history)
    bank = np.zeros((RATES + scheme.stages, fields))
    if not problem.solve(0.0, given(0.0), np.zeros(fields)):
        return None
    S = state_rows(model.n).size
    tips = [b.nodes[-S:][:3].copy()]
    bank[Y_NOW] = np.r_[b.fields, b.base_fields]
    problem.inverse = None
    for k in range(round(duration / DT)):
        for stage in range(scheme.stages):
            hist = scheme.weights[stage] @ bank
            if not problem.solve(scheme.c0[stage], given((k + scheme.times[stage]) * DT), hist):
                return None
            bank[RATES + stage] = scheme.c0[stage] * np.r_[b.fields, b.base_fields] + hist
        bank[Y_NOW] = np.r_[b.fields, b.base_fields]
        tips.append(b.nodes[-S:][:3].copy())
    return np.array(tips)
