"""Time derivatives of lanes that are stages of one collocation step, y_t,i = sum over j of C_ij y_j + h_i.

A sweep only ever multiplies c0 by numbers of its lanes. So a matrix may stand in its place: a :class:`Coupling` times a batch mixes the lanes of each
group of four in the batch, which are the stages of one step, and the kernels need no change.

Where c0 stands on the left of an equation (:mod:`ctr_dynamics.kernels.complex_rates`), a coupling has the inverse matrices ready, which
:func:`fill_coupling` makes from the parameters. All numbers of a coupling lie in one flat table: matrix after matrix, column after column, a
number of every lane in each column.
"""

import operator

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic, lower_builtin, models, register_model, type_callable

from ctr_dynamics.kernels.compiler import njit
from ctr_dynamics.kernels.kinds import KindType
from ctr_dynamics.kernels.layout import parameter_rows
from ctr_dynamics.kernels.simd import SimdBatch, _llvm, _vector

STAGES = 4  # lanes of a group


class Coupling(types.Type):
    """C for batches of ``width`` lanes; ``damped`` where it is for tubes with damping."""

    def __init__(self, width: int, damped: bool) -> None:
        self.width, self.damped = width, damped
        super().__init__(name=f"Coupling({width}, {damped})")


class Damping:
    """Whether the tubes have damping, as the compiler knows it: without, nothing is divided by a matrix."""

    def __init__(self, damped: bool) -> None:
        self.damped = damped
        self._numba_type_ = KindType(f"Damping({damped})", {"damped": int(damped)})


DAMPED, UNDAMPED = Damping(True), Damping(False)


@register_model(Coupling)
class _CouplingModel(models.StructModel):
    def __init__(self, dmm, fe_type):
        super().__init__(dmm, fe_type, [("table", types.CPointer(types.float64))])


@intrinsic
def stage_coupling(typingctx, lanes, damping, table):
    """The coupling of the flat ``table`` for batches of the ``lanes``."""
    kind = Coupling(lanes.constants["width"], bool(damping.constants["damped"]))

    def code(context, builder, signature, args):
        proxy = cgutils.create_struct_proxy(kind)(context, builder)
        proxy.table = context.make_array(table)(context, builder, args[2]).data
        return proxy._getvalue()

    return kind(lanes, damping, table), code


@intrinsic
def inverse_of(typingctx, c0, number):
    """The inverse matrix ``number`` of a coupling, as a coupling."""

    def code(context, builder, signature, args):
        proxy = cgutils.create_struct_proxy(c0)(context, builder, value=args[0])
        after = builder.add(args[1], ir.Constant(ir.IntType(64), 1))
        first = builder.mul(after, ir.Constant(ir.IntType(64), STAGES * c0.width))
        moved = cgutils.create_struct_proxy(c0)(context, builder)
        moved.table = builder.gep(proxy.table, [first])
        return moved._getvalue()

    return c0(c0, types.intp), code


@type_callable(operator.mul)
def _type_mul(context):
    def typer(a, b):
        if isinstance(a, Coupling) and isinstance(b, SimdBatch) and a.width == b.width:
            return b
        return None

    return typer


@lower_builtin(operator.mul, Coupling, SimdBatch)
def _mix(context, builder, signature, args):
    kind, batch = signature.args
    proxy = cgutils.create_struct_proxy(kind)(context, builder, value=args[0])
    vector = _vector(batch)
    total = None
    for j in range(STAGES):
        lanes = [lane // STAGES * STAGES + j for lane in range(kind.width)]
        mask = ir.Constant(ir.VectorType(ir.IntType(32), kind.width), lanes)
        spread = builder.shuffle_vector(args[1], ir.Constant(vector, ir.Undefined), mask)
        place = builder.gep(proxy.table, [ir.Constant(ir.IntType(64), j * kind.width)])
        column = builder.load(builder.bitcast(place, vector.as_pointer()), align=8)
        total = (
            builder.fmul(column, spread)
            if total is None
            else _llvm(builder, "fma", batch, [column, spread, total])
        )
    return total


# groups of inverses in the table, of one matrix a tube each, behind C; of the last group only the first tube's is in use
TORSION, BENDING, DRIVE, MEMORY, GROUPS = 0, 1, 2, 3, 4


@njit(nogil=True)
def _number(n, group, tube):
    """Number of the matrix of ``tube`` in ``group``."""
    return 1 + group * n + tube


def table_size(n: int, width: int) -> int:
    """Numbers in the table of a coupling for ``n`` tubes: C, and the inverses: those with torsion of every tube, with bending of the first one, two
    .. tubes together, with every drive, and with the memory of the learned force."""
    return _number(n, GROUPS, 0) * STAGES * width


@njit(nogil=True)
def _set(table, number, width, first, matrix):
    """Matrix ``number`` of the ``table``, for the lanes from ``first`` on."""
    for i in range(STAGES):
        for j in range(STAGES):
            table[(number * STAGES + j) * width + first + i] = matrix[i, j]


@njit(nogil=True, error_model="numpy")
def _set_inverse(table, number, width, first, C, stiffness, damping, work):
    """Matrix ``number``: the inverse of ``stiffness`` + ``damping`` C, by elimination without pivots. ``work`` (2, 4, 4) is written to.

    The leading minors of the sum are positive, for those of Radau's C are, so that no pivot vanishes.
    """
    matrix, inverse = work
    for i in range(STAGES):
        for j in range(STAGES):
            inverse[i, j] = 1.0 if i == j else 0.0
            matrix[i, j] = damping * C[i, j] + (stiffness if i == j else 0.0)
    for k in range(STAGES):
        scale = 1.0 / matrix[k, k]
        for j in range(STAGES):
            matrix[k, j] *= scale
            inverse[k, j] *= scale
        for i in range(STAGES):
            share = matrix[i, k]
            if i != k and share != 0.0:
                for j in range(STAGES):
                    matrix[i, j] -= share * matrix[k, j]
                    inverse[i, j] -= share * inverse[k, j]
    _set(table, number, width, first, inverse)


@njit(nogil=True, error_model="numpy")
def fill_coupling(kind, C, parameters, table, width, first):
    """Write C (4, 4) and the inverses at the ``parameters`` (NP,) into the flat ``table`` for the group of lanes from ``first`` on."""
    n, rows = kind.tubes, parameter_rows(kind.tubes)
    work = np.empty((2, STAGES, STAGES))
    _set(table, 0, width, first, C)
    stiffness, damping = 0.0, 0.0
    for i in range(n):
        give, loss = parameters[rows.torsional_stiffness + i], parameters[rows.torsion_damping + i]
        _set_inverse(table, _number(n, TORSION, i), width, first, C, give, loss, work)
        stiffness += parameters[rows.bending_stiffness + i]
        damping += parameters[rows.bending_damping + i]
        _set_inverse(table, _number(n, BENDING, i), width, first, C, stiffness, damping, work)
        inertia = parameters[rows.drive_compliance + i] * parameters[rows.drive_inertia + i]
        if inertia > 0.0:
            _set(table, _number(n, DRIVE, i), width, first, np.linalg.inv(np.eye(STAGES) + (C @ C) * inertia))
        else:
            _set_inverse(table, _number(n, DRIVE, i), width, first, C, 1.0, 0.0, work)
    memory = parameters[rows.learned_memory_time]
    _set_inverse(table, _number(n, MEMORY, 0), width, first, C, 1.0, memory, work)
