"""Checks of the known load on the tip: numbers, frame, stamps, and forces that no such robot can carry."""

from __future__ import annotations

import math
from collections.abc import Sequence

from ctr_dynamics.io.messages.topics import accepts_frame
from ctr_dynamics.robot import Cantilever, Robot, cantilever
from ctr_dynamics.sensing.checks import rejection_texts
from ctr_dynamics.sensing.checks.check_limits import CheckOptions
from ctr_dynamics.sensing.checks.verdicts import ACCEPT, Findings, Kind, Verdict


class LoadChecks:
    """Known loads on the tip, in the order of arrival.

    Args:
        robot: for its stiffness; None: only the largest force on any robot is a limit.
    """

    def __init__(self, robot: Robot | None = None, options: CheckOptions | None = None) -> None:
        self.robot, self.options = robot, options or CheckOptions()
        self.limits = self.options.limits
        self.findings = Findings("load")
        self._cantilever: Cantilever | None = None
        if robot is not None:
            self.follow_translations(robot.rest.beta.value)
        self.forget()

    def forget(self) -> None:
        """Start again, as after a reset; findings stay."""
        self._newest_ns: int | None = None

    def follow_translations(self, translations: Sequence[float]) -> None:
        """Tell where the tubes are: (N,) m."""
        if self.robot is not None:
            self._cantilever = cantilever(self.robot, translations)

    def check(
        self,
        stamp_ns: int,
        arrival_ns: int | None,
        force: Sequence[float],
        torque: Sequence[float],
        frame_id: str = "",
    ) -> Verdict:
        """Verdict on a load: ``force`` (3,) N and ``torque`` (3,) N m on the tip, in base axes."""
        at = stamp_ns if arrival_ns is None else arrival_ns
        if not accepts_frame(frame_id, self.options.frame_id):
            text = rejection_texts.load_in_other_frame(frame_id, self.options.frame_id)
            return self._drop(Kind.OTHER_FRAME, at, 0.0, "", text)
        if not all(map(math.isfinite, (*force, *torque))):
            text = rejection_texts.not_finite("load", stamp_ns)
            return self._drop(Kind.NOT_FINITE, at, 0.0, "", text)
        if stamp_ns == 0 and self._newest_ns is not None:
            text = "stamp of the load is zero; fill in header.stamp; the load was left out"
            return self._drop(Kind.STAMP_ZERO, at, 0.0, "s", text)
        if arrival_ns is not None and 0 < stamp_ns - arrival_ns <= self.limits.same_clock_s * 1e9:
            ahead_s = (stamp_ns - arrival_ns) * 1e-9
            if ahead_s > self.limits.other_clock_s:
                text = f"stamp of the load is {ahead_s:.3f} s after its arrival, limit {self.limits.other_clock_s:g} s; synchronise the clocks"
                return self._drop(Kind.STAMP_AHEAD, at, ahead_s, "s", text)
        size, moment = math.hypot(*force), math.hypot(*torque)
        if size or moment:
            wrong = self._beyond_reason(at, size, moment)
            if wrong is not None:
                return wrong
        self._newest_ns = stamp_ns
        return ACCEPT

    def _beyond_reason(self, at: int, size: float, moment: float) -> Verdict | None:
        """A load that would bend the robot beyond anything it bears."""
        limits, beam = self.limits, self._cantilever
        force_limit, moment_limit = limits.force, math.inf
        if beam is not None:
            force_limit = min(force_limit, limits.bending_rad / beam.turn)
            moment_limit = min(limits.bending_rad / beam.turn_by_moment, limits.force * beam.length)
        if size <= force_limit and moment <= moment_limit:
            return None
        wrong, limit, unit = (size, force_limit, "N") if size > force_limit else (moment, moment_limit, "N m")
        why = f"it would turn this robot's tip by {limits.bending_rad:g} rad, or no such robot bears it"
        text = f"load of {wrong:.4g} {unit}, limit {limit:.3g} {unit} ({why}): other units, or a sensor fault? left out"
        return self._drop(Kind.BEYOND_REASON, at, wrong, unit, text)

    def _drop(self, kind: Kind, at: int, worst: float, unit: str, text: str) -> Verdict:
        self.findings.add(kind, at, worst, unit, text)
        return Verdict("drop", kind, text)
