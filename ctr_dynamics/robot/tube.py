"""One tube: cross-section, material, precurvature along its length and the body at its end."""

from __future__ import annotations

import math
from typing import Annotated, cast

import numpy as np
from pydantic import Field, model_validator

from ctr_dynamics.robot.quantity import Block, Floats, Number, Quantity, VectorQuantity, problem, rule

POISSON = 0.3  # of the default shear modulus G = E / (2 (1 + nu))
MAX_LENGTH = 2.0  # m; longer is a unit error, not a concentric tube robot
MAX_CURVATURE = 1000.0  # 1/m, a bend radius of 1 mm

MILLIMETRES = "lengths are in metres; a value in millimetres is divided by 1000"
Length = Annotated[Quantity, rule("m", 0.0, MAX_LENGTH, above=True, hint=MILLIMETRES)]
InnerRadius = Annotated[Quantity, rule("m", 0.0, 0.05, hint=MILLIMETRES)]
OuterRadius = Annotated[Quantity, rule("m", 0.0, 0.05, above=True, hint=MILLIMETRES)]
Modulus = Annotated[
    Quantity, rule("Pa", 1e5, 2e12, hint="moduli are in pascals; a value in GPa is multiplied by 1e9")
]
Density = Annotated[Quantity, rule("kg/m^3", 100.0, 30000.0, hint="a value in g/cm^3 is multiplied by 1000")]
Damping = Annotated[Quantity, rule("N m^2 s", 0.0, 1.0)]
Mass = Annotated[
    Quantity, rule("kg", 0.0, 1.0, hint="masses are in kilograms; a value in grams is divided by 1000")
]
Inertia = Annotated[VectorQuantity, rule("kg m^2", 0.0, 1.0)]
Curvature = Annotated[VectorQuantity, rule("1/m", -MAX_CURVATURE, MAX_CURVATURE)]


class CurvaturePolynomial(Block):
    """Precurvature u*(s) = sum_k c_k s^k with s (m) from the segment's start.

    Attributes:
        value: (3, K) coefficients; those of s^k have unit 1/m^(k+1).
        unit: "1/m", the unit of u*.
        tolerance_percent: 1-sigma of one scale of the whole polynomial, in percent.
    """

    value: tuple[tuple[Number, ...], tuple[Number, ...], tuple[Number, ...]]
    unit: str
    tolerance_percent: Number = 0.0

    @model_validator(mode="after")
    def _check(self) -> CurvaturePolynomial:
        if self.unit != "1/m":
            raise problem(f"unit '{self.unit}' must be '1/m'; files hold SI units and radians only")
        counts = {len(row) for row in self.value}
        if len(counts) > 1 or 0 in counts:
            raise problem(f"rows have {sorted(counts)} coefficients; write three rows of equal length")
        if not 0 <= self.tolerance_percent < 100:
            raise problem(f"tolerance_percent {self.tolerance_percent:g} % is outside [0, 100) %")
        return self


class Segment(Block):
    """A length of tube with constant or polynomial precurvature, in the tube's own frame."""

    length: Length
    curvature: Curvature | None = None
    curvature_polynomial: CurvaturePolynomial | None = None

    @model_validator(mode="after")
    def _one_curvature(self) -> Segment:
        if (self.curvature is None) == (self.curvature_polynomial is None):
            raise problem("a segment needs either curvature or curvature_polynomial; give one of them")
        peak = self.peak_curvature
        if not peak <= MAX_CURVATURE:
            raise problem(
                f"precurvature reaches {peak:g} 1/m, more than {MAX_CURVATURE:g} 1/m; "
                "coefficients of s^k are in 1/m^(k+1)"
            )
        return self

    @property
    def coefficients(self) -> Floats:
        """(3, K) polynomial coefficients in s from the segment's start; K = 1 when constant."""
        if self.curvature_polynomial is not None:
            return np.array(self.curvature_polynomial.value)
        return np.array(cast(VectorQuantity, self.curvature).value)[:, None]

    def curvature_at(self, s: float) -> Floats:
        """Precurvature u* (3,) in 1/m, s (m) from the segment's start."""
        c = self.coefficients
        return cast(Floats, c @ s ** np.arange(c.shape[1]))

    @property
    def peak_curvature(self) -> float:
        """Largest |u*| in 1/m at 33 points along the segment."""
        with np.errstate(over="ignore", invalid="ignore"):
            return max(
                float(np.linalg.norm(self.curvature_at(s))) for s in np.linspace(0, self.length.value, 33)
            )

    @property
    def relative_tolerance(self) -> float:
        """1-sigma of a scale of this segment's precurvature, dimensionless."""
        if self.curvature_polynomial is not None:
            return self.curvature_polynomial.tolerance_percent / 100
        return cast(VectorQuantity, self.curvature).relative


class EndBody(Block):
    """A rigid body fixed to a tube's end, its centre of mass at the end point.

    Attributes:
        mass: kg.
        inertia: (3,) principal moments about the axes of the tube's end frame, kg m^2.
    """

    mass: Mass
    inertia: Inertia


class Tube(Block):
    """One tube; arc lengths are from its own base, frames its own."""

    name: str = Field(min_length=1)
    inner_radius: InnerRadius
    outer_radius: OuterRadius
    youngs_modulus: Modulus
    shear_modulus: Modulus | None = None
    density: Density
    bending_damping: Damping
    torsion_damping: Damping
    precurvature: tuple[Segment, ...] = Field(min_length=1)
    end_body: EndBody | None = None

    @model_validator(mode="after")
    def _check(self) -> Tube:
        inner, outer = self.inner_radius.value, self.outer_radius.value
        if inner >= outer:
            raise problem(
                f"inner_radius {inner:g} m is not below outer_radius {outer:g} m; "
                "give radii in metres, inner below outer (0 for a solid rod)"
            )
        if self.length > MAX_LENGTH:
            raise problem(f"tube is {self.length:g} m long, more than {MAX_LENGTH:g} m; {MILLIMETRES}")
        for i, segment in enumerate(self.precurvature):
            if segment.peak_curvature * outer >= 1:
                raise problem(
                    f"precurvature[{i}] reaches {segment.peak_curvature:g} 1/m, a bend tighter than the "
                    f"outer radius {outer:g} m; curvatures are in 1/m and must stay below {1 / outer:g} 1/m"
                )
        return self

    @property
    def shear_follows_youngs(self) -> bool:
        """True when the file gives no shear modulus, so that G = E / (2 (1 + 0.3)) moves with E."""
        return self.shear_modulus is None

    @property
    def shear(self) -> Quantity:
        """Shear modulus G, Pa: the file's, or E / 2.6 with E's relative tolerance."""
        if self.shear_modulus is not None:
            return self.shear_modulus
        ratio = 2 * (1 + POISSON)
        e = self.youngs_modulus
        return Quantity(value=e.value / ratio, unit="Pa", tolerance=e.tolerance / ratio)

    @property
    def length(self) -> float:
        """Total length, m."""
        return math.fsum(segment.length.value for segment in self.precurvature)

    @property
    def breakpoints(self) -> Floats:
        """(segments + 1,) arc lengths (m) from the tube's base where segments begin and end."""
        return np.cumsum([0.0, *(segment.length.value for segment in self.precurvature)])

    @property
    def area(self) -> float:
        """Cross-section area, m^2."""
        return math.pi * (self.outer_radius.value**2 - self.inner_radius.value**2)

    @property
    def second_moment(self) -> float:
        """Second moment of area I about x or y, m^4; the polar one is 2 I."""
        return math.pi / 4 * (self.outer_radius.value**4 - self.inner_radius.value**4)

    @property
    def bending_stiffness(self) -> float:
        """E I, N m^2."""
        return self.youngs_modulus.value * self.second_moment

    @property
    def torsion_stiffness(self) -> float:
        """G 2 I, N m^2."""
        return self.shear.value * 2 * self.second_moment

    @property
    def precurvature_tolerance(self) -> float:
        """1-sigma of one scale of the tube's whole precurvature: the largest of its segments."""
        return max(segment.relative_tolerance for segment in self.precurvature)

    def curvature_at(self, s: float) -> Floats:
        """Precurvature u* (3,), 1/m, at s (m) from the base; a breakpoint belongs to the segment after it."""
        edges = self.breakpoints
        i = int(np.clip(np.searchsorted(edges, s, side="right") - 1, 0, len(self.precurvature) - 1))
        return self.precurvature[i].curvature_at(s - edges[i])
