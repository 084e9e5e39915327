"""Made-up quantities and problems whose answers are known without a simulation of a robot."""

import math
from dataclasses import dataclass, field
from types import SimpleNamespace

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

    reach, options, tolerance_factor = 2.0, DiagnosisOptions(), 1.0

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


class LongVibration:
    """A problem of one recording: an undamped vibration of about 50 Hz that begins at ``begin_s``, sampled at 40 Hz for 8 s, with noise."""

    reach, options, workers, tolerance_factor = 4.0, DiagnosisOptions(), 1, 1.0

    def __init__(self, truth, nuisances, *, begin_s=0.0, noise=1.0, end_s=8.0, spans=None):
        self.truth, self.nuisances, self.begin_s, self.noise = truth, nuisances, begin_s, noise
        self.spans = [] if spans is None else spans
        self.t = np.arange(0.0, 8.0, 0.025)[: round(end_s / 0.025)]
        self.size = 2 * len(self.t)
        self.numerics = np.zeros((self.size, 0))
        self.forward_models = [SimpleNamespace(recording=SimpleNamespace(duration=8.0))]
        rng = np.random.default_rng(5)
        self.measured = self.predicted(truth) + noise * rng.normal(size=(2, 320))[:, : len(self.t)].ravel()

    def until(self, ends):
        self.spans.append(ends[0])
        return LongVibration(
            self.truth,
            self.nuisances,
            begin_s=self.begin_s,
            noise=self.noise,
            end_s=ends[0],
            spans=self.spans,
        )

    def predicted(self, point):
        """(2 k,) of two axes, a quarter of a turn apart."""
        f, size = (point.get(("made_up", name), 0.0) for name in ("frequency", "size"))
        t = np.maximum(self.t - self.begin_s, 0.0)
        angle = 2 * math.pi * 50.0 * (1.0 + f) * t
        return 30.0 * (1.0 + size) * np.concatenate([np.cos(angle), np.sin(angle)])

    def residual(self, point):
        return self.measured - self.predicted(point)

    def linearise(self, point, wanted):
        columns = []
        for q in wanted:
            more = {**point, q.key: point.get(q.key, 0.0) + 1e-6}
            columns.append((self.predicted(more) - self.predicted(point)) / 1e-6)
        return self.residual(point), np.stack(columns, axis=1)


@dataclass
class BentProblem:
    """Ten nuisances whose prediction is linear up to ``bend`` tolerances of each, and stands still beyond it."""

    data: np.ndarray
    J: np.ndarray
    nuisances: tuple
    bend: float = math.inf
    reach: float = 4.0
    tolerance_factor: float = 1.0
    robot: object = None
    options: DiagnosisOptions = field(default_factory=DiagnosisOptions)

    @property
    def numerics(self):
        return np.zeros((len(self.data), 0))

    @property
    def size(self):
        return len(self.data)

    def _bent(self, point):
        departures = np.array([point.get(q.key, q.off) - q.off for q in self.nuisances])
        most = self.bend * np.array([q.tolerance for q in self.nuisances])
        return departures, most

    def residual(self, point):
        departures, most = self._bent(point)
        return self.data - self.J @ np.clip(departures, -most, most)

    def linearise(self, point, wanted):
        departures, most = self._bent(point)
        keys = [q.key for q in self.nuisances]
        columns = [
            self.J[:, keys.index(q.key)] * (abs(departures[keys.index(q.key)]) <= most[keys.index(q.key)])
            for q in wanted
        ]
        return self.residual(point), np.stack(columns, axis=1)
