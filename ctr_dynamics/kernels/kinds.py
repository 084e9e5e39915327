"""What the compiler knows of a robot and of the lanes of a sweep: constants that travel in the types of arguments.

A kernel is compiled once for each number of tubes, each physics and each number of lanes, so that the compiler can unroll its loops over the tubes
and keep intermediate results in registers. These numbers therefore must be part of an argument's *type*. :class:`RobotKind` and
:class:`Lanes` are plain objects in Python; in compiled code they hold nothing, and their attributes are constants::

    kind = RobotKind(2, Physics.PLAIN)

    @njit
    def stiffest(kind, stiffness):
        best = 0.0
        for i in range(kind.tubes):  # known when this is compiled
            best = max(best, stiffness[i])
        return best

A *lane* is one complete copy of the problem, with its own history, parameters, loads and unknowns. Lanes stand side by side as the last index of
every array; :mod:`ctr_dynamics.kernels.simd` says how they are computed.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.core.imputils import lower_constant
from numba.core.typing.templates import AbstractTemplate, AttributeTemplate, infer_global
from numba.extending import (
    NativeValue,
    infer_getattr,
    lower_getattr_generic,
    models,
    overload,
    register_model,
    unbox,
)

from ctr_dynamics.kernels.layout import state_rows, unknown_rows

SIMD_WIDTH = 8  # lanes of a batch: a line of the cache, and the longest vector of today's processors


class Physics(enum.Enum):
    """Which equations a robot needs.

    PLAIN: those of the paper. EXTENDED: also what effects of the robot file add (:mod:`ctr_dynamics.kernels.extended_physics`).
    """

    PLAIN = "plain"
    EXTENDED = "extended"


class KindType(types.Type):
    """Type of a :class:`RobotKind` or :class:`Lanes` in compiled code; ``constants`` are its attributes there."""

    def __init__(self, name: str, constants: dict[str, int], physics: Physics | None = None) -> None:
        self.constants, self.physics = constants, physics
        super().__init__(name=name)


class RobotKind:
    """Number of tubes and physics of a robot.

    Args:
        tubes: number of tubes.
        physics: which equations run.
    """

    def __init__(self, tubes: int, physics: Physics = Physics.PLAIN) -> None:
        self.tubes, self.physics = tubes, physics
        self._numba_type_ = KindType(f"RobotKind({tubes}, {physics.value})", {"tubes": tubes}, physics)


class Lanes:
    """A number of lanes, computed ``width`` at a time.

    Attributes:
        count: number of lanes.
        width: lanes of a SIMD batch; 1 where single numbers are computed. It divides ``count``.
    """

    def __init__(self, count: int, width: int) -> None:
        if count % width:
            raise ValueError(f"{count} lanes are no multiple of {width}")
        self.count, self.width = count, width
        self._numba_type_ = KindType(f"Lanes({count}, {width})", {"count": count, "width": width})

    def __repr__(self) -> str:
        return self._numba_type_.name


ONE_LANE = Lanes(1, 1)
ONE_BATCH = Lanes(SIMD_WIDTH, SIMD_WIDTH)


def lanes_for(count: int) -> Lanes:
    """Lanes with room for ``count``: one, or whole batches of ``SIMD_WIDTH``."""
    return ONE_LANE if count == 1 else Lanes(SIMD_WIDTH * math.ceil(count / SIMD_WIDTH), SIMD_WIDTH)


def lanes_free(count: int) -> int:
    """Lanes that :func:`lanes_for` gives beyond ``count``."""
    return lanes_for(count).count - count


def unknown_lanes(kind: RobotKind) -> Lanes:
    """Lanes with room for a base case and one perturbation of each unknown of the shooting problem."""
    return lanes_for(1 + unknown_rows(kind.tubes).size)


def first_cut_row(kind: RobotKind) -> int:
    """First row of the state that is unknown at a cut of the mesh: without the position, where nothing at the tip depends on it."""
    return 0 if kind.physics is Physics.EXTENDED else state_rows(kind.tubes).quaternion


def cut_size(kind: RobotKind) -> int:
    """Rows of the state that are unknown at a cut."""
    return state_rows(kind.tubes).size - first_cut_row(kind)


def segment_lanes(kind: RobotKind) -> Lanes:
    """Lanes with room for a base case and one perturbation of each unknown row of a state, of all segments at once."""
    return lanes_for(1 + cut_size(kind))


def by_physics(plain: Any, extended: Any) -> Callable[..., Any]:
    """A function for kernels whose first argument is a :class:`RobotKind`: the kernel ``plain`` or ``extended``, chosen when it is compiled."""

    def for_compiled_code(*args: Any) -> Any:
        raise NotImplementedError("for compiled code only")

    def kernel(kind: Any) -> Any:
        return extended if kind.physics is Physics.EXTENDED else plain

    class Choice(AbstractTemplate):
        key = for_compiled_code

        def generic(self, args: Any, kws: Any) -> Any:
            return types.Dispatcher(kernel(args[0])).get_call_type(self.context, args, kws)

        def get_impl_key(self, sig: Any) -> Any:
            return kernel(sig.args[0]).get_overload(sig)

    infer_global(for_compiled_code, types.Function(Choice))
    return for_compiled_code


# From here on: what numba needs to know of these types.


@register_model(KindType)
class _NoData(models.OpaqueModel):
    """Nothing is passed: the type says all."""


@unbox(KindType)
def _unbox(kind: Any, value: Any, context: Any) -> NativeValue:
    return NativeValue(context.context.get_dummy_value())


@lower_constant(KindType)
def _global(context: Any, builder: Any, kind: Any, value: Any) -> Any:
    return context.get_dummy_value()


@infer_getattr
class _Attributes(AttributeTemplate):
    key = KindType

    def generic_resolve(self, kind: Any, name: str) -> Any:  # type: ignore[override]
        return types.intp if name in kind.constants else None


@lower_getattr_generic(KindType)
def _attribute(context: Any, builder: Any, kind: Any, value: Any, name: str) -> Any:
    return ir.Constant(ir.IntType(64), kind.constants[name])


def _of_kind(function: Callable[[RobotKind], Any]) -> None:
    """In compiled code a constant."""

    @overload(function, strict=False)
    def of_kind(kind: Any) -> Any:
        value = function(RobotKind(kind.constants["tubes"], kind.physics))
        return lambda kind: value


for _function in (unknown_lanes, first_cut_row, cut_size, segment_lanes):
    _of_kind(_function)
