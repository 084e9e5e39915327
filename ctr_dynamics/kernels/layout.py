"""Where every number of the kernels lies: declared once here, read by Python and compiled into the kernels.

Each block of numbers is a list of groups; a group has a number of rows that may depend on the number of tubes. ``parameter_rows(n)`` and its
sisters give the rows of a block for ``n`` tubes::

    rows = parameter_rows(2)
    rows.beta        # first row of the group, 26
    rows["beta"]     # its rows, slice(26, 28)
    rows.size        # of the whole block

In compiled code ``rows.beta`` and ``rows.size`` work in the same way and cost nothing: where the number of tubes is known to the compiler, so is
the row.
"""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numba import types
from numba.core.typing.templates import AttributeTemplate
from numba.extending import (
    infer_getattr,
    lower_builtin,
    lower_getattr_generic,
    models,
    register_model,
    type_callable,
)
from numpy.typing import ArrayLike

from ctr_dynamics.kernels.compiler import njit

# Slots of the stored fields; the rates of a step's stages follow from RATES on.
Y_NOW, Y_BEFORE, RATE_NOW, RATES = 0, 1, 2, 3


class Group(NamedTuple):
    """Rows of one quantity: ``fixed`` of them, and ``per_tube`` more for each tube."""

    name: str
    fixed: int = 0
    per_tube: int = 0


def total(groups: tuple[Group, ...]) -> tuple[int, int]:
    """Rows of all ``groups`` together, as (fixed, per tube)."""
    return sum(g.fixed for g in groups), sum(g.per_tube for g in groups)


# State of a cross-section. Position and quaternion are in the base frame; velocity, angular velocity, force and moments are components in the
# frame of tube 1 (the force is R_1^T times the paper's n). theta and gamma begin with tube 2.
STATE = (
    Group("position", 3),
    Group("quaternion", 4),
    Group("velocity", 3),
    Group("angular_velocity", 3),
    Group("force", 3),
    Group("moment_xy", 2),
    Group("moment_z", 0, 1),
    Group("theta", -1, 1),
    Group("gamma", -1, 1),
)

# Fields at one point along the tubes: what carries a history. u of tube 1, then u_z of the others; gamma begins with tube 2.
FIELDS = (
    Group("velocity", 3),
    Group("angular_velocity", 3),
    Group("curvature_xy", 2),
    Group("curvature_z", 0, 1),
    Group("gamma", -1, 1),
)

# Fields of the base part: psi_t and u_z of every tube at every point behind the plate, then these.
BASE_ENDS = (
    Group("drive_angle", 0, 1),  # by which each drive gives way, rad
    Group("tilt", 0, 2),  # (x, y) at each tube's end, rad
    Group("beta_rate", 0, 1),  # m/s
    Group("memory", 3),  # low-pass of the tip's position, m
)

# Unknowns of the shooting problem: torque of each tube at its actuator, force and moment at s = 0+.
UNKNOWNS = (Group("torque", 0, 1), Group("force", 3), Group("moment_xy", 2))

# Its residual: balance of force and moment at the tip and of the moment m_z at each tube's end.
RESIDUAL = (Group("force", 3), Group("moment_xy", 2), Group("moment_z", 0, 1))

LEARNED_DEGREE = 4  # of the polynomial potential of a learned force


def potential_terms(degree: int) -> int:
    """Number of monomials in three variables from degree two up to ``degree``."""
    return (degree + 1) * (degree + 2) * (degree + 3) // 6 - 4


# Parameters, SI units. ``precurvature`` is a factor on u*; ``gravity``, ``force`` and ``torque`` are in ``ctr_base``.
PLAIN_PARAMETERS = (
    Group("bending_stiffness", 0, 1),
    Group("torsional_stiffness", 0, 1),
    Group("mass_per_length", 0, 1),
    Group("inertia_per_length", 0, 1),
    Group("bending_damping", 0, 1),
    Group("torsion_damping", 0, 1),
    Group("precurvature", 0, 1),
    Group("body_mass", 0, 1),
    Group("body_inertia_x", 0, 1),
    Group("body_inertia_y", 0, 1),
    Group("body_inertia_z", 0, 1),
    Group("alpha", 0, 1),
    Group("alpha_rate", 0, 1),
    Group("beta", 0, 1),
    Group("gravity", 3),
    Group("force", 3),
    Group("torque", 3),
    Group("tube_coulomb", 1),
    Group("tube_viscous", 1),
    Group("epsilon", 1),
    Group("base_coulomb", 1),
    Group("base_viscous", 1),
)
EXTENDED_PARAMETERS = (  # read by the extended physics only
    Group("stribeck_excess", 1),
    Group("stribeck_inverse_speed", 1),
    Group("overlap_friction", 1),
    Group("drag_linear", 1),
    Group("drag_quadratic", 1),
    Group("clearance", 1),
    Group("clearance_moment", 1),
    Group("spring_stiffness", 1),
    Group("spring_damping", 1),
    Group("spring_force", 3),
    Group("contact_stiffness", 1),
    Group("contact_normal", 3),
    Group("contact_offset", 1),
    Group("insertion_velocity", 1),
    Group("clearance_kinematics", 1),
    Group("oval_cos", 0, 1),
    Group("oval_sin", 0, 1),
    Group("softening", 0, 1),
    Group("drive_compliance", 0, 1),
    Group("drive_inertia", 0, 1),
    Group("beta_rate", 0, 1),
    # learned force on the tip: in N, of position over a length and velocity over a speed
    Group("learned_origin", 3),
    Group("learned_inverse_length", 1),
    Group("learned_inverse_speed", 1),
    Group("learned_dry_speed", 1),
    Group("learned_memory_time", 1),
    Group("learned_potential", potential_terms(LEARNED_DEGREE)),
    Group("learned_damping", 6),  # xx, yy, zz, xy, xz, yz
    Group("learned_drag", 3),
    Group("learned_dry", 3),
    Group("learned_memory", 3),
    Group("learned_sine", 0, 3),
    Group("learned_cosine", 0, 3),
    Group("learned_slide", 0, 3),
)
PARAMETERS = (*PLAIN_PARAMETERS, *EXTENDED_PARAMETERS)

# Inputs of a time stage, each in the parameters under the same name; the plain physics has no beta rate.
INPUTS = (
    Group("alpha", 0, 1),
    Group("alpha_rate", 0, 1),
    Group("beta", 0, 1),
    Group("force", 3),
    Group("torque", 3),
    Group("beta_rate", 0, 1),
)

# Workspace of a sweep. Every number that the equations touch lies there, so that the compiler can keep them in registers.
WORKSPACE = (
    Group("state", *total(STATE)),  # at the current node
    Group("stage", *total(STATE)),  # at the current Runge-Kutta stage
    Group("slope", *total(STATE)),  # its derivative by arc length
    Group("increment", *total(STATE)),  # accumulated over the stages
    Group("history", *total(FIELDS)),  # part of the fields' time derivatives, at the current point
    Group("fields", *total(FIELDS)),  # at the current point
    # intermediate results; some functions use the rows from here on for their own
    Group("curvature", 3),  # u of tube 1
    Group("curvature_rate", 3),
    Group("sums", 4),  # over the tubes
    Group("weight", 3),  # gravity in the frame of tube 1, R_1^T g
    Group("tube", 0, 7),  # seven rows a tube
    *PARAMETERS,
    Group("near_moments", 0, 2),  # bending moment (x, y) of every tube on the near side of a transition
    Group("far_moments", 0, 2),  # on its far side
    Group("powers", 3 * (LEARNED_DEGREE + 1)),  # of the tip's position, for the learned force
    # motion of the grid in the extended physics
    Group("tube_speed", 0, 1),  # beta_t, times the insertion factor
    Group("tube_acceleration", 0, 1),
    Group("grid_speed", 1),  # s_t at the current point
    Group("grid_acceleration", 1),
    Group("stretching", 1),  # its derivative by arc length
    Group("speed_near", 1),  # at the section's beginning
    Group("speed_far", 1),  # at its end
    Group("acceleration_near", 1),
    Group("acceleration_far", 1),
)


class RowNumbers:
    """Rows of one block for ``n`` tubes; ``rows.<group>`` is a group's first row and ``rows.size`` their number.

    Args:
        groups: of the block, in their order.
        n: number of tubes.
    """

    def __init__(self, groups: tuple[Group, ...], n: int) -> None:
        self.n = n
        self._slices: dict[str, slice] = {}
        row = 0
        for name, fixed, per_tube in groups:
            self._slices[name] = slice(row, row + fixed + per_tube * n)
            row += fixed + per_tube * n
        self.size = row

    def __getattr__(self, name: str) -> int:
        try:
            return int(self.__dict__["_slices"][name].start)
        except KeyError:
            raise AttributeError(name) from None

    def __getitem__(self, name: str) -> slice:
        return self._slices[name]

    @property
    def names(self) -> tuple[str, ...]:
        """The groups in their order."""
        return tuple(self._slices)

    def rows(self, name: str) -> np.ndarray:
        """Row numbers of ``name``."""
        return np.arange(self.size)[self._slices[name]]

    def pack(self, **values: ArrayLike) -> np.ndarray:
        """Block (size,) from values by name; those not given are 0."""
        block = np.zeros(self.size)
        for name, value in values.items():
            block[self._slices[name]] = value
        return block


@cache
def state_rows(n: int) -> RowNumbers:
    """Rows of the state of a cross-section with ``n`` tubes."""
    return RowNumbers(STATE, n)


@cache
def field_rows(n: int) -> RowNumbers:
    """Rows of the fields at one point."""
    return RowNumbers(FIELDS, n)


@cache
def base_end_rows(n: int) -> RowNumbers:
    """Rows of the base part's fields behind those of its points."""
    return RowNumbers(BASE_ENDS, n)


@cache
def unknown_rows(n: int) -> RowNumbers:
    """Rows of the unknowns of the shooting problem."""
    return RowNumbers(UNKNOWNS, n)


@cache
def residual_rows(n: int) -> RowNumbers:
    """Rows of the residual of the shooting problem."""
    return RowNumbers(RESIDUAL, n)


@cache
def parameter_rows(n: int) -> RowNumbers:
    """Rows of the parameter block."""
    return RowNumbers(PARAMETERS, n)


@cache
def input_rows(n: int) -> RowNumbers:
    """Rows of the inputs of a time stage, beta rates included."""
    return RowNumbers(INPUTS, n)


@cache
def workspace_rows(n: int) -> RowNumbers:
    """Rows of the workspace of a sweep."""
    return RowNumbers(WORKSPACE, n)


def parameters_of_inputs(n: int) -> np.ndarray:
    """Rows of the parameter block that hold the inputs of a time stage, in their order, beta rates included."""
    parameters = parameter_rows(n)
    return np.concatenate([parameters.rows(name) for name in input_rows(n).names])


# The same in compiled code: a value that holds the number of tubes, and attributes that are computed from it.


class RowNumbersType(types.Type):
    """Type of :class:`RowNumbers` in compiled code; ``first`` holds each group's first row as (fixed, per tube)."""

    def __init__(self, name: str, groups: tuple[Group, ...]) -> None:
        self.first = {group.name: total(groups[:k]) for k, group in enumerate(groups)}
        self.first["size"] = total(groups)
        super().__init__(name=f"RowNumbers({name})")


@register_model(RowNumbersType)
class _TubeCount(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, manager.lookup(types.intp).get_value_type())


@infer_getattr
class _Groups(AttributeTemplate):
    key = RowNumbersType

    def generic_resolve(self, kind: Any, name: str) -> Any:  # type: ignore[override]
        return types.intp if name in kind.first else None


@lower_getattr_generic(RowNumbersType)
def _first_row(context: Any, builder: Any, kind: Any, n: Any, name: str) -> Any:
    fixed, per_tube = (context.get_constant(types.intp, k) for k in kind.first[name])
    return builder.add(fixed, builder.mul(per_tube, n))


def _compile(function: Any, groups: tuple[Group, ...]) -> None:
    kind = RowNumbersType(function.__name__, groups)

    @type_callable(function)
    def type_of(context: Any) -> Any:
        return lambda n: kind if isinstance(n, types.Integer) else None

    @lower_builtin(function, types.Integer)
    def value_of(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return context.cast(builder, args[0], signature.args[0], types.intp)


for _function, _groups in (
    (state_rows, STATE),
    (field_rows, FIELDS),
    (base_end_rows, BASE_ENDS),
    (unknown_rows, UNKNOWNS),
    (residual_rows, RESIDUAL),
    (parameter_rows, PARAMETERS),
    (input_rows, INPUTS),
    (workspace_rows, WORKSPACE),
):
    _compile(_function, _groups)


@njit(forceinline=True)
def base_field_count(n: int, cells: int) -> int:
    """Number of the base part's fields for ``cells`` cells behind the plate: psi_t and u_z of each tube at every point, and ``BASE_ENDS``."""
    return 2 * n * (4 * cells + 1) + base_end_rows(n).size


@njit(forceinline=True)
def input_row(n: int, i: int) -> int:
    """Row of the parameters that holds input ``i`` of a time stage.

    Alpha, its rate and beta lie side by side there as they do among the inputs, and so do force and torque.
    """
    given, rows = input_rows(n), parameter_rows(n)
    if i < given.force:
        return rows.alpha + i
    if i < given.beta_rate:
        return rows.force + (i - given.force)
    return rows.beta_rate + (i - given.beta_rate)
