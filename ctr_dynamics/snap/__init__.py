"""Snap-through: the finite-difference boundary-value solver of section III-F, S-curves and what is read off a snap."""
