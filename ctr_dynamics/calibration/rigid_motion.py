"""The rigid motion between two sets of points, and the mean of rotations."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def rigid_motion(source: Floats, target: Floats) -> tuple[Floats, Floats]:
    """Quaternion (4,) wxyz and translation (3,) that carry points ``source`` (s, 3) nearest to ``target`` (s, 3).

    Source: Horn (1987), Closed-form solution of absolute orientation using unit quaternions.
    """
    a, b = source.mean(axis=0), target.mean(axis=0)
    S = (source - a).T @ (target - b)
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = S
    N = np.array(
        [
            [xx + yy + zz, yz - zy, zx - xz, xy - yx],
            [yz - zy, xx - yy - zz, xy + yx, zx + xz],
            [zx - xz, xy + yx, yy - xx - zz, yz + zy],
            [xy - yx, zx + xz, yz + zy, zz - xx - yy],
        ]
    )
    h = np.linalg.eigh(N)[1][:, -1]
    w, v = h[0], h[1:]
    turned = a + 2.0 * w * np.cross(v, a) + 2.0 * np.cross(v, np.cross(v, a))
    return h, b - turned


def mean_rotation(rotations: Floats) -> Floats:
    """The quaternion (4,) nearest to unit quaternions (s, 4), of which each sign means the same.

    Source: Markley et al. (2007), Averaging quaternions.
    """
    h = np.linalg.eigh(rotations.T @ rotations)[1][:, -1]
    return np.asarray(h * np.copysign(1.0, h[0]))


def shortest_turn(source: Floats, target: Floats) -> Floats:
    """The quaternion (4,) of the smallest rotation that carries the unit vector ``source`` (3,) to ``target`` (3,)."""
    h = np.concatenate([[1.0 + source @ target], np.cross(source, target)])
    if np.linalg.norm(h) < 1e-6:  # opposite: half a turn about any axis across
        across = np.cross(source, np.eye(3)[int(np.argmin(np.abs(source)))])
        h = np.concatenate([[0.0], across])
    return np.asarray(h / np.linalg.norm(h))
