"""The measurement in plain NumPy: what a tip and tracker states predict, and how a measurement differs from it (docs/filter.md)."""

import math

import numpy as np

from ctr_dynamics.kernels.rotations import conjugate, from_vector, matrix, multiply, to_vector
from ctr_dynamics.sensing.tracker import (
    DRIFT,
    LEVER,
    MODEL_POSITION,
    MODEL_ROTATION,
    ROTATION,
    SHIFT,
    TRANSLATION,
)


def expected(model, bias, tip):
    """Reading (position (3,) m, quaternion (4,) wxyz) that the tip and the tracker states (22,) predict."""
    registration = multiply(from_vector(bias[ROTATION]), model.rotation)
    point = tip.position + matrix(tip.quaternion) @ (model.lever + bias[LEVER]) + bias[MODEL_POSITION]
    position = matrix(registration) @ point + model.translation + bias[TRANSLATION]
    position = position + bias[DRIFT] + bias[SHIFT]
    return position, multiply(registration, multiply(from_vector(bias[MODEL_ROTATION]), tip.quaternion))


def residual(position, quaternion, expected_position, expected_quaternion, mask=None):
    """(6,) measured minus expected; where ``mask`` (6,) leaves out one rotation axis, without the turn about it."""
    turned = multiply(conjugate(expected_quaternion), quaternion)
    if mask is not None and mask[3:].sum() == 2:
        axis = 1 + int(np.argmin(mask[3:]))
        twist = np.zeros(4)
        twist[0], twist[axis] = turned[0], turned[axis]
        if twist @ twist > 1e-12:
            turned = multiply(turned, conjugate(twist / math.sqrt(twist @ twist)))
    return np.concatenate([position - expected_position, to_vector(turned)])
