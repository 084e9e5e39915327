"""Made-up quantities and problems whose answers are known without a simulation of a robot."""

import math

import numpy as np

from ctr_dynamics.diagnosis.diagnosis_options import DiagnosisOptions
from ctr_dynamics.effects import EffectParameter, EffectQuantity


def quantity(name, low=-math.inf, high=math.inf, *, tolerance=0.0, scale=1.0, off=0.0):
    """A coordinate of no effect of the catalogue."""
    return EffectQuantity(
        "made_up", name, off, tolerance, scale, low, high, EffectParameter(name, "1", off, scale)
    )


class Vibration:
    """A problem whose prediction is a decaying vibration; nuisances reach two tolerances, and there is no discretisation error."""

    reach, options = 2.0, DiagnosisOptions()

    def __init__(self, truth, nuisances=()):
        self.t = np.linspace(0.0, 14.0, 500)
        self.truth, self.nuisances, self.numerics = truth, nuisances, np.zeros((500, 0))
        self.steps = []

    def with_least_step(self, dt):
        self.steps.append(dt)
        return self

    def predicted(self, point):
        f = 5.0 * (1.0 + point.get(("made_up", "frequency"), 0.0))
        return 40.0 * np.exp(-self.t) * np.cos(2 * math.pi * f * self.t)

    def residual(self, point):
        return self.predicted(self.truth) - self.predicted(point)
