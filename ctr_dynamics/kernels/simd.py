"""Numbers of several lanes at once, as types of the compiler: kernels are written for one number and compiled for one, two, four or eight.

Why. A sweep along the tubes is one long chain of dependent operations: the processor mostly waits for its own last result. So it can compute other
copies of the problem meanwhile, almost for nothing. The Jacobian (one perturbed unknown in each copy), the tangent of a step (one perturbed
parameter in each copy) and two runs of the estimator are such copies. Each is a *lane* (:mod:`ctr_dynamics.kernels.kinds`).

How. In memory the lane is the last index of every array, so that the same quantity of neighbouring lanes lies side by side. A
:class:`SimdBatch` is a number of the compiler's that holds one such quantity for two, four or eight lanes in one vector register. Arithmetic
on it is plain IEEE arithmetic on every lane, so that a lane gives the same bits alone and in company. A :class:`RowView` is a view of a flat array
whose element ``r`` is the number, or the batch, of row ``r``::

    @njit
    def double(lanes, values):                       # values: (rows, lanes.count), flat
        for first in range(0, lanes.count, lanes.width):
            x = view(lanes, values, first, lanes.count)
            for r in range(len(x)):
                x[r] = 2.0 * x[r]                    # one number, or eight at once

    double(ONE_LANE, np.ones(5))
    double(Lanes(16, 8), np.ones(5 * 16))            # two batches of eight

Why not loops over the lanes of plain arrays. The compiler would have to prove that the rows do not overlap and to keep the inner loops of some
hundred statements vectorised and in registers; views count no references, check no bounds and leave nothing to prove. A :func:`local_copy` of the
workspace lies on the stack of the function that makes it: where all its indices are known to the compiler, it becomes registers.

No fast-math flags: which copy of a kernel runs depends on what was compiled before, and copies would round differently. Fused multiplications
are asked for by name (:func:`fma`), and are then the same in every copy.
"""

import math
import operator

import numba
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import (
    intrinsic,
    lower_builtin,
    lower_cast,
    models,
    register_model,
    type_callable,
)

from ctr_dynamics.kernels.kinds import SIMD_WIDTH
from ctr_dynamics.kernels.layout import workspace_rows

DOUBLE = ir.DoubleType()
INDEX = ir.IntType(64)


class SimdBatch(types.Type):
    """``width`` float64 numbers, one of each lane."""

    def __init__(self, width: int) -> None:
        self.width = width
        super().__init__(name=f"SimdBatch({width})")

    def can_convert_from(self, typingctx, other):
        """A number is the same in every lane."""
        return numba.core.typeconv.Conversion.safe if isinstance(other, types.Number) else None

    def unify(self, typingctx, other):
        """With a number it becomes a batch."""
        return self if isinstance(other, types.Number) else None


class RowView(types.Type):
    """View of a flat array: element ``r`` is the number or batch of row ``r``."""

    def __init__(self, number: types.Type) -> None:
        self.number = number
        super().__init__(name=f"RowView({number})")


@register_model(SimdBatch)
class _BatchModel(models.PrimitiveModel):
    def __init__(self, dmm, fe_type):
        super().__init__(dmm, fe_type, _vector(fe_type))


@register_model(RowView)
class _ViewModel(models.StructModel):
    def __init__(self, dmm, fe_type):
        members = [
            ("data", types.CPointer(types.float64)),
            ("stride", types.intp),
            ("count", types.intp),
        ]
        super().__init__(dmm, fe_type, members)


def _vector(number):
    return ir.VectorType(DOUBLE, number.width) if isinstance(number, SimdBatch) else DOUBLE


def _number_of(lanes):
    """Type of the numbers of the type ``lanes``: float64, or batches."""
    width = lanes.constants["width"]
    return types.float64 if width == 1 else SimdBatch(width)


def _widened(context, builder, value, source, target):
    """``value`` in every lane of ``target``, if it is a single number."""
    if source == target:
        return value
    value = context.cast(builder, value, source, types.float64)
    if not isinstance(target, SimdBatch):
        return value
    kind = _vector(target)
    first = builder.insert_element(ir.Constant(kind, ir.Undefined), value, ir.Constant(ir.IntType(32), 0))
    mask = ir.Constant(ir.VectorType(ir.IntType(32), target.width), [0] * target.width)
    return builder.shuffle_vector(first, ir.Constant(kind, ir.Undefined), mask)


@lower_cast(types.Number, SimdBatch)
def _widen(context, builder, source, target, value):
    return _widened(context, builder, value, source, target)


def _common(kinds):
    """The batch type among operands of one such type and numbers; None for anything else."""
    batches = {kind for kind in kinds if isinstance(kind, SimdBatch)}
    plain = all(isinstance(kind, (SimdBatch, types.Number)) for kind in kinds)
    return batches.pop() if plain and len(batches) == 1 else None


def _binary(function, instruction):
    @type_callable(function)
    def callable_of(context):
        def typer(a, b):
            return _common((a, b))

        return typer

    def lower(context, builder, signature, args):
        pairs = zip(args, signature.args, strict=True)
        a, b = (_widened(context, builder, v, kind, signature.return_type) for v, kind in pairs)
        return getattr(builder, instruction)(a, b)

    for kinds in ((SimdBatch, SimdBatch), (SimdBatch, types.Number), (types.Number, SimdBatch)):
        lower_builtin(function, *kinds)(lower)


def _llvm(builder, name, number, args):
    """Call of LLVM's function ``name`` for numbers of one type."""
    kind = _vector(number)
    suffix = f"v{number.width}f64" if isinstance(number, SimdBatch) else "f64"
    declared = ir.FunctionType(kind, [kind] * len(args))
    return builder.call(
        cgutils.get_or_insert_function(builder.module, declared, f"llvm.{name}.{suffix}"), args
    )


def _unary(function):
    @type_callable(function)
    def callable_of(context):
        def typer(a):
            return _common((a,))

        return typer


def _elementary(function, name):
    _unary(function)

    def lower(context, builder, signature, args):
        return _llvm(builder, name, signature.return_type, args)

    lower_builtin(function, SimdBatch)(lower)


for _plain, _in_place, _instruction in (
    (operator.add, operator.iadd, "fadd"),
    (operator.sub, operator.isub, "fsub"),
    (operator.mul, operator.imul, "fmul"),
    (operator.truediv, operator.itruediv, "fdiv"),
):
    for _function in (_plain, _in_place):
        _binary(_function, _instruction)
for _function, _name in ((math.sqrt, "sqrt"), (math.floor, "floor"), (math.exp, "exp")):
    _elementary(_function, _name)
_unary(operator.neg)


@lower_builtin(operator.neg, SimdBatch)
def _negative(context, builder, signature, args):
    return builder.fneg(args[0])


@intrinsic
def fma(typingctx, a, b, c):
    """a b + c, rounded once."""
    kind = _common((a, b, c)) or types.float64

    def code(context, builder, signature, args):
        pairs = zip(args, signature.args, strict=True)
        values = [_widened(context, builder, v, source, kind) for v, source in pairs]
        return _llvm(builder, "fma", kind, values)

    return kind(a, b, c), code


@intrinsic
def where_above(typingctx, a, b, x, y):
    """``x`` in the lanes where a > b, else ``y``."""
    kind = _common((a, b, x, y)) or types.float64

    def code(context, builder, signature, args):
        pairs = zip(args, signature.args, strict=True)
        a, b, x, y = (_widened(context, builder, v, source, kind) for v, source in pairs)
        return builder.select(builder.fcmp_ordered(">", a, b), x, y)

    return kind(a, b, x, y), code


@intrinsic
def largest(typingctx, a):
    """Largest number among the lanes; of one lane its own. Not for NaN."""

    def code(context, builder, signature, args):
        value = args[0]
        if not isinstance(a, SimdBatch):
            return value
        best = builder.extract_element(value, ir.Constant(ir.IntType(32), 0))
        for lane in range(1, a.width):
            other = builder.extract_element(value, ir.Constant(ir.IntType(32), lane))
            best = builder.select(builder.fcmp_ordered(">", other, best), other, best)
        return best

    return types.float64(a), code


def _align_stack(builder, kind):
    """Let the function's stack begin where a batch of the LLVM type ``kind`` may lie in one line of the cache.

    LLVM settles that before it knows that batches will be put aside there: an object that it cannot remove tells it.
    """
    anchor = cgutils.alloca_once(builder, kind)
    anchor.align = 8 * SIMD_WIDTH
    taken = ir.FunctionType(ir.VoidType(), [anchor.type])
    builder.asm(taken, "", "r", [anchor], side_effect=True)


def _view(context, builder, kind, data, stride, count):
    view = cgutils.create_struct_proxy(kind)(context, builder)
    view.data, view.stride, view.count = data, stride, count
    return view._getvalue()


@intrinsic
def view(typingctx, lanes, array, first, stride):
    """View of the flat float64 ``array`` from its element ``first`` on, ``stride`` elements a row, in batches of ``lanes.width``; of a width of 1 the
    stride is 1."""
    kind = RowView(_number_of(lanes))

    def code(context, builder, signature, args):
        _, values, first, stride = args
        array_of = context.make_array(array)(context, builder, values)
        size = builder.sdiv(array_of.nitems, stride)
        return _view(context, builder, kind, builder.gep(array_of.data, [first]), stride, size)

    return kind(lanes, array, types.intp, types.intp), code


@intrinsic
def column_view(typingctx, table, first):
    """View of columns ``first`` to ``first`` + 7 of ``table`` (rows, columns), whose columns lie side by side, as one batch a row."""
    kind = RowView(SimdBatch(SIMD_WIDTH))

    def code(context, builder, signature, args):
        table_of = context.make_array(table)(context, builder, args[0])
        stride = builder.sdiv(builder.extract_value(table_of.strides, 0), ir.Constant(INDEX, 8))
        count = builder.extract_value(table_of.shape, 0)
        return _view(context, builder, kind, builder.gep(table_of.data, [args[1]]), stride, count)

    return kind(table, types.intp), code


@intrinsic
def local_copy(typingctx, kind, W):
    """Copy of the workspace ``W`` on the stack of the calling function; rows that nobody reads are not copied."""
    count = workspace_rows(kind.constants["tubes"]).size

    def code(context, builder, signature, args):
        width = W.number.width if isinstance(W.number, SimdBatch) else 1
        data = cgutils.alloca_once(builder, DOUBLE, size=ir.Constant(INDEX, count * width))
        if isinstance(W.number, SimdBatch):
            _align_stack(builder, _vector(W.number))
        copy = _view(context, builder, W, data, ir.Constant(INDEX, width), ir.Constant(INDEX, count))
        for r in range(count):  # one by one, so that every index is a constant
            row = ir.Constant(INDEX, r)
            value = builder.load(_place(context, builder, W, args[1], row, types.intp), align=8)
            builder.store(value, _place(context, builder, W, copy, row, types.intp), align=8)
        return copy

    return W(kind, W), code


def _place(context, builder, kind, view, index, index_kind):
    """Pointer to an element of a view."""
    proxy = cgutils.create_struct_proxy(kind)(context, builder, value=view)
    index = context.cast(builder, index, index_kind, types.intp)
    if isinstance(kind.number, SimdBatch):  # single numbers lie side by side
        index = builder.mul(index, proxy.stride)
    pointer = builder.gep(proxy.data, [index])
    return builder.bitcast(pointer, _vector(kind.number).as_pointer())


@type_callable(operator.getitem)
def _type_getitem(context):
    def typer(view, index):
        if isinstance(view, RowView) and isinstance(index, types.Integer):
            return view.number
        return None

    return typer


@lower_builtin(operator.getitem, RowView, types.Integer)
def _getitem(context, builder, signature, args):
    kind, index_kind = signature.args
    return builder.load(_place(context, builder, kind, args[0], args[1], index_kind), align=8)


@type_callable(operator.setitem)
def _type_setitem(context):
    def typer(view, index, value):
        fits = isinstance(view, RowView) and isinstance(index, types.Integer)
        if fits and (value == view.number or isinstance(value, types.Number)):
            return types.none
        return None

    return typer


@lower_builtin(operator.setitem, RowView, types.Integer, SimdBatch)
@lower_builtin(operator.setitem, RowView, types.Integer, types.Number)
def _setitem(context, builder, signature, args):
    kind, index_kind, source = signature.args
    place = _place(context, builder, kind, args[0], args[1], index_kind)
    builder.store(_widened(context, builder, args[2], source, kind.number), place, align=8)
    return context.get_dummy_value()


@type_callable(len)
def _type_len(context):
    def typer(view):
        return types.intp if isinstance(view, RowView) else None

    return typer


@lower_builtin(len, RowView)
def _len(context, builder, signature, args):
    return cgutils.create_struct_proxy(signature.args[0])(context, builder, value=args[0]).count
