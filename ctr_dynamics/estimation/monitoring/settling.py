"""After a start or a gap of the joints in motion the model does not know how the robot moves; outputs wait until measurements agree with it.

A model that starts at rest lacks the vibration that the robot has. The filter then begins again from the open-loop run, with vibrations of any phase
in its covariance, and measurements tell. Nothing is published until some in a row have agreed. Without measurements the vibration has to die
down. Where measurements come and do not agree until then, they have led the estimate astray: the filter begins once more.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics import chi_square
from ctr_dynamics.estimation.step_output import Innovation

Floats = NDArray[np.float64]
STARTED_IN_MOTION = "the estimate has started while the robot moved"
DISAGREED = "measurements have not agreed with the model since it started, and the filter began again"


@dataclass(frozen=True)
class SettlingOptions:
    """When the outputs count again.

    Attributes:
        agreeing: measurements in a row that agree, 0.2 s at 40 Hz: about a period of a slow vibration.
        longest_s: s. Without measurements the outputs count again after that time.
        watched_s: s after a start in which the joints tell whether the robot moves.
        vibrating: probability with which the change of the open-loop residual between the first measurements is more than noise. As near as that,
            measurements agree.
        compared_s: s after a start in which they are compared.
        moved_rad, moved_m: by any joint in that time or over a gap. Less makes no vibration that counts.
    """

    agreeing: int = 8
    longest_s: float = 1.2
    watched_s: float = 0.05
    moved_rad: float = 0.01
    moved_m: float = 5e-4
    vibrating: float = 0.9999
    compared_s: float = 0.2


class Settling:
    """Whether the outputs have to wait, and why.

    Args:
        noise: m per axis, deviation of a measured position.
        encoder_noise: rad, deviation of a rotation that is read.
        options: when the outputs count again.

    Attributes:
        apart: m, how far a measurement lay from the open-loop run at most since the start.
        begun: whether the robot has been found to vibrate as the model does not, or measurements have not agreed; who acts on it sets it back.
        vibrates: whether the robot may still vibrate then.
    """

    def __init__(self, noise: float, encoder_noise: float, options: SettlingOptions | None = None) -> None:
        self.options = options or SettlingOptions()
        self._turned = encoder_noise * math.sqrt(2.0 * chi_square.quantile(self.options.vibrating, 1))
        self._limit = 2.0 * noise**2 * chi_square.quantile(self.options.vibrating, 3)
        self.clear()

    def clear(self) -> None:
        """Nothing to wait for."""
        self._since_ns: int | None = None
        self._why = ""
        self._agreed = 0
        self._measured = False  # since then
        self._newest_ns = 0  # stamp of the newest measurement
        self._moving_ns: int | None = None  # when the estimate started in motion
        self.begun = self.vibrates = False
        self.apart = 0.0
        self._start_ns: int | None = None
        self._residual: Floats | None = None
        self._compared = False  # two measurements
        # stamp and joints of a start, until they have told whether the robot moves; whether any within the watched time have been looked at
        self._watched: tuple[int, Floats] | None = None
        self._looked = False

    def start(self, stamp_ns: int, joints: Floats) -> None:
        """The model starts at rest at ``stamp_ns``, with the ``joints`` (2 N,) of that time."""
        self.clear()
        self._start_ns, self._watched = stamp_ns, (stamp_ns, joints)

    def watch(self, stamp_ns: int, joints: Floats) -> None:
        """Joints of ``stamp_ns`` tell whether the robot moved when the model started."""
        if self._watched is None:
            return
        began, at_start = self._watched
        if stamp_ns <= began:
            return
        after = stamp_ns > began + self.options.watched_s * 1e9
        # where a start took long, the first joints behind the watched time are the only ones that tell
        tells = not (after and self._looked)
        self._looked = True
        if tells and self.moved((joints - at_start).tolist(), self._rotated(stamp_ns - began)):
            self._watched = None
            self.begin(began, STARTED_IN_MOTION)
        elif after:
            self._watched = None

    def begin(self, stamp_ns: int, why: str, vibrating: bool = True) -> None:
        """The model does not know how the robot moves at ``stamp_ns``, and ``why``, in words; ``vibrating``: it may vibrate as the model does not."""
        self._since_ns, self._why, self._agreed, self._measured = stamp_ns, why, 0, False
        self.begun = self.vibrates = vibrating
        self._moving_ns = stamp_ns if why == STARTED_IN_MOTION else None

    def _rotated(self, elapsed_ns: int) -> float:
        """rad, by which a joint has turned in that time after a start where the robot moves: the same rate, and more than noise."""
        options = self.options
        part = min(elapsed_ns * 1e-9 / options.watched_s, 1.0)
        return max(part * options.moved_rad, min(self._turned, options.moved_rad))

    def moved(self, change: Sequence[float], least_rad: float | None = None) -> bool:
        """Whether joints that changed by ``change`` (2 N,), rotations (rad) and then translations (m), moved the robot.

        ``least_rad``: of a rotation; None stands for that of a gap.
        """
        n = len(change) // 2
        options = self.options
        least = options.moved_rad if least_rad is None else least_rad
        return any(abs(x) > least for x in change[:n]) or any(abs(x) > options.moved_m for x in change[n:])

    def take(self, innovations: Sequence[Innovation], shifted: bool = False) -> None:
        """Count measurements of this step that agree. Those of a tracker that is taken to be ``shifted`` do not."""
        for innovation in innovations:
            self._compare(innovation)
            if self._since_ns is None:
                continue
            if innovation.stamp_ns >= self._since_ns and innovation.dof:
                self._measured, self._newest_ns = True, innovation.stamp_ns
                agrees = (
                    innovation.accepted and not innovation.reason and not shifted and self._near(innovation)
                )
                self._agreed = self._agreed + 1 if agrees else 0

    def _near(self, innovation: Innovation) -> bool:
        """Whether a position is as near to the estimate as where both err by the stated noise.

        Within the gate is not enough: the filter may not know the tip, or take the tracker to be noisier than stated.
        """
        return float(np.nansum(innovation.residual[:3] ** 2)) <= self._limit

    def _compare(self, innovation: Innovation) -> None:
        """A robot that vibrates where the model starts at rest shows in how the open-loop residual changes."""
        start, motion = self._start_ns, innovation.motion
        if motion is not None:
            self.apart = max(self.apart, float(np.linalg.norm(motion.residual)))
        if start is None or motion is None or innovation.stamp_ns < start:
            return
        if innovation.stamp_ns > start + self.options.compared_s * 1e9:
            self._start_ns = self._residual = None
            return
        before, self._residual = self._residual, motion.residual
        if before is None:
            return
        # at a turning point of a vibration the residual stands still
        self._compared |= self._near(innovation)
        change = motion.residual - before
        if float(change @ change) > self._limit and self._since_ns is None:
            self.begin(innovation.stamp_ns, STARTED_IN_MOTION)

    def lacks_vibration(self, stamp_ns: int) -> bool:
        """Whether the open-loop run lacks a vibration at ``stamp_ns`` that the robot has: how measurements follow it tells little of anything but the
        tracker's delay."""
        return self._moving_ns is not None and stamp_ns <= self._moving_ns + self.options.longest_s * 1e9

    def unseen(self, stamp_ns: int) -> float | None:
        """None where something has told how the robot moved when the model started: two joint states, and two measurements, of which the
        second agreed, unless none come. Else ``apart``.
        """
        start = self._start_ns
        waits = start is not None and not self._compared and stamp_ns <= start + self.options.compared_s * 1e9
        if not waits and (self._watched is None or self._looked):
            return None
        return self.apart

    def problem(self, stamp_ns: int, on_time: Callable[[], bool] = lambda: True) -> str:
        """Why the output of ``stamp_ns`` does not count yet; empty where it does. ``on_time`` tells whether the tracker is seen not to be late."""
        if self._since_ns is None or (self._why == DISAGREED and not self._measured):
            return ""
        options = self.options
        waited = (stamp_ns - self._since_ns) * 1e-9
        if (self._agreed >= options.agreeing and on_time()) or waited > options.longest_s:
            astray = self._measured and self._agreed < options.agreeing and self._why != DISAGREED
            self._since_ns = None
            if not astray:
                return ""
            self.begin(stamp_ns, DISAGREED)
            # where nothing measures any more, nothing would tell how; and it has died down
            self.vibrates = stamp_ns - self._newest_ns <= options.compared_s * 1e9
        return f"{self._why}: how it moves is not known until {options.agreeing} measurements in a row agree, or for {options.longest_s:g} s"
