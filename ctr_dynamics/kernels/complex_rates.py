"""Time derivatives y_t = c0 y + h with a real or a complex c0 or with that of coupled stages, and the few equations in which c0 stands on the left.

A linearised problem with a complex c0 needs a real and an imaginary part of every perturbation. Both are lanes of one sweep: a batch of
``COMPLEX`` lanes holds eight real parts and behind them their eight imaginary parts. All arithmetic stays that of real lanes, each about the same
base case. Only the product with c0 mixes the two parts, so that the kernels are the same for both.
"""

import operator

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic, models, overload, register_model

from ctr_dynamics.kernels.coupling import Coupling, inverse_of
from ctr_dynamics.kernels.kinds import SIMD_WIDTH, Lanes
from ctr_dynamics.kernels.simd import SimdBatch, fma

COMPLEX = Lanes(2 * SIMD_WIDTH, 2 * SIMD_WIDTH)
# Passes between both axes of bending. Each leaves of the error the square of what couples the axes, by the stiffness: less than 1e-4 for the turning
# of damped tubes, and the square of the ovality for oval ones.
TURNING_PASSES, OVAL_PASSES = 2, 6
STAGE_PASSES = 12  # of coupled stages, whose inverse knows nothing of the ovality: each leaves a share of the error as large as that

INLINED = {"error_model": "numpy", "forceinline": True}


class ComplexRate(types.Type):
    """A complex c0, for batches of real and imaginary parts."""

    def __init__(self) -> None:
        super().__init__(name="ComplexRate")


@register_model(ComplexRate)
class _RateModel(models.StructModel):
    def __init__(self, dmm, fe_type):
        super().__init__(dmm, fe_type, [("real", types.float64), ("imag", types.float64)])


@intrinsic
def complex_rate(typingctx, real, imag):
    """c0 = ``real`` + i ``imag``."""

    def code(context, builder, signature, args):
        rate = cgutils.create_struct_proxy(signature.return_type)(context, builder)
        rate.real, rate.imag = args
        return rate._getvalue()

    return ComplexRate()(types.float64, types.float64), code


@intrinsic
def parts(typingctx, rate):
    """Real and imaginary part of a complex c0."""

    def code(context, builder, signature, args):
        proxy = cgutils.create_struct_proxy(signature.args[0])(context, builder, value=args[0])
        return context.make_tuple(builder, signature.return_type, [proxy.real, proxy.imag])

    return types.UniTuple(types.float64, 2)(rate), code


@intrinsic
def exchanged(typingctx, x):
    """A batch with its real and imaginary parts exchanged."""

    def code(context, builder, signature, args):
        half = x.width // 2
        order = [*range(half, x.width), *range(half)]
        mask = ir.Constant(ir.VectorType(ir.IntType(32), x.width), order)
        return builder.shuffle_vector(args[0], ir.Constant(args[0].type, ir.Undefined), mask)

    return x(x), code


@intrinsic
def turned(typingctx, x):
    """i times a batch: its imaginary parts with the sign changed, then its real parts."""

    def code(context, builder, signature, args):
        half = x.width // 2
        order = [*range(x.width + half, 2 * x.width), *range(half)]
        mask = ir.Constant(ir.VectorType(ir.IntType(32), x.width), order)
        return builder.shuffle_vector(args[0], builder.fneg(args[0]), mask)

    return x(x), code


@overload(operator.mul, jit_options=INLINED)
def _product(c0, x):
    if isinstance(c0, ComplexRate) and isinstance(x, SimdBatch):

        def product(c0, x):
            real, imag = parts(c0)
            return fma(turned(x), imag, x * real)

        return product
    return None


def squared(c0):
    """c0 c0."""
    return c0 * c0


@overload(squared, jit_options=INLINED)
def _squared(c0):
    if isinstance(c0, ComplexRate):

        def square(c0):
            real, imag = parts(c0)
            return complex_rate(real * real - imag * imag, 2.0 * real * imag)

        return square
    return lambda c0: c0 * c0


# ``number`` says which inverse of a :class:`~ctr_dynamics.kernels.coupling.Coupling` is meant.


def across(c0, damping, x, y):
    """``damping`` (x c0 y - y c0 x), nothing where c0 is real: the damping's part in the cross product of a curvature and its moment."""
    return 0.0


@overload(across, jit_options=INLINED)
def _across(c0, damping, x, y):
    if isinstance(c0, ComplexRate) or (isinstance(c0, Coupling) and c0.damped):
        return lambda c0, damping, x, y: damping * (x * (c0 * y) - y * (c0 * x))
    return across


def damped(c0, number, stiffness, damping, load):
    """The x of ``stiffness`` x + ``damping`` c0 x = ``load``."""
    return load * (1.0 / (stiffness + c0 * damping))


@overload(damped, jit_options=INLINED)
def _damped(c0, number, stiffness, damping, load):
    if isinstance(c0, ComplexRate):

        def solve(c0, number, stiffness, damping, load):
            real, imag = parts(c0)
            a, b = stiffness + damping * real, damping * imag
            other = exchanged(a)
            scale = 1.0 / (a * other + b * exchanged(b))
            return (other * scale) * load - (b * scale) * turned(load)

        return solve
    if isinstance(c0, Coupling):
        if c0.damped:
            return lambda c0, number, stiffness, damping, load: inverse_of(c0, number) * load
        return lambda c0, number, stiffness, damping, load: load * (1.0 / stiffness)
    return damped


def damped_twice(c0, number, inertia, load):
    """The x of x + ``inertia`` c0 c0 x = ``load``."""
    return damped(squared(c0), number, 1.0, inertia, load)


@overload(damped_twice, jit_options=INLINED)
def _damped_twice(c0, number, inertia, load):
    if isinstance(c0, Coupling):
        return lambda c0, number, inertia, load: inverse_of(c0, number) * load
    return damped_twice


def delayed(c0, number, time, load):
    """The x of x + ``time`` c0 x = ``load``."""
    return damped(c0, number, 1.0, time, load)


@overload(delayed, jit_options=INLINED)
def _delayed(c0, number, time, load):
    if isinstance(c0, Coupling):  # whether the tubes are damped or not
        return lambda c0, number, time, load: inverse_of(c0, number) * load
    return delayed


def plane_curvature(c0, number, stiffness, damping, turning, mx, my):
    """(u_x, u_y) of (``stiffness`` + ``damping`` c0) (u_x, u_y) + ``turning`` (u_y, -u_x) = (``mx``, ``my``)."""
    a = stiffness + c0 * damping
    d = 1.0 / (a * a + turning * turning)
    return (a * mx - turning * my) * d, (a * my + turning * mx) * d


@overload(plane_curvature, jit_options=INLINED)
def _plane_curvature(c0, number, stiffness, damping, turning, mx, my):
    if isinstance(c0, Coupling) and not c0.damped:
        return lambda c0, number, stiffness, damping, turning, mx, my: (
            mx * (1.0 / stiffness),
            my * (1.0 / stiffness),
        )
    if isinstance(c0, (ComplexRate, Coupling)):

        def iterate(c0, number, stiffness, damping, turning, mx, my):
            ux, uy = damped(c0, number, stiffness, damping, mx), damped(c0, number, stiffness, damping, my)
            for _ in range(TURNING_PASSES):
                ux = damped(c0, number, stiffness, damping, mx - turning * uy)
                uy = damped(c0, number, stiffness, damping, my + turning * ux)
            return ux, uy

        return iterate
    return plane_curvature


def oval_curvature(c0, number, stiffness, k11, k12, k22, damping, turning, mx, my):
    """The same with the stiffness [``k11``, ``k12``; ``k12``, ``k22``]; the inverse ``number`` is that with ``stiffness``."""
    a11, a12, a21, a22 = k11 + c0 * damping, k12 + turning, k12 - turning, k22 + c0 * damping
    d = 1.0 / (a11 * a22 - a12 * a21)
    return (a22 * mx - a12 * my) * d, (a11 * my - a21 * mx) * d


@overload(oval_curvature, jit_options=INLINED)
def _oval_curvature(c0, number, stiffness, k11, k12, k22, damping, turning, mx, my):
    if isinstance(c0, Coupling):

        def iterate_in_stages(c0, number, stiffness, k11, k12, k22, damping, turning, mx, my):
            ux, uy = damped(c0, number, stiffness, damping, mx), damped(c0, number, stiffness, damping, my)
            for _ in range(STAGE_PASSES):
                ux = damped(
                    c0, number, stiffness, damping, mx - (k11 - stiffness) * ux - (k12 + turning) * uy
                )
                uy = damped(
                    c0, number, stiffness, damping, my - (k22 - stiffness) * uy - (k12 - turning) * ux
                )
            return ux, uy

        def solve_undamped(c0, number, stiffness, k11, k12, k22, damping, turning, mx, my):
            d = 1.0 / (k11 * k22 - k12 * k12)
            return (k22 * mx - k12 * my) * d, (k11 * my - k12 * mx) * d

        return iterate_in_stages if c0.damped else solve_undamped
    if isinstance(c0, ComplexRate):

        def iterate(c0, number, stiffness, k11, k12, k22, damping, turning, mx, my):
            ux, uy = damped(c0, number, k11, damping, mx), damped(c0, number, k22, damping, my)
            for _ in range(OVAL_PASSES):
                ux = damped(c0, number, k11, damping, mx - (k12 + turning) * uy)
                uy = damped(c0, number, k22, damping, my - (k12 - turning) * ux)
            return ux, uy

        return iterate
    return oval_curvature
