"""A tracker whose frame moves: measured positions that depart from the model steadily, whatever the robot does.

The field generator of a tracker is pushed, or its stand gives way. The filter follows slowly, as if an unknown force grew or the model erred more and
more, and nothing in its innovations tells. But a robot has no reason to depart from its model along a straight line in time. So measurements are also
compared with the open-loop run and a frame that shifts and turns at constant rates, since the time that speaks most for it (Viterbi). This competes
with the filter and the other departures by how well each foretells the next position (prequential evidence, Dawid 1984).

A frame that stands still again has its new place. One that was turned at once has, too; so has a robot whose encoder has slipped. Neither moves.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.estimation.filter.adapted_variances import AdaptationOptions
from ctr_dynamics.estimation.monitoring.densities import log_changed, log_density
from ctr_dynamics.estimation.monitoring.prequential_evidence import DRIFT_S, MEMORY_S
from ctr_dynamics.estimation.monitoring.taken_again import REMEMBERED, drop_from
from ctr_dynamics.kernels.motion_regression import correct_motions

Floats = NDArray[np.float64]
OFFSET, VELOCITY, TURN = slice(0, 3), slice(3, 6), slice(6, 9)
STILL = -1  # row of the frame that stands in a new place; those before it are of one that moves


@dataclass(frozen=True)
class FrameMotionOptions:
    """When a moving frame is believed.

    Attributes:
        slowest: m/s by the tracker's noise in m: what takes a second to be as large as that noise is left to the registration's tolerance.
            fastest: by the robot's length. steps: between one prior deviation of the rates and the next, as a factor.
        sound_s: s, mean time after which a frame begins to move, or is turned at once. fault_s: mean time after which it stands still again.
        drift_s: time in which the open-loop run goes astray by about the tracker's noise.
        memory_s: s, for which evidence counts.
        believed: probability from which on it is: that of even odds, since measurements that are not fused for a while cost as much as those that
            lead the estimate astray. doubted: probability below which it is not believed any more; in between, nothing changes.
        lasts_s: s, for which it has been that likely before it is believed. A vibration looks like a motion for less than half a period.
    """

    slowest: float = 1.0
    fastest: float = 1.0
    steps: float = 10.0
    sound_s: float = AdaptationOptions.sound_s
    fault_s: float = AdaptationOptions.fault_s
    drift_s: float = DRIFT_S
    memory_s: float = MEMORY_S
    believed: float = 0.5
    doubted: float = 0.1
    lasts_s: float = 1.0


class Motion(NamedTuple):
    """What the measurements up to ``stamp_ns`` say, for each prior deviation of the rates of a frame that moves, and for one that stands still.

    Attributes:
        began_ns: (r,) stamp since when. place: (r, 3) m, of the tip then, base axes.
        mean: (r, 9) departure at that time and place, m, velocity there, m/s, and turn rate, rad/s; of a frame that stands still the departure,
            nothing, and the rotation, rad. covariance: (r, 9, 9).
        evidence: (r,) its logarithm.
        probability: that the frame moves. likely_ns: stamp since when that has been above what is believed; None where it is not.
    """

    stamp_ns: int
    began_ns: NDArray[np.int64]
    place: Floats
    mean: Floats
    covariance: Floats
    evidence: Floats
    probability: float = 0.0
    likely_ns: int | None = None


class FrameMotion:
    """Evidence for a frame that moves.

    Args:
        noise: m per axis, deviation of a measured position.
        length: m, of the robot outside the base plate at most.
        options: when a motion is believed.
    """

    def __init__(self, noise: float, length: float, options: FrameMotionOptions | None = None) -> None:
        self.options = options = options or FrameMotionOptions()
        self._noise, self._length = noise, length
        slowest, fastest = options.slowest * noise, options.fastest * length
        count = 1 + math.ceil(math.log(max(fastest / slowest, 1.0)) / math.log(options.steps))
        speeds = np.geomspace(slowest, max(slowest, fastest), count)
        self._prior = np.zeros((count + 1, 9, 9))
        for prior, speed in zip(self._prior[:STILL], speeds, strict=True):
            np.fill_diagonal(prior, [noise**2] * 3 + [speed**2] * 3 + [(speed / length) ** 2] * 3)
        np.fill_diagonal(self._prior[STILL], [noise**2] * 3 + [0.0] * 3 + [1.0] * 3)  # by any angle
        self.clear()

    def clear(self) -> None:
        """Forget all measurements."""
        self._known: deque[Motion] = deque(maxlen=REMEMBERED)

    def add(
        self, stamp_ns: int, position: Floats, residual: Floats, before: float, now: float, other: float
    ) -> None:
        """Take in a measured tip; one of a stamp that is known takes its place.

        Args:
            stamp_ns: of its header.
            position: (3,) m, measured. residual: (3,) m, measured minus open-loop tip. Both in base axes.
            before, now: logarithm of the evidence of a robot whose file is right and a tracker that has not moved, up to the measurement before,
                as it counts now, and up to this one.
            other: that of all else that may be right, up to this one.
        """
        known, options, noise = self._known, self.options, self._noise**2
        drop_from(known, stamp_ns)
        rows = len(self._prior)
        # by Cayley's formula, a rotation moves a point by the cross product of a vector with the middle between its places
        middle = position - 0.5 * residual
        if not known:
            evidence = np.full(rows, now + log_changed(AdaptationOptions.shortest_interval, options.sound_s))
            start = np.full(rows, stamp_ns), np.tile(middle, (rows, 1)), _at_rest(residual, rows)
            known.append(Motion(stamp_ns, *start, self._prior, evidence))
            return
        last = known[-1]
        elapsed = (stamp_ns - last.stamp_ns) * 1e-9
        begins = log_changed(elapsed, options.sound_s)
        # 1. It has moved or stood still since before; the open-loop run goes astray slowly.
        past = self._with_end(last, elapsed)
        past.covariance[:, range(3), range(3)] += noise * elapsed / options.drift_s
        since = (stamp_ns - past.began_ns) * 1e-9
        since[STILL] = 1.0
        _, began, place, mean, covariance, evidence, *_ = past
        density = np.empty(rows)
        correct_motions(mean, covariance, since, middle - place, residual, noise, density)
        ended = float(evidence[STILL])
        evidence += density
        # 2. Or it was turned at once since the measurement before, or begins to move with this one.
        anywhere = log_density(residual @ residual, self._length**2 + noise, noise)
        still = np.logaddexp(before, ended) + begins + anywhere
        still_now = max(still, float(evidence[STILL]))
        moving = np.logaddexp(now, still_now) + begins - math.log(rows - 1)
        fresh = np.append(np.full(rows - 1, moving), still)
        new = fresh > evidence
        evidence = np.where(new, fresh, evidence)
        began[new], place[new], mean[new] = stamp_ns, middle, _at_rest(residual, int(new.sum()))
        covariance[new] = self._prior[new]
        # 3. Against all else.
        otherwise = np.logaddexp(np.logaddexp(now, other), evidence[STILL])
        probability = 1.0 / (1.0 + math.exp(min(otherwise - np.logaddexp.reduce(evidence[:STILL]), 700.0)))
        likely = None
        if probability > options.believed:
            likely = stamp_ns if last.likely_ns is None else last.likely_ns
        known.append(Motion(stamp_ns, began, place, mean, covariance, evidence, probability, likely))

    def _with_end(self, last: Motion, elapsed: float) -> Motion:
        """``last`` as it counts ``elapsed`` (s) later; what moved has stood still since then, if that is likelier than that it did before."""
        options = self.options
        evidence = math.exp(-elapsed / options.memory_s) * last.evidence
        began, place = last.began_ns.copy(), last.place.copy()
        mean, covariance = last.mean.copy(), last.covariance.copy()
        best = int(evidence[:STILL].argmax())
        ended = evidence[best] + log_changed(elapsed, options.fault_s)
        if ended > evidence[STILL]:
            since = (last.stamp_ns - last.began_ns[best]) * 1e-9
            stops = np.zeros((9, 9))
            stops[OFFSET, OFFSET], stops[OFFSET, VELOCITY] = np.eye(3), since * np.eye(3)
            stops[TURN, TURN] = since * np.eye(3)
            began[STILL], place[STILL] = last.stamp_ns, place[best]
            mean[STILL], covariance[STILL] = stops @ mean[best], stops @ covariance[best] @ stops.T
            evidence[STILL] = ended
        return Motion(last.stamp_ns, began, place, mean, covariance, evidence)

    @property
    def moving(self) -> float:
        """Logarithm of the evidence that the frame moves at any rates."""
        return float(np.logaddexp.reduce(self._known[-1].evidence[:STILL])) if self._known else -math.inf

    @property
    def still(self) -> float:
        """Logarithm of the evidence that the frame stands in a new place."""
        return float(self._known[-1].evidence[STILL]) if self._known else -math.inf

    @property
    def probability(self) -> float:
        """That the frame moves."""
        return self._known[-1].probability if self._known else 0.0

    def moves(self, moved: bool) -> bool:
        """Whether it is believed that the frame moves. ``moved``: whether it was at the measurement before."""
        options = self.options
        if moved or not self._known:
            return self.probability > options.doubted
        last = self._known[-1]
        return last.likely_ns is not None and last.stamp_ns - last.likely_ns > 1e9 * options.lasts_s

    def rates(self, at: Floats) -> tuple[Floats, Floats]:
        """(3,) m/s, by which the likeliest motion moves what is measured ``at`` a place (3,) m, and its turn rate (3,) rad/s; base axes."""
        last = self._known[-1]
        best = int(last.evidence[:STILL].argmax())
        turn = last.mean[best, TURN]
        return last.mean[best, VELOCITY] + np.cross(turn, at - last.place[best]), turn


def _at_rest(departure: Floats, count: int) -> Floats:
    """(count, 9) means of a motion that begins with a ``departure`` (3,) m."""
    mean = np.zeros((count, 9))
    mean[:, OFFSET] = departure
    return mean
