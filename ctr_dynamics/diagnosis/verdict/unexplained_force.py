"""Unexplained force: what no cause explains, described as a force at the tip.

In: a forward model and the re-calibrated point. Out: when the force acts, along what, how large and how often.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lombscargle

from ctr_dynamics.diagnosis.diagnosis_options import UnexplainedForceOptions
from ctr_dynamics.diagnosis.forward_model import ForwardModel, Point
from ctr_dynamics.effects import effect_quantities

Floats = NDArray[np.float64]
BELOW_ALIASES = 0.45  # of the rate of the samples: the highest frequency that is looked for


@dataclass(frozen=True)
class UnexplainedForce:
    """A force at the tip that would explain what is left, were the robot in equilibrium with it at any time.

    Attributes:
        stamps: (k,) s. force: (k, 3) N, world axes. direction: (3,) along which it is strongest. rms: N.
        begin, end: s between which 90 % of its square lies. frequency: Hz, None where no single one dominates.
    """

    stamps: Floats
    force: Floats
    direction: Floats
    rms: float
    begin: float
    end: float
    frequency: float | None

    @property
    def text(self) -> str:
        """One sentence."""
        x, y, z = self.direction
        often = "without one period" if self.frequency is None else f"periodic at {self.frequency:.2f} Hz"
        return (
            f"what is left acts like a force at the tip of {1e3 * self.rms:.1f} mN rms along ({x:+.2f}, {y:+.2f}, {z:+.2f}), "
            f"between {self.begin:.1f} and {self.end:.1f} s, {often}"
        )


def unexplained_force(
    forward_model: ForwardModel, point: Point, options: UnexplainedForceOptions
) -> UnexplainedForce | None:
    """Describe what the model at ``point`` leaves of a recording; None where it cannot be simulated or hardly anything is left.

    The tip's compliance is that of a constant force: right below the first resonance, and a description above it.
    """
    pushes = [q for q in effect_quantities(forward_model.robot) if q.effect == "tip_force"]
    prediction, jacobian = forward_model.jacobian(point, pushes)
    residual = forward_model.residual(prediction)[:, :3]
    stamps = forward_model.recording.stamps
    good = np.isfinite(residual).all(axis=1) & (stamps >= stamps[0] + options.start_s)
    if prediction.failure or good.sum() < options.fewest:
        return None
    compliance = jacobian[good, :3] / np.array([q.scale for q in pushes])
    typical = float(np.median(np.linalg.norm(compliance, axis=(1, 2))))
    if typical == 0.0:
        return None
    # ridge: a robot that is stiff in one direction shows no force there
    square = np.einsum("kji,kjl->kil", compliance, compliance) + (options.stiff * typical) ** 2 * np.eye(3)
    force = np.linalg.solve(square, np.einsum("kji,kj->ki", compliance, residual[good])[..., None])[..., 0]
    t = stamps[good]
    power = np.sum(force**2, axis=1)
    total = np.cumsum(power) / power.sum()
    vectors = np.linalg.eigh(force.T @ force)[1]
    direction = vectors[:, -1] * np.sign(vectors[np.argmax(np.abs(vectors[:, -1])), -1])
    return UnexplainedForce(
        t,
        force,
        direction,
        math.sqrt(float(power.mean())),
        float(t[np.searchsorted(total, 0.05)]),
        float(t[min(np.searchsorted(total, 0.95), len(t) - 1)]),
        _frequency(t, force @ direction, options),
    )


def _frequency(t: Floats, x: Floats, options: UnexplainedForceOptions) -> float | None:
    """Hz of the frequency that dominates ``x`` (k,) at ``t`` (k,) s; None where none does.

    Beyond half of the rate of the samples, frequencies repeat those below.
    """
    highest = min(options.highest_hz, BELOW_ALIASES / float(np.median(np.diff(t))))
    if highest <= options.lowest_hz:
        return None
    frequencies = np.linspace(options.lowest_hz, highest, options.frequencies)
    spectrum = lombscargle(t, x - x.mean(), 2.0 * np.pi * frequencies, normalize=True)
    best = int(np.argmax(spectrum))
    return float(frequencies[best]) if spectrum[best] >= options.periodic else None
