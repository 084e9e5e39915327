"""Orientations that a log gives as matrices or Euler angles, as quaternions."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ctr_dynamics.csv_import.column_layout import EULER, MATRIX, QUATERNION

Floats = NDArray[np.float64]
ORTHOGONAL_LIMIT = 0.05  # largest entry of R R^T - 1; four written digits miss by 1e-4


def with_quaternions(names: list[str], values: Floats) -> tuple[list[str], Floats]:
    """Columns with ``qx, qy, qz, qw`` instead of a matrix (rows m00 m01 m02, ..) or of Euler angles in rad.

    R = R_z(yaw) R_y(pitch) R_x(roll), as ROS has it. A matrix that is no rotation gives a quaternion of zeros, which its reader leaves out.
    """
    kept = [i for i, name in enumerate(names) if name not in MATRIX + EULER]
    if MATRIX[0] in names:
        R = values[:, [names.index(name) for name in MATRIX]].reshape(-1, 3, 3)
        off = np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
        good = (off <= ORTHOGONAL_LIMIT) & (np.linalg.det(R) > 0.0)
        quaternions = np.zeros((len(values), 4))
        if good.any():
            quaternions[good] = Rotation.from_matrix(R[good]).as_quat()
    else:
        angles = values[:, [names.index(name) for name in ("yaw", "pitch", "roll")]]
        quaternions = Rotation.from_euler("ZYX", angles).as_quat()
    return [*(names[i] for i in kept), *QUATERNION], np.hstack([values[:, kept], quaternions])
