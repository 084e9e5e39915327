"""A known load that has jumped and that nothing confirms: a sensor that sends nonsense bends the model, not the robot.

From the jump on, a second open-loop run goes on without it. Measurements tell which of the two runs the robot follows, by their likelihoods. Until
they do, two and a half published deviations reach from one run to the other. A load that the robot does not follow is left out from the jump on.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.estimation.discretisation import VibrationErrors
from ctr_dynamics.estimation.inputs.input_buffer import InputBuffer, LoadChange
from ctr_dynamics.estimation.inputs.run_inputs import InterpolatedInputs, RunInputs
from ctr_dynamics.estimation.monitoring.delay_search import DelaySearchOptions
from ctr_dynamics.estimation.open_loop import OpenLoopRun
from ctr_dynamics.estimation.timeline import seconds
from ctr_dynamics.model.simulator import Inputs
from ctr_dynamics.sensing import TrackerModel

Floats = NDArray[np.float64]
SEEN = 400  # measurements: those of as long as a load may come late
AXES = 3  # of a position
REACHED = 2.5  # published deviations, from one run to the other; three are the promise


@dataclass(frozen=True)
class LoadDoubtOptions:
    """When a known load is taken for wrong.

    Attributes:
        least: by the tracker's noise; a load that moves the resting tip by less is within what is published anyway.
        relative_error: of the model in the movement by a load: payloads and stiffnesses of a file that is not calibrated.
        prior: probability that a load that jumps is wrong. believed: probability from which on it is left out.
        confirmed: odds of the measurements for it, from which on it is in doubt no more; strong evidence after Jeffreys (1961).
        followed: mean square of what remains of the measurements without the load, per axis and by its variance, up to which the robot does not
            bear it. It is 1 where that is so, and 4 where the load moves the robot as far as the model says.
        longest_s: s, by which a tracker may be late. For so long a robot that bears the load may seem to stand still.
        expires_s: s after the last jump, from which on the load is taken as it is said.
    """

    least: float = 3.0
    relative_error: float = 0.3
    prior: float = 0.01
    believed: float = 0.99
    confirmed: float = 10.0
    followed: float = 1.5
    longest_s: float = DelaySearchOptions.longest_s
    expires_s: float = 1.0


class HeldLoad(RunInputs):
    """Inputs of a run on which the known load stays as it was.

    Attributes:
        held: (6,) N, N m.
    """

    def __init__(self, interpolated: InterpolatedInputs, load: Floats) -> None:
        super().__init__(interpolated, load, np.zeros((len(load), 0)), np.zeros(0))
        self.held = np.zeros(6)

    def stages(self, times: Floats) -> tuple[Floats, Inputs]:
        """Inputs at all stages of a step."""
        rows, inputs = super().stages(times)
        wrench = slice(3 * self.interpolated.n, 3 * self.interpolated.n + 6)
        # those at the last stage are the wrench of ``inputs``, too
        rows[:, wrench] = self.load[wrench] + self.held
        return rows, inputs


class LoadDoubt:
    """The last jump of the known load, and what measurements say of it.

    Args:
        without: the run on which the load stays as it was, driven by ``held``.
        inputs: with the load that is known.
        modes: tell how far a load moves the tip.
        noise: m per axis, deviation of a measured position.
        options: when a load is taken for wrong.

    Attributes:
        begin_ns: stamp from which on the load is in doubt; None where it is not.
    """

    def __init__(
        self, without: OpenLoopRun, held: HeldLoad, inputs: InputBuffer, modes: VibrationErrors, noise: float,
        options: LoadDoubtOptions | None = None,
    ) -> None:  # fmt: skip
        self.options = options or LoadDoubtOptions()
        self._without, self._held, self._inputs = without, held, inputs
        self._modes, self._noise = modes, noise
        # own times (ns) of the last measurements, and how far they lay from the open-loop run (3,) m; the last one before the jump
        self._seen: deque[tuple[float, Floats]] = deque(maxlen=SEEN)
        self._before = np.zeros(3)
        self._variance = noise**2  # m^2 per axis, of a residual of the open-loop run before the jump
        self.clear()

    def clear(self) -> None:
        """Doubt nothing."""
        self.begin_ns: int | None = None
        self._jump_ns = 0  # of the last jump
        self._k: int | None = None  # the last step of the run without the load; None before its first
        # by stamp (ns): log likelihood ratio of the load to none, and the square without it
        self._taken: dict[int, tuple[float, float]] = {}

    def load_changed(self, change: LoadChange) -> None:
        """The known load has changed; a jump that moves the tip is in doubt."""
        if not change.jumped or self._modes.deflection(change.difference) <= self.options.least * self._noise:
            return
        if self.begin_ns is None:
            self.clear()
            self.begin_ns = change.begin_ns
            self._held.held = self._inputs.load.at(change.begin_ns)[0]
            before = [residual for own_ns, residual in self._seen if own_ns <= change.begin_ns]
            self._before = before[-1] if before else np.zeros(3)
            self._variance = max(float(np.mean(np.var(before, axis=0))) if before else 0.0, self._noise**2)
        self._jump_ns = change.end_ns

    # -- the run without the load --

    def before_step(self, k: int, open_loop: OpenLoopRun) -> None:
        """Begin with the state of the ``open_loop`` run before step ``k``, where that is the first one with the load."""
        if self.begin_ns is None or self._k is not None or self._inputs.timeline.stamp(k) <= self.begin_ns:
            return
        assert open_loop.state is not None
        self._without.start(open_loop.state.copy(), seconds(k - 1))
        self._k = k - 1

    def after_step(self, k: int) -> None:
        """Take step ``k`` without the load; one that is taken again with joints that are known better is not."""
        if self._k is None or k != self._k + 1:
            return
        without, t = self._without, seconds(k - 1)
        assert without.state is not None
        if without.simulator.step(without.state, t, without.inputs_at).ok:
            without.append_tip(seconds(k))
            self._k = k
        else:
            self.clear()

    def inflate(self, covariance: Floats, mean: Floats) -> float:
        """Have two and a half deviations reach to the run without the load, which is (13,) ``mean`` of the tip with it; returns how far that is, m.

        ``covariance`` (12, 12) of the tip is changed in place.
        """
        if self._k is None:
            return 0.0
        apart = (mean - self._without.tips.last.mean) / REACHED
        for own, part in ((slice(0, 3), apart[:3]), (slice(6, 9), apart[7:10])):
            covariance[own, own] += np.multiply.outer(part, part)
        return REACHED * math.hypot(*apart[:3].tolist())

    # -- measurements --

    def take(
        self, stamp_ns: int, own_s: float, residual: Floats, position: Floats, tracker: TrackerModel
    ) -> None:
        """A measurement; one that confirms the load ends the doubt.

        Args:
            stamp_ns: of its header. own_s: its own time, s.
            residual: (3,) m, measured minus open-loop tip, whose ``position`` (3,) m that was.
            tracker: as the filter counts on it.
        """
        begin_ns, options = self.begin_ns, self.options
        own_ns = self._inputs.timeline.stamp(0) + own_s * 1e9
        if begin_ns is None:
            self._seen.append((own_ns, residual))
        if begin_ns is None or own_ns <= begin_ns:
            return
        found = self._without.observed(tracker, own_s) if self._k is not None else None
        if found is None:
            return
        moved = position - found[0].position
        with_load = residual - self._before
        square = 2.0 * self._variance + options.relative_error**2 * float(moved @ moved)
        by_load = float(with_load @ with_load) / square
        remains = with_load + moved
        by_none = float(remains @ remains) / square
        self._taken[stamp_ns] = 0.5 * (by_none - by_load), by_none
        if self._right > math.log(options.confirmed):
            self.clear()

    @property
    def _right(self) -> float:
        """Logarithm of the likelihood ratio of the load to none."""
        return sum(ratio for ratio, _ in self._taken.values())

    @property
    def seems_wrong(self) -> bool:
        """Whether the robot moves as without the load so far. Such measurements are not fused, and nothing else is concluded from them."""
        squares = [square for _, square in self._taken.values()]
        return self._right < -self._sure and sum(squares) <= self.options.followed * AXES * len(squares)

    @property
    def _sure(self) -> float:
        """Logarithm of the odds that are believed."""
        return math.log(self.options.believed / (1.0 - self.options.believed))

    def wrong(self, stamp_ns: int) -> bool:
        """Whether the load is wrong by what is known up to ``stamp_ns``; one on which nothing is decided for long is in doubt no more.

        A robot that bears the load may not show it yet, as its tracker may be late. One that stands still for longer does not bear it.
        """
        if self.begin_ns is None:
            return False
        options, right = self.options, self._right
        if stamp_ns - self._jump_ns > options.expires_s * 1e9:
            self.clear()
            return False
        shown = stamp_ns - self.begin_ns > options.longest_s * 1e9
        unlikely = math.log((1.0 - options.prior) / options.prior)
        return shown and self.seems_wrong and right < -self._sure - unlikely
