"""Numbers of several lanes at once, as a type of the compiler: kernels are written for one number and compiled for one, two, four or eight.

A *lane* is one complete copy of the problem. A :class:`Pack` holds the same quantity of up to eight lanes in one vector of the processor (or more,
where they are shorter); arithmetic on it is plain IEEE arithmetic on every lane. :class:`Rows` is a view of a flat array whose element ``r``
is one number, or one pack, of row ``r``. Views count no references and check no bounds. A :func:`local_copy` of the workspace lies on the
stack of the function that makes it: where all its indices are known to the compiler, it becomes registers.

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

from ctr_dynamics.kernels.compiler import njit
from ctr_dynamics.kernels.workspace import workspace_rows

PACK = 8  # lanes of a pack: a line of the cache, and the longest vector of today's processors
DOUBLE = ir.DoubleType()
INDEX = ir.IntType(64)

_TWO_OVER_PI = 2.0 / math.pi
_PIO2_HI = 1.57079632679489655800e00
_PIO2_LO = 6.12323399573676603587e-17


class Pack(types.Type):
    """``width`` float64 numbers, one of each lane."""

    def __init__(self, width: int) -> None:
        self.width = width
        super().__init__(name=f"Pack({width})")

    def can_convert_from(self, typingctx, other):
        """A number is the same in every lane."""
        return numba.core.typeconv.Conversion.safe if isinstance(other, types.Number) else None

    def unify(self, typingctx, other):
        """With a number it becomes a pack."""
        return self if isinstance(other, types.Number) else None


class Rows(types.Type):
    """View of a flat array: element ``r`` is the number or pack of row ``r``."""

    def __init__(self, number: types.Type) -> None:
        self.number = number
        super().__init__(name=f"Rows({number})")


@register_model(Pack)
class _PackModel(models.PrimitiveModel):
    def __init__(self, dmm, fe_type):
        super().__init__(dmm, fe_type, _vector(fe_type))


@register_model(Rows)
class _RowsModel(models.StructModel):
    def __init__(self, dmm, fe_type):
        members = [
            ("data", types.CPointer(types.float64)),
            ("stride", types.intp),
            ("count", types.intp),
        ]
        super().__init__(dmm, fe_type, members)


def _vector(number):
    return ir.VectorType(DOUBLE, number.width) if isinstance(number, Pack) else DOUBLE


def _number_of(lanes):
    """Type of the numbers of a block of lanes: float64 for an empty lane tuple, else packs."""
    if not len(lanes):
        return types.float64
    return Pack(len(lanes) if isinstance(lanes.dtype, types.Boolean) else PACK)


def _widened(context, builder, value, source, target):
    """``value`` in every lane of ``target``, if it is a single number."""
    if source == target:
        return value
    value = context.cast(builder, value, source, types.float64)
    if not isinstance(target, Pack):
        return value
    kind = _vector(target)
    first = builder.insert_element(ir.Constant(kind, ir.Undefined), value, ir.Constant(ir.IntType(32), 0))
    mask = ir.Constant(ir.VectorType(ir.IntType(32), target.width), [0] * target.width)
    return builder.shuffle_vector(first, ir.Constant(kind, ir.Undefined), mask)


@lower_cast(types.Number, Pack)
def _widen(context, builder, source, target, value):
    return _widened(context, builder, value, source, target)


def _common(kinds):
    """The pack among operands of one pack type and numbers; None for anything else."""
    packs = {kind for kind in kinds if isinstance(kind, Pack)}
    plain = all(isinstance(kind, (Pack, types.Number)) for kind in kinds)
    return packs.pop() if plain and len(packs) == 1 else None


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

    for kinds in ((Pack, Pack), (Pack, types.Number), (types.Number, Pack)):
        lower_builtin(function, *kinds)(lower)


def _llvm(builder, name, number, args):
    """Call of LLVM's function ``name`` for numbers of one type."""
    kind = _vector(number)
    suffix = f"v{number.width}f64" if isinstance(number, Pack) else "f64"
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

    lower_builtin(function, Pack)(lower)


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


@lower_builtin(operator.neg, Pack)
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
        if not isinstance(a, Pack):
            return value
        best = builder.extract_element(value, ir.Constant(ir.IntType(32), 0))
        for lane in range(1, a.width):
            other = builder.extract_element(value, ir.Constant(ir.IntType(32), lane))
            best = builder.select(builder.fcmp_ordered(">", other, best), other, best)
        return best

    return types.float64(a), code


def _align_stack(builder, kind):
    """Let the function's stack begin where a pack of the LLVM type ``kind`` may lie in one line of the cache.

    LLVM settles that before it knows that packs will be put aside there: an object that it cannot remove tells it.
    """
    anchor = cgutils.alloca_once(builder, kind)
    anchor.align = 8 * PACK
    taken = ir.FunctionType(ir.VoidType(), [anchor.type])
    builder.asm(taken, "", "r", [anchor], side_effect=True)


def _view(context, builder, kind, data, stride, count):
    view = cgutils.create_struct_proxy(kind)(context, builder)
    view.data, view.stride, view.count = data, stride, count
    return view._getvalue()


@intrinsic
def rows(typingctx, lanes, array, first, stride):
    """View of the flat float64 ``array`` from its element ``first`` on, ``stride`` elements a row, in packs of the lane tuple ``lanes``;
    for the empty one the stride is 1."""
    kind = Rows(_number_of(lanes))

    def code(context, builder, signature, args):
        _, values, first, stride = args
        array_of = context.make_array(array)(context, builder, values)
        size = builder.sdiv(array_of.nitems, stride)
        return _view(context, builder, kind, builder.gep(array_of.data, [first]), stride, size)

    return kind(lanes, array, types.intp, types.intp), code


@intrinsic
def columns(typingctx, table, first):
    """View of columns ``first`` to ``first`` + 7 of ``table`` (rows, columns), whose columns lie side by side, as one pack a row."""
    kind = Rows(Pack(PACK))

    def code(context, builder, signature, args):
        table_of = context.make_array(table)(context, builder, args[0])
        stride = builder.sdiv(builder.extract_value(table_of.strides, 0), ir.Constant(INDEX, 8))
        count = builder.extract_value(table_of.shape, 0)
        return _view(context, builder, kind, builder.gep(table_of.data, [args[1]]), stride, count)

    return kind(table, types.intp), code


@intrinsic
def local_copy(typingctx, tubes, W):
    """Copy of the workspace ``W`` on the stack of the calling function; rows that nobody reads are not copied."""
    count = workspace_rows(len(tubes))

    def code(context, builder, signature, args):
        width = W.number.width if isinstance(W.number, Pack) else 1
        data = cgutils.alloca_once(builder, DOUBLE, size=ir.Constant(INDEX, count * width))
        if isinstance(W.number, Pack):
            _align_stack(builder, _vector(W.number))
        copy = _view(context, builder, W, data, ir.Constant(INDEX, width), ir.Constant(INDEX, count))
        for r in range(count):  # one by one, so that every index is a constant
            row = ir.Constant(INDEX, r)
            value = builder.load(_place(context, builder, W, args[1], row, types.intp), align=8)
            builder.store(value, _place(context, builder, W, copy, row, types.intp), align=8)
        return copy

    return W(tubes, W), code


def _place(context, builder, kind, view, index, index_kind):
    """Pointer to an element of a view."""
    proxy = cgutils.create_struct_proxy(kind)(context, builder, value=view)
    index = context.cast(builder, index, index_kind, types.intp)
    if isinstance(kind.number, Pack):  # single numbers lie side by side
        index = builder.mul(index, proxy.stride)
    pointer = builder.gep(proxy.data, [index])
    return builder.bitcast(pointer, _vector(kind.number).as_pointer())


@type_callable(operator.getitem)
def _type_getitem(context):
    def typer(view, index):
        if isinstance(view, Rows) and isinstance(index, types.Integer):
            return view.number
        return None

    return typer


@lower_builtin(operator.getitem, Rows, types.Integer)
def _getitem(context, builder, signature, args):
    kind, index_kind = signature.args
    return builder.load(_place(context, builder, kind, args[0], args[1], index_kind), align=8)


@type_callable(operator.setitem)
def _type_setitem(context):
    def typer(view, index, value):
        fits = isinstance(view, Rows) and isinstance(index, types.Integer)
        if fits and (value == view.number or isinstance(value, types.Number)):
            return types.none
        return None

    return typer


@lower_builtin(operator.setitem, Rows, types.Integer, Pack)
@lower_builtin(operator.setitem, Rows, types.Integer, types.Number)
def _setitem(context, builder, signature, args):
    kind, index_kind, source = signature.args
    place = _place(context, builder, kind, args[0], args[1], index_kind)
    builder.store(_widened(context, builder, args[2], source, kind.number), place, align=8)
    return context.get_dummy_value()


@type_callable(len)
def _type_len(context):
    def typer(view):
        return types.intp if isinstance(view, Rows) else None

    return typer


@lower_builtin(len, Rows)
def _len(context, builder, signature, args):
    return cgutils.create_struct_proxy(signature.args[0])(context, builder, value=args[0]).count


@njit(cache=True, forceinline=True, error_model="numpy")
def sincos(x):
    """(sin x, cos x) by polynomials, without library calls; error below 1e-12 for abs(x) < 1e4."""
    k = math.floor(fma(x, _TWO_OVER_PI, 0.5))
    r = fma(k, -_PIO2_LO, fma(k, -_PIO2_HI, x))
    z = r * r
    zz = z * z
    # even and odd powers apart (Estrin): half as many operations wait for each other
    s = fma(
        fma(
            zz,
            fma(1.58962301576546568060e-10, z, -2.50507477628578072866e-8),
            fma(2.75573136213857245213e-6, z, -1.98412698295895385996e-4),
        ),
        zz,
        fma(8.33333333332211858878e-3, z, -1.66666666666666307295e-1),
    )
    s = fma(r * z, s, r)
    c = fma(
        fma(
            zz,
            fma(-1.13585365213876817300e-11, z, 2.08757008419747316778e-9),
            fma(-2.75573141792967388112e-7, z, 2.48015872888517045348e-5),
        ),
        zz,
        fma(-1.38888888888730564116e-3, z, 4.16666666666665929218e-2),
    )
    c = fma(zz, c, fma(-0.5, z, 1.0))
    half = math.floor(0.5 * k)
    odd = fma(-2.0, half, k)  # 0 or 1: odd quadrants swap sine and cosine
    sign = fma(
        -2.0, fma(-2.0, math.floor(0.5 * half), half), 1.0
    )  # the cosine's sign changes every two quadrants
    return sign * where_above(odd, 0.5, c, s), sign * where_above(odd, 0.5, -s, c)
