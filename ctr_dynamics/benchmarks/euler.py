"""The release test with Euler's explicit method along the tubes, for the comparison in the paper's Figure 14; nothing else uses it.

All that is not the integration of a section is the model's own sweep.
"""

from __future__ import annotations

from types import FunctionType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.benchmarks.release import DT, Release, release_robot
from ctr_dynamics.kernels import rod as kernels
from ctr_dynamics.kernels.compiler import njit
from ctr_dynamics.kernels.lanes import rows
from ctr_dynamics.kernels.layout import RATES, Y_NOW
from ctr_dynamics.kernels.sections import section_lengths
from ctr_dynamics.kernels.shooting import broyden
from ctr_dynamics.kernels.workspace import field_rows, offsets, state_rows
from ctr_dynamics.model.model import Model
from ctr_dynamics.model.statics import Statics
from ctr_dynamics.model.time_scheme import make_scheme

Floats = NDArray[np.float64]
TOLERANCE, LIMIT = 1e-7, 40


@njit(cache=False, nogil=True, error_model="numpy")
def _euler_cells(tubes, W, present, cells, h, point, node, ust, c0, hist, shared, own, out, nodes, kept):
    """As :func:`ctr_dynamics.kernels.rod._cells`, with the slope at the beginning of every cell alone."""
    S, F = state_rows(len(tubes)), field_rows(len(tubes))
    Y, YS, K, _, HI, OU, _, _, _, _ = offsets(tubes)
    for cell in range(cells):
        for r in range(S):
            nodes[(node + cell) * S + r] = W[Y + r]
            W[YS + r] = W[Y + r]
        at = point + 4 * cell
        for r in range(F):
            W[HI + r] = hist[at * F + r]
        kernels._derivative(tubes, W, present, ust, at * 3 * len(tubes), c0)
        for r in range(F):
            out[at * F + r] = W[OU + r]
        for r in range(S):
            W[Y + r] += h * W[K + r]


def _with(kernel: Any, **replaced: Any) -> Any:
    """The ``kernel`` with other functions in place of those it calls by these names."""
    function = FunctionType(kernel.py_func.__code__, {**vars(kernels), **replaced})
    return njit(cache=False, nogil=True, error_model="numpy")(function)


_sweep = _with(kernels._sweep, _section=_with(kernels._section, _cells=_euler_cells))


@njit(cache=False, nogil=True, error_model="numpy")
def euler_sweep(tubes, W, c0, mesh, par, seclen, x, hist, histb, out, outb, nodes, res):
    """:func:`ctr_dynamics.kernels.rod.sweep` of one lane by Euler's method."""
    given = rows((), hist, 0, 1)
    _sweep(
        tubes, rows((), W, 0, 1), c0, mesh, rows((), par, 0, 1), rows((), seclen, 0, 1), rows((), x, 0, 1), given, given, True,
        rows((), histb, 0, 1), rows((), out, 0, 1), rows((), outb, 0, 1), rows((), nodes, 0, 1), (True, True), rows((), res, 0, 1),
    )  # fmt: skip


class _Shooting:
    """The two-point problem of one mesh, with its buffers and an inverse Jacobian that is used again."""

    def __init__(self, model: Model, test: Release) -> None:
        first = test.at(0.0)
        self.model = model
        start = Statics(model, 1e-8).solve(first.beta, first.alpha, first.force, first.torque)
        self.mesh, self.x = start.mesh, start.x.copy()
        self.W, self.par, self.seclen, _, self.hist, self.histb, self.out, self.outb, self.nodes, self.res = (
            model.buffers(self.mesh, 1)
        )
        self.par[:] = model.parameters
        section_lengths(self.mesh.bp_tube, self.mesh.bp_offset, first.beta, self.seclen)
        self.inverse: Floats | None = None

    def residual(self, c0: float, x: Floats) -> Floats:
        euler_sweep(
            self.model.tubes, self.W, c0, self.mesh, self.par, self.seclen, x, self.hist, self.histb, self.out, self.outb, self.nodes, self.res,
        )  # fmt: skip
        return self.res.copy()

    def solve(self, c0: float, given: Floats, y_hist: Floats) -> bool:
        """Unknowns and fields at the inputs ``given`` (alpha, rate, beta, force, torque) with the history ``y_hist`` (fields,)."""
        layout, main = self.model.layout, len(self.hist)
        n = self.model.n
        for name, part in (
            ("alpha", given[:n]),
            ("alpha_rate", given[n : 2 * n]),
            ("beta", given[2 * n : 3 * n]),
            ("force", given[3 * n : 3 * n + 3]),
            ("torque", given[3 * n + 3 :]),
        ):
            self.par[layout[name]] = part
        self.hist[:], self.histb[:] = y_hist[:main], y_hist[main:]

        def size_of(res: Floats) -> float:
            size = np.abs(res / self.model.scale).max()
            return float(size) if np.isfinite(size) else np.inf

        res = self.residual(c0, self.x)
        size, share, newest = size_of(res), 1.0, False
        for _ in range(LIMIT):
            if size <= TOLERANCE:
                return True
            if self.inverse is None:
                steps = np.diag(self.model.step)
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

    fields = len(problem.hist) + len(problem.histb)
    bank = np.zeros((RATES + scheme.stages, fields))
    if not problem.solve(0.0, given(0.0), np.zeros(fields)):
        return None
    S = state_rows(model.n)
    tips = [problem.nodes[-S:][:3].copy()]
    bank[Y_NOW] = np.r_[problem.out, problem.outb]
    problem.inverse = None
    for k in range(round(duration / DT)):
        for stage in range(scheme.stages):
            hist = scheme.weights[stage] @ bank
            if not problem.solve(scheme.c0[stage], given((k + scheme.times[stage]) * DT), hist):
                return None
            bank[RATES + stage] = scheme.c0[stage] * np.r_[problem.out, problem.outb] + hist
        bank[Y_NOW] = np.r_[problem.out, problem.outb]
        tips.append(problem.nodes[-S:][:3].copy())
    return np.array(tips)
