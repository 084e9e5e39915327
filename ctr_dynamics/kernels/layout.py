"""Rows of the parameter block that the kernels read, and its making from a robot."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

# Slots of the stored fields; the rates of a step's stages follow from RATES on.
Y_NOW, Y_BEFORE, RATE_NOW, RATES = 0, 1, 2, 3

EXTENDED = (
    ("stribeck_excess", 1),
    ("stribeck_inverse_speed", 1),
    ("overlap_friction", 1),
    ("drag_linear", 1),
    ("drag_quadratic", 1),
    ("play", 1),
    ("play_moment", 1),
    ("spring_stiffness", 1),
    ("spring_damping", 1),
    ("spring_force", 3),
    ("contact_stiffness", 1),
    ("contact_normal", 3),
    ("contact_offset", 1),
    ("insertion", 1),
    ("play_share", 1),
)
EXTENDED_TUBES = ("oval_cos", "oval_sin", "softening", "drive_compliance", "drive_inertia", "beta_rate")


class Layout:
    """Row numbers of the parameters of ``n`` tubes: one number a tube for the first fourteen groups, then g, the tip wrench and friction.

    SI units; ``precurvature`` is a factor on u*, ``gravity``, ``force`` and ``torque`` are in ``ctr_base``.
    """

    def __init__(self, n: int) -> None:
        self.n = n
        groups = [
            "bending_stiffness",
            "torsional_stiffness",
            "mass_per_length",
            "inertia_per_length",
            "bending_damping",
            "torsion_damping",
            "precurvature",
            "body_mass",
            "body_inertia_x",
            "body_inertia_y",
            "body_inertia_z",
            "alpha",
            "alpha_rate",
            "beta",
        ]
        self._rows = {name: slice(k * n, (k + 1) * n) for k, name in enumerate(groups)}
        base = 14 * n
        for name, size in (("gravity", 3), ("force", 3), ("torque", 3)):
            self._rows[name] = slice(base, base + size)
            base += size
        for name in ("tube_coulomb", "tube_viscous", "epsilon", "base_coulomb", "base_viscous"):
            self._rows[name] = slice(base, base + 1)
            base += 1
        for name, size in EXTENDED:  # read by ctr_dynamics.kernels.extended_rod only
            self._rows[name] = slice(base, base + size)
            base += size
        for name in EXTENDED_TUBES:
            self._rows[name] = slice(base, base + n)
            base += n
        self.size = base

    def __getitem__(self, name: str) -> slice:
        return self._rows[name]

    def rows(self, name: str) -> np.ndarray:
        """Row numbers of ``name``."""
        return np.arange(self.size)[self._rows[name]]

    def pack(self, **values: ArrayLike) -> np.ndarray:
        """Parameter block (size,) from values by name; those not given are 0."""
        block = np.zeros(self.size)
        for name, value in values.items():
            block[self._rows[name]] = value
        return block
