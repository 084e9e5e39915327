"""Rotations: unit quaternions (w, x, y, z), rotation matrices and rotation vectors.

Functions of one rotation are plain Python, which numba compiles too (:mod:`ctr_dynamics.kernels.compiled_rotations`). Those whose name ends in
``_rows`` take arrays of rotations, row by row.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def matrix(h: Floats) -> Floats:
    """Rotation matrix (3, 3) of a quaternion (4,) wxyz of any length but 0."""
    w, x, y, z = h[0], h[1], h[2], h[3]
    k = 2.0 / (w * w + x * x + y * y + z * z)
    return np.array(
        [
            [1 - k * (y * y + z * z), k * (x * y - w * z), k * (x * z + w * y)],
            [k * (x * y + w * z), 1 - k * (x * x + z * z), k * (y * z - w * x)],
            [k * (x * z - w * y), k * (y * z + w * x), 1 - k * (x * x + y * y)],
        ]
    )


def multiply(a: Floats, b: Floats) -> Floats:
    """Hamilton product a b of quaternions (4,)."""
    aw, ax, ay, az = a[0], a[1], a[2], a[3]
    bw, bx, by, bz = b[0], b[1], b[2], b[3]
    return np.array(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ]
    )


def from_vector(r: Floats) -> Floats:
    """Unit quaternion (4,) of a rotation vector (3,) rad."""
    angle = math.sqrt(r[0] * r[0] + r[1] * r[1] + r[2] * r[2])
    k = 0.5 * math.sin(0.5 * angle) / (0.5 * angle) if angle > 1e-8 else 0.5
    return np.array([math.cos(0.5 * angle), k * r[0], k * r[1], k * r[2]])


def to_vector(h: Floats) -> Floats:
    """Rotation vector (3,) rad, shorter than pi, of a quaternion (4,) of any length but 0."""
    w, x, y, z = h[0], h[1], h[2], h[3]
    norm = math.sqrt(x * x + y * y + z * z)
    if norm < 1e-12 * abs(w) or norm == 0.0:
        return np.array([2 * x / w, 2 * y / w, 2 * z / w]) if w else np.zeros(3)
    angle = 2.0 * math.atan2(norm, w)
    if angle > math.pi:
        angle -= 2.0 * math.pi
    return np.array([x, y, z]) * (angle / norm)


def conjugate(h: Floats) -> Floats:
    """Inverse of a unit quaternion (4,)."""
    return np.array([h[0], -h[1], -h[2], -h[3]])


def conjugate_rows(h: Floats) -> Floats:
    """Inverses of unit quaternions (k, 4)."""
    return h * np.array([1.0, -1.0, -1.0, -1.0])


def multiply_rows(a: Floats, b: Floats) -> Floats:
    """Hamilton products (k, 4) of quaternions (k, 4) or (4,)."""
    aw, ax, ay, az = np.moveaxis(np.atleast_2d(a), -1, 0)
    bw, bx, by, bz = np.moveaxis(np.atleast_2d(b), -1, 0)
    return np.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        axis=-1,
    )


def rotate_rows(h: Floats, v: Floats) -> Floats:
    """Vectors (k, 3) or (3,) turned by unit quaternions (k, 4) or (4,), (k, 3)."""
    h, v = np.atleast_2d(h), np.atleast_2d(v)
    w, u = h[:, :1], h[:, 1:]
    return v + 2.0 * np.cross(u, np.cross(u, v) + w * v)


def to_vector_rows(h: Floats) -> Floats:
    """Rotation vectors (k, 3) rad, shorter than pi, of unit quaternions (k, 4)."""
    h = np.where(h[:, :1] < 0.0, -h, h)
    norm = np.linalg.norm(h[:, 1:], axis=1, keepdims=True)
    angle = 2.0 * np.arctan2(norm, h[:, :1])
    return h[:, 1:] * np.where(norm > 1e-12, angle / np.maximum(norm, 1e-12), 2.0)
