"""Tip kinematics: pose and twist of tube 1's end in ``ctr_base``, and how they follow from node states and their columns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .rotations import conjugate, from_vector, matrix, multiply, to_vector

Floats = NDArray[np.float64]


@dataclass
class Tip:
    """Pose and twist in ``ctr_base`` at one time, with columns of their first variation.

    Attributes:
        position (3,) m, quaternion (4,) wxyz, velocity (3,) m/s (insertion included), rate (3,) rad/s (base axes).
        columns: (12, r): position, rotation vector (base axes), velocity, angular velocity for every column of the covariance.
    """

    stamp: float
    position: Floats
    quaternion: Floats
    velocity: Floats
    rate: Floats
    columns: Floats

    def shift(self, a: Floats) -> None:
        """Move the tip by the columns times ``a`` (r,)."""
        d = self.columns @ a
        self.position = self.position + d[0:3]
        self.quaternion = multiply(from_vector(d[3:6]), self.quaternion)
        self.velocity = self.velocity + d[6:9]
        self.rate = self.rate + d[9:12]


def tip_of(stamp: float, node: Floats, dnode: Floats, insertion_rate: float) -> Tip:
    """Tip from the last node's state (S,) and its columns (S, r); ``insertion_rate`` is d beta_1 / dt in m/s."""
    h = node[3:7] / np.linalg.norm(node[3:7])
    R = matrix(h)
    q = np.array([node[7], node[8], node[9] + insertion_rate])
    velocity, rate = R @ q, R @ node[10:13]
    norm2 = node[3:7] @ node[3:7]
    dh = dnode[3:7]
    # rotation vector of dR in base axes: 2 vec(dh h*) / |h|^2
    w, x, y, z = node[3:7]
    product = np.array([[-x, w, -z, y], [-y, z, w, -x], [-z, -y, x, w]])
    turn = 2.0 / norm2 * (product @ dh)
    columns = np.empty((12, dnode.shape[1]))
    columns[0:3] = dnode[0:3]
    columns[3:6] = turn
    columns[6:9] = R @ dnode[7:10] + np.cross(turn.T, velocity).T
    columns[9:12] = R @ dnode[10:13] + np.cross(turn.T, rate).T
    return Tip(stamp, node[0:3].copy(), h, velocity, rate, columns)


def between(a: Tip, b: Tip, stamp: float) -> Tip:
    """Tip at a time between two steps (or a little outside): cubic Hermite in position, linear turn on top of the nearer end's rotation."""
    dt = b.stamp - a.stamp
    x = (stamp - a.stamp) / dt
    w = (1 + 2 * x) * (1 - x) ** 2, x * (1 - x) ** 2 * dt, x * x * (3 - 2 * x), x * x * (x - 1) * dt
    d = 6 * x * (x - 1) / dt, (1 - x) * (1 - 3 * x), 6 * x * (1 - x) / dt, x * (3 * x - 2)
    turn = to_vector(multiply(b.quaternion, conjugate(a.quaternion)))
    columns = np.empty_like(b.columns)
    columns[0:3] = w[0] * a.columns[0:3] + w[1] * a.columns[6:9] + w[2] * b.columns[0:3] + w[3] * b.columns[6:9]
    columns[6:9] = d[0] * a.columns[0:3] + d[1] * a.columns[6:9] + d[2] * b.columns[0:3] + d[3] * b.columns[6:9]
    columns[3:6] = (1 - x) * a.columns[3:6] + x * b.columns[3:6]
    columns[9:12] = (1 - x) * a.columns[9:12] + x * b.columns[9:12]
    return Tip(
        stamp,
        w[0] * a.position + w[1] * a.velocity + w[2] * b.position + w[3] * b.velocity,
        multiply(from_vector(x * turn), a.quaternion),
        d[0] * a.position + d[1] * a.velocity + d[2] * b.position + d[3] * b.velocity,
        (1 - x) * a.rate + x * b.rate,
        columns,
    )
