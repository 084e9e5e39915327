"""Sine and cosine of one number or of a SIMD batch."""

import math

from ctr_dynamics.kernels.compiler import njit
from ctr_dynamics.kernels.simd import fma, where_above

_TWO_OVER_PI = 2.0 / math.pi
_PIO2_HI = 1.57079632679489655800e00
_PIO2_LO = 6.12323399573676603587e-17


@njit(forceinline=True, error_model="numpy")
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
