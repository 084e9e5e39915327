"""Which steps are due: those that the joints cover (policy `wait`), or those whose time has come (`predict`)."""

from __future__ import annotations

from ctr_dynamics.estimation.estimator_options import EstimatorOptions
from ctr_dynamics.estimation.inputs.input_buffer import InputBuffer
from ctr_dynamics.estimation.timeline import Timeline
from ctr_dynamics.io.messages.topics import STEP_NS


class StepSchedule:
    """Tells which steps of ``timeline`` are due, by the joints of ``inputs`` and by the time.

    Args:
        timeline: where the estimator stands.
        inputs: joints that have come.
        options: of the estimator.
    """

    def __init__(self, timeline: Timeline, inputs: InputBuffer, options: EstimatorOptions) -> None:
        self._timeline, self._inputs, self._options = timeline, inputs, options

    def due(self, k: int, now_ns: int | None) -> bool:
        """Whether step ``k`` is due at ``now_ns`` (on the stamps' clock); without a time, whether the joints cover it."""
        if self._timeline.t0_ns is None:
            return False
        stamp = self._timeline.stamp(k)
        known = stamp <= self._inputs.joints.known_until
        if now_ns is None:
            return known
        if known:
            return stamp <= now_ns  # joints that are stamped ahead do not take the outputs with them
        return stamp <= (now_ns if self._inputs.extrapolating else now_ns - self._inputs.timeout_ns)

    @property
    def lead_ns(self) -> int:
        """How long before its stamp a step is to be begun, so that it is out when it is due; 0 where steps wait for their joints."""
        return self._options.lead_ns if self._inputs.extrapolating else 0

    def gap(self, now_ns: int | None) -> int:
        """Steps that are due after a gap of the joints, where they are more than can be caught up with; else 0."""
        timeline, inputs, largest = self._timeline, self._inputs, self._options.largest_gap
        stamps = inputs.joints.stamps
        if timeline.t0_ns is None or timeline.k < 0 or len(stamps) < 2:
            return 0
        newest = stamps[-1]
        until = newest if now_ns is None or not inputs.extrapolating else max(now_ns, newest)
        behind = (until - timeline.t0_ns) // STEP_NS - timeline.k
        if behind <= largest:
            return 0
        without_gap = newest - stamps[-2] <= largest * STEP_NS  # a long call: every step is taken
        return 0 if without_gap else behind

    def skip_to_newest(self) -> None:
        """Have the step next to the newest joints be the next."""
        assert self._timeline.t0_ns is not None
        newest = self._inputs.joints.stamps[-1]
        self._timeline.k = (newest - self._timeline.t0_ns) // STEP_NS - 1
