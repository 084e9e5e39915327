"""A robot whose tip departs from its model as neither parameters nor a force explain: the size of that departure.

The robot file may state it (``model_error``). Where it does not, or states too little, the filter takes it for a force and for wrong parameters,
and is worse than the open-loop run. So measurements are also compared with the open-loop run and a departure from it, a Gauss-Markov process of
each of some sizes and times. These and the filter compete by how well each foretells the next position (prequential evidence, Dawid 1984).

A robot that is better than its tolerances is foretold by its open-loop run better than by the filter, which counts on them. So the open-loop run
with a constant departure, that of a registration within its tolerance, competes too. Where it foretells best, the model does not err. That departure
may jump: a tracker or sensor that was moved departs suddenly, by any distance, and stays there, which no model does. And it may grow steadily: the
frame of the tracker moves then (:mod:`~ctr_dynamics.estimation.monitoring.frame_motion`). Noise of a tracker that is noisier than stated is no
departure of the robot either (:mod:`~ctr_dynamics.estimation.monitoring.noisy_tracker`), nor are stamps that scatter
(:mod:`~ctr_dynamics.estimation.monitoring.stamp_jitter`).
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.estimation.filter.adapted_variances import AdaptationOptions
from ctr_dynamics.estimation.filter.filter_records import ModelErrorSize
from ctr_dynamics.estimation.monitoring.densities import density_of_filter, log_changed, log_density
from ctr_dynamics.estimation.monitoring.frame_motion import FrameMotion
from ctr_dynamics.estimation.monitoring.moved_tracker import Moved, MovedTracker
from ctr_dynamics.estimation.monitoring.noisy_tracker import NoisyTracker
from ctr_dynamics.estimation.monitoring.prequential_evidence import MEMORY_S, PRIOR
from ctr_dynamics.estimation.monitoring.smooth_departure import SmoothDeparture
from ctr_dynamics.estimation.monitoring.stamp_jitter import StampJitter
from ctr_dynamics.estimation.monitoring.taken_again import REMEMBERED, drop_from

Floats = NDArray[np.float64]
CONSTANT, REST = -2, -1  # rows beyond those of the departures


@dataclass(frozen=True)
class ModelErrorSearchOptions:
    """When a model error is believed.

    Attributes:
        smallest: by the tracker's noise; less is not told from noise. largest: by the robot's length. Published models of real robots err by 1 to
            3 % of it (Rucker et al. 2010, Dupont et al. 2010); what is farther is a wrong robot file or a fault of the tracker.
        steps: between one size and the next, as a factor.
        times_s: correlation times that are tried: of slow motion, not of a vibration.
        prior: probability that a robot departs from its file beyond the tolerances.
        believed: probability from which on the estimate begins again with the model error.
        learning_s: s after a start that do not count: the filter learns the sizes of force, shift and noise by a factor of ten at each measurement.
        least_s: s of evidence before a model error is believed, ten of the shortest times and one of the longest. A deflection at rest or the
            begin of a vibration is no slow departure yet.
        sound_s: s, mean time after which a tracker or its sensor is moved.
        memory_s: s, for which evidence counts.
    """

    smallest: float = 2.0
    largest: float = 0.03
    steps: float = 1.6
    times_s: tuple[float, ...] = (0.3, 1.0, 3.0)
    prior: float = PRIOR
    believed: float = 0.99
    learning_s: float = 0.5
    least_s: float = 3.0
    sound_s: float = AdaptationOptions.sound_s
    memory_s: float = MEMORY_S


class DepartureEvidence(NamedTuple):
    """What the measurements up to ``stamp_ns`` say.

    Attributes:
        level: (h + 2, 3) m, as known from the past: the tip's departure for every size and time, one that is constant but for jumps, and the
            position itself of a robot that rests.
        variance: (h + 2,) m^2, of it per axis.
        departures: (h + 2,) logarithm of the evidence of each; filter: of what the filter foretold; noisy: of a tracker that is noisier than stated;
            jitter: of one whose stamps scatter.
        moved: the filter finds such a move later; see :mod:`~ctr_dynamics.estimation.monitoring.moved_tracker`.
        since: (h + 2,) by how much each has foretold better than filter and rest since the time that speaks most for it.
        turned: rad^2, mean square of the rotation between measurements and open-loop run, per axis; weight: of how many measurements.
    """

    stamp_ns: int
    level: Floats
    variance: Floats
    departures: Floats
    filter: float
    moved: Moved
    noisy: float
    jitter: float
    since: Floats
    turned: float
    weight: float


class ModelErrorSearch:
    """Evidence for every size of the model error against that of the filter.

    Args:
        position_noise, rotation_noise: m and rad per axis, deviations of a measured pose.
        length: m, of the robot outside the base plate at most.
        registered: m per axis, by which the tip may depart for the registration's tolerance alone.
        change_s: mean time between two changes of the unknown force. The filter may have met one with every measurement.
        options: when a model error is believed.

    Attributes:
        frame: evidence for a tracker whose frame moves. noisy: for one that is noisier than stated. jitter: for one whose
            stamps scatter. smooth: for a robot that departs smoothly.
    """

    def __init__(
        self,
        position_noise: float,
        rotation_noise: float,
        length: float,
        registered: float,
        change_s: float,
        options: ModelErrorSearchOptions | None = None,
    ) -> None:
        self.options = options = options or ModelErrorSearchOptions()
        self._noise, self._rotation_noise, self._change_s = position_noise, rotation_noise, change_s
        self._reach = length
        least = options.smallest * position_noise
        most = max(least, options.largest * length)
        count = 1 + math.ceil(math.log(most / least) / math.log(options.steps))
        sizes = np.geomspace(least, most, count)
        self.sizes, self.times = (
            np.repeat(sizes, len(options.times_s)),
            np.tile(np.array(options.times_s), count),
        )
        self._variances = np.r_[self.sizes, registered, length] ** 2
        self._rates = np.r_[1.0 / self.times, 0.0, 0.0]
        self._moved = MovedTracker(position_noise, length, registered)
        self.frame = FrameMotion(position_noise, length)
        self.noisy = NoisyTracker(position_noise, length, registered)
        self.jitter = StampJitter(position_noise, registered)
        self.smooth = SmoothDeparture(position_noise, self.sizes, self.times, options.prior, options.memory_s)
        self.clear()

    def clear(self) -> None:
        """Forget all measurements."""
        self._evidence: deque[DepartureEvidence] = deque(maxlen=REMEMBERED)
        self._begin_ns = 0
        self._compared: tuple[ModelErrorSize, Floats] | None = None
        self._scatter: tuple[float, tuple[float, float]] | None = None
        self.frame.clear()
        self.noisy.clear()
        self.jitter.clear()
        self.smooth.clear()

    def add(
        self,
        stamp_ns: int,
        position: Floats,
        residual: Floats,
        velocity: Floats,
        acceleration: Floats,
        turn: Floats,
        predictive: tuple[float, float],
    ) -> None:
        """Take in a measured tip that the filter has met; one of a stamp that is known takes its place.

        Args:
            stamp_ns: of its header.
            position: (3,) m, measured. residual: (3,) m, measured minus open-loop tip, whose ``velocity`` (3,) m/s that was.
            turn: (a,) rad, rotation between them about the measured axes.
            predictive: logarithms of the densities that the filter predicted; see :class:`~ctr_dynamics.estimation.filter.filter_records.Update`.
        """
        drop_from(self._evidence, stamp_ns)
        self._compared = self._scatter = None
        noise, square = self._noise**2, self._variances
        angle = float(turn @ turn) / len(turn) if len(turn) else 0.0
        observed = np.repeat(residual[None], len(square), axis=0)
        observed[REST] = position
        if not self._evidence:
            self._begin_ns = stamp_ns
            gain = square / (square + noise)
            level = gain[:, None] * observed
            none = np.zeros(len(square))
            variance = (1.0 - gain) * square
            moved = self._moved.begin(residual)
            self._evidence.append(
                DepartureEvidence(
                    stamp_ns, level, variance, none, 0.0, moved, -math.inf, -math.inf, none, angle, 1.0
                )
            )
            return
        # 1. The departure decays and gets new randomness.
        last, options = self._evidence[-1], self.options
        elapsed = (stamp_ns - last.stamp_ns) * 1e-9
        remains = np.exp(-elapsed * self._rates)
        before = remains**2 * last.variance + (1.0 - remains**2) * square
        level = remains[:, None] * last.level
        change, total = observed - level, before + noise
        # 2. Density of the position, by that of the stated noise at zero.
        density = log_density((change**2).sum(axis=1), total, noise)
        # of what is constant and what has jumped to anywhere, the likelier goes on
        anywhere = self._reach**2 + noise
        jumps = log_changed(elapsed, options.sound_s)
        for row in (CONSTANT, REST):
            moved = jumps + log_density(observed[row] @ observed[row], anywhere, noise)
            if moved > density[row]:
                density[row], before[row], total[row] = moved, self._reach**2, anywhere
                level[row], change[row] = 0.0, observed[row]
        own = density_of_filter(predictive, elapsed / self._change_s)
        # 3. What is known of the past counts less and less, and what the filter foretold while it learned does not count.
        decay, gain = math.exp(-elapsed / options.memory_s), before / total
        if self._span(stamp_ns) < options.learning_s:
            decay = own = 0.0
            density[:] = 0.0
            moved, of_filter = self._moved.begin(residual), own
        else:
            right = decay * self._file_right(last)
            fault = float(np.logaddexp.reduce([last.moved.evidence, last.noisy, last.jitter]))
            of_filter = own + self._moved.filter_goes_on(last.filter, fault, elapsed, decay)
            moved = self._moved.add(last.moved, residual, elapsed, decay, right, of_filter)
        weight = decay * last.weight + 1.0
        self._evidence.append(
            DepartureEvidence(
                stamp_ns,
                level + gain[:, None] * change,
                before * (1.0 - gain),
                decay * last.departures + density,
                of_filter,
                moved,
                self.noisy.add(stamp_ns, residual) if decay else -math.inf,
                self.jitter.add(stamp_ns, residual, velocity, acceleration) if decay else -math.inf,
                np.maximum(last.since + density - max(own, density[REST]), 0.0),
                last.turned + (angle - last.turned) / weight,
                weight,
            )
        )
        if decay:
            before, new = decay * self._file_right(last), self._evidence[-1]
            departs = float(np.logaddexp.reduce(new.departures[:CONSTANT])) + self._prior
            departs = float(np.logaddexp(departs, self.smooth.add(stamp_ns, residual)))
            self.frame.add(stamp_ns, position, residual, before, self._file_right(new), departs)

    def _span(self, stamp_ns: int) -> float:
        """s from the first measurement."""
        return (stamp_ns - self._begin_ns) * 1e-9

    def probability(self, present: ModelErrorSize) -> float:
        """That the model errs by more than ``present``, which the filter counts on."""
        return float(self._weights(present).sum())

    def _weights(self, present: ModelErrorSize) -> Floats:
        """(h,) probabilities of all hypotheses beside the filter that counts on ``present``."""
        if self._compared is None or self._compared[0] is not present:
            self._compared = present, self._compare(present)
        return self._compared[1]

    def _compare(self, present: ModelErrorSize) -> Floats:
        """(h,) probabilities of the hypotheses by which the tip departs farther, and at least as fast; others have none."""
        none = np.zeros(len(self.sizes))
        if not self._evidence:
            return none
        last, options = self._evidence[-1], self.options
        farther = self.sizes > math.sqrt(options.steps) * present.position
        faster = self.sizes**2 / self.times >= present.position**2 / present.time
        tried = farther & faster
        if not tried.any():
            return none
        departs = last.departures[:CONSTANT]
        if (
            not present.position
        ):  # the filter's model error is rougher, and would be found too small again and again
            departs = np.logaddexp(departs, self.smooth.evidence)
        likely = np.where(tried, departs + self._prior, -np.inf)
        moved = np.logaddexp(self.frame.moving, self.frame.still)
        file_right = np.logaddexp(self._file_right(last), moved)
        most = max(file_right, float(likely.max()))
        weights: Floats = np.exp(likely - most)
        return weights / (weights.sum() + math.exp(file_right - most))

    @property
    def _prior(self) -> float:
        """Logarithm of the prior probability of one departure."""
        return math.log(self.options.prior / len(self.sizes))

    @staticmethod
    def _file_right(last: DepartureEvidence) -> float:
        """Logarithm of the evidence of a robot whose file is right, by a tracker of any noise."""
        ways = last.filter, last.moved.evidence, last.departures[CONSTANT], last.noisy, last.jitter
        return float(np.logaddexp.reduce(ways))

    def found(self, present: ModelErrorSize) -> ModelErrorSize | None:
        """The model error that is believed instead of ``present``, which the filter counts on; None where there is none."""
        weights = self._weights(present)
        if weights.sum() <= self.options.believed:
            return None
        if self._span(self._evidence[-1].stamp_ns) < self.options.least_s:
            return None
        # the filter's model error is of the first order, however smoothly the robot departs
        best = int(np.where(weights > 0.0, self._evidence[-1].departures[:CONSTANT], -np.inf).argmax())
        turned = self._evidence[-1].turned - self._rotation_noise**2
        rotation = max(math.sqrt(max(turned, 0.0)), present.rotation)
        return ModelErrorSize(float(self.sizes[best]), rotation, float(self.times[best]))

    def stamp_jitter(self, present_s: float) -> tuple[float, float]:
        """Probability that stamps scatter by more than ``present_s`` (s), which the filter counts on, and by how much most likely."""
        if self._scatter is None or self._scatter[0] != present_s:
            self._scatter = present_s, self._compare_jitter(present_s)
        return self._scatter[1]

    def _compare_jitter(self, present_s: float) -> tuple[float, float]:
        if not self._evidence:
            return 0.0, present_s
        last, sizes, evidence = self._evidence[-1], self.jitter.sizes, self.jitter.evidence
        likely = np.where(sizes > math.sqrt(self.jitter.options.steps) * present_s, evidence, -np.inf)
        sound = [last.filter, last.moved.evidence, last.departures[CONSTANT], last.noisy]
        departs = np.logaddexp.reduce([*last.departures[:CONSTANT], *self.smooth.evidence]) + self._prior
        others = [*sound, *evidence[sizes == 0.0], departs, self.frame.moving, self.frame.still]
        odds = np.logaddexp.reduce(likely) - np.logaddexp.reduce(others)
        return 1.0 / (1.0 + math.exp(min(-odds, 700.0))), float(sizes[likely.argmax()])

    @property
    def astray(self) -> bool:
        """Whether the filter has foretold the motion far worse than the open-loop run with one of the departures, since whenever that began.

        That is a CUSUM of the logarithm of their densities' ratio (Page 1954). Its mean time between false alarms is at least the odds, in
        measurements (Lorden 1971).
        """
        if not self._evidence:
            return False
        options, since = self.options, self._evidence[-1].since
        odds = options.believed / (1.0 - options.believed) / options.prior
        return float(since.max()) > math.log(odds * len(since))

    def forgive(self) -> None:
        """The filter goes on from the open-loop run; how it has foretold before is no sign of how it will."""
        if self._evidence:
            last = self._evidence.pop()
            self._evidence.append(last._replace(since=np.zeros_like(last.since)))

    def begin_again(self) -> None:
        """The filter goes on from the open-loop run with the model error or the jitter that was found, and foretells as well as that has done."""
        self.forgive()
        if self._evidence:
            self._compared = self._scatter = None
            last = self._evidence.pop()
            best = max(last.filter, last.departures[:REST].max(), self.jitter.evidence.max())
            self._evidence.append(last._replace(filter=float(best)))
