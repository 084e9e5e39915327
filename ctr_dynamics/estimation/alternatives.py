"""What else than the filter counts on may be right: another timing of the tracker, a frame that moves, stamps that scatter, a larger model error.

Measurements are compared with these alternatives after the output of their step, which does not wait for it. Where one of them is believed, the
fused run goes on from the open-loop run with it, before the next step.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.estimation.discretisation import VibrationErrors
from ctr_dynamics.estimation.filter.ekf import RodEkf
from ctr_dynamics.estimation.filter.filter_records import Update
from ctr_dynamics.estimation.inputs.input_buffer import InputBuffer
from ctr_dynamics.estimation.monitoring.end_of_jitter import EndOfJitter
from ctr_dynamics.estimation.monitoring.health import Health
from ctr_dynamics.estimation.monitoring.model_error_search import ModelErrorSearch
from ctr_dynamics.estimation.monitoring.moving_start import MovingStart
from ctr_dynamics.estimation.monitoring.response_search import in_words
from ctr_dynamics.estimation.monitoring.timing_in_motion import TimingInMotion
from ctr_dynamics.estimation.monitoring.tracker_timing import TrackerTiming
from ctr_dynamics.estimation.open_loop import OpenLoopRun
from ctr_dynamics.estimation.step_output import MOVING_FRAME, UNKNOWN_DELAY, MotionPoint
from ctr_dynamics.estimation.timeline import seconds
from ctr_dynamics.kernels import rotations
from ctr_dynamics.kernels.tracker_measurement import pose_difference
from ctr_dynamics.sensing.tracker import ROTATION, TRANSLATION

Floats = NDArray[np.float64]


class Compared(NamedTuple):
    """A measurement that has been compared with both runs.

    Attributes:
        stamp_ns: of its header. time_s: its own time, s from the first step.
        quaternion: (4,) wxyz, measured.
        motion: the open-loop run there. tips: stamps (k,) s and positions (k, 3) m of that run.
        update: what the filter has made of it. delay: with which delay beyond the nominal one, s. stamp_error_s: 1-sigma that is stated of its stamp.
    """

    stamp_ns: int
    time_s: float
    quaternion: Floats
    motion: MotionPoint
    tips: tuple[Floats, Floats]
    update: Update
    delay: float
    stamp_error_s: float


class Alternatives:
    """Evidence for what else may be right, and what follows from it for the filter.

    Args:
        ekf: the filter, whose tracker and model error change with what is believed.
        inputs: with the measurement queue, which waits for poses that are stamped too early.
        health: where it is noted.

    Attributes:
        timing, model_error, end_of_jitter: the searches. usual_timing: that of timing where the open-loop run moves as the robot does.
        probability: that anything else is right than the filter counts on. reason_not_to_fuse: that of what measurements are not fused for.
        late: whether the tracker is late by a time that is not known yet. doubted: whether its latency has probably changed, and has to last before
            it is followed. moving: whether its frame moves. Measurements are then compared and not fused.
    """

    def __init__(self, ekf: RodEkf, inputs: InputBuffer, health: Health) -> None:
        self._ekf, self._inputs, self._health = ekf, inputs, health
        robot = ekf.model.robot
        noise, length, file = robot.tracker.noise, float(robot.lengths[0]), ekf.tracker.state_sigma
        registered = math.hypot(file[TRANSLATION].max(), length * file[ROTATION].max())
        change_s = ekf.options.force_change
        self._moves = noise.position.value, change_s, length, registered
        self.usual_timing = TrackerTiming(*self._moves, ekf.tracker)
        self.timing: TrackerTiming | TimingInMotion = self.usual_timing
        self.model_error = ModelErrorSearch(
            noise.position.value, noise.rotation.value, length, registered, change_s
        )
        self.end_of_jitter = EndOfJitter()
        self.clear()

    def clear(self) -> None:
        """Forget all measurements."""
        self.usual_timing.clear()
        self.timing = self.usual_timing
        self.model_error.clear()
        self.end_of_jitter.clear()
        self.late = self.doubted = self.moving = False
        self._compared: list[Compared] = []
        self._news = False  # whether measurements have counted since anything was concluded
        self.probability = self.reason_not_to_fuse = 0.0
        self._stamp_error_s = 0.0  # that is stated of the last stamp
        self._scatters_since = 0  # step, since when stamps probably scatter
        # step, since when the latency has probably changed; None where it has not
        self._doubted_since: int | None = None

    def starts_in_motion(self, modes: VibrationErrors) -> None:
        """The open-loop run lacks the vibration that the robot has, in its ``modes``; the filter begins again with one of any phase."""
        self.count()
        if self.timing is self.usual_timing:
            self.usual_timing.clear()
            self.timing = TimingInMotion(MovingStart(*self._moves, modes))
        else:
            self.timing.begin_again(self._ekf.expected, self._ekf.delay)
        self._weigh()

    def clear_model_error(self) -> None:
        """Forget what measurements told of the model's error."""
        self.count()
        self.model_error.clear()
        self._weigh()

    @property
    def not_fused(self) -> str:
        """Why measurements are compared and not fused; empty where they are."""
        return UNKNOWN_DELAY if self.late or self.doubted else MOVING_FRAME if self.moving else ""

    @property
    def late_by_m(self) -> float | None:
        """m between measurements and open-loop run with the delay or response that brings them together most; None where they are fused with one."""
        return self.timing.apart if self.late else None

    # -- evidence --

    def add(self, compared: Compared) -> None:
        """Take in a measurement. It counts with the next :meth:`count`."""
        self._compared.append(compared)

    def count(self) -> None:
        """Have the measurements count that have been taken in."""
        if not self._compared:
            return
        expected = self._ekf.expected
        for stamp_ns, time_s, quaternion, motion, tips, update, delay, stamp_error_s in self._compared:
            self._stamp_error_s = stamp_error_s
            assert update.predictive is not None
            seen = motion.position + motion.residual
            self.end_of_jitter.add(stamp_ns, update.half_jitter_gain)
            newest_s = time_s - expected.model.delay
            self.timing.add(stamp_ns, newest_s, seen, tips, update.predictive, expected, delay)
            if not self.timing.lacking_m:
                self.timing = self.usual_timing
            if expected.slower:
                expected.refine(*self.usual_timing.response.refined(expected.response))
            self.model_error.add(
                stamp_ns,
                seen,
                motion.residual,
                motion.velocity,
                motion.acceleration,
                self._turn(quaternion, motion.quaternion),
                update.predictive,
            )
        self._compared.clear()
        self._news = True

    def _turn(self, quaternion: Floats, open_loop: Floats) -> Floats:
        """Rotation vector (a,) rad from that of the ``open_loop`` tip to a measured ``quaternion``, (4,) wxyz each, on the measured axes."""
        tracker, none = self._ekf.tracker, np.zeros(3)
        expected = rotations.multiply(tracker.rotation, open_loop)
        return pose_difference(none, quaternion, none, expected, tracker.free)[3:][tracker.mask[3:]]

    # -- conclusions --

    def conclude(self, open_loop: OpenLoopRun, k: int, moves_as_modelled: bool = True) -> bool:
        """Whether measurements show that something else is right: the fused run is to go on from the open-loop run at step ``k``.

        The filter counts on that then. Where measurements are not fused, nothing is concluded; nothing but the timing where the open-loop run
        does not move as the robot does.
        """
        self.count()
        if not self._health.fusing:
            self.moving, self._doubted_since = False, None
        self._doubt(k)
        if not self._news:
            return False
        self._news = False
        # poses of a frame that moves say nothing of their timing: a turn looks like a latency that grows
        again = self._health.fusing and (
            (not self.moving and self._follow_timing(k))
            or (moves_as_modelled and self._follow_other(open_loop, k))
        )
        self._weigh()
        return again

    def _follow_other(self, open_loop: OpenLoopRun, k: int) -> bool:
        """Anything else than another timing."""
        return (
            self._follow_jitter(k)
            or self._leave_moving_frame(open_loop)
            or self._follow_model_error()
            or self._leave_refuted()
        )

    def _weigh(self) -> None:
        """How likely something else is now than the filter counts on."""
        search, timing = self.model_error, self._other_timing
        moves, scatter = search.frame.probability, search.stamp_jitter(self._scatter)[0]
        self.probability = max(timing, moves, scatter, search.probability(self._ekf.model_error))
        self.reason_not_to_fuse = timing if self.late or self.doubted else moves

    @property
    def _scatter(self) -> float:
        """s, deviation of stamps that the filter counts on now."""
        return self._ekf.expected.scatter(self._stamp_error_s)

    @property
    def _other_timing(self) -> float:
        return self.timing.other(self._ekf.expected, self._ekf.delay)

    def _follow_timing(self, k: int) -> bool:
        """Another delay or response of the tracker, with which measurements follow the open-loop run far better.

        Where they do with many delays, as before a late tracker shows the first motion, they are not fused until one is found. Nor are they while a
        delay is likelier than not, but has not lasted yet: the filter would make a force of it.
        """
        expected, delay, was_late = self._ekf.expected, self._ekf.delay, self.late
        found = self.timing.found(expected, delay)
        self.late = found is None and self.timing.undecided(expected, delay)
        likely = found is None and self.timing.changed(delay) > 0.5
        self._doubted_since = (k if self._doubted_since is None else self._doubted_since) if likely else None
        self._doubt(k)
        if found is None and (was_late or not self.late):
            return False
        kind, note = "latency", "poses are older than their stamps, by a time that is not known yet"
        if found is not None:
            if found.response is not None:
                expected.responds(found.response, found.deviation if found.delay is None else 0.0)
                expected.late_by(0.0, 0.0)  # a response tells by itself how late a tracker is,
                expected.jitter = 0.0  # and looks like jitter before it is known
                self.end_of_jitter.clear()
                kind, note = "response", in_words(found.response)
            if found.delay is not None:
                kind = "latency"
                expected.late_by(found.delay, found.deviation)
                whole_ms = 1e3 * (expected.model.delay + expected.delay)
                note = f"poses are {abs(whole_ms):.0f} ms {'older' if whole_ms > 0.0 else 'newer'} than their stamps"
            self._inputs.measurements.early_s = max(-expected.delay, 0.0)
            self.timing.followed(found)
            self._health.measurements.distances.clear()
        advice = "; check the tracker's clock, or set tracker.delay_s" if kind == "latency" else ""
        self._health.note("tracker", kind, note + advice)
        return True

    def _doubt(self, k: int) -> None:
        """Doubt a latency that has probably changed for as long as the longest delay needs to show, also where no measurement comes."""
        since, longest_s = self._doubted_since, self.usual_timing.late.options.longest_s
        self.doubted = since is not None and seconds(k - since) <= longest_s

    def _follow_jitter(self, k: int) -> bool:
        """Stamps that scatter, with which measurements follow the open-loop run far better than the filter.

        Where they scatter less than they did, the filter goes on as it is, with half of that.
        """
        if self.not_fused:
            return False
        search = self.model_error
        if self._ekf.expected.jitter and self.end_of_jitter.less:
            half = 0.5 * self._ekf.expected.jitter
            self._ekf.expected.jitter = half if half > 0.5 * search.jitter.options.smallest_s else 0.0
            self.end_of_jitter.clear()
        probability, deviation = search.stamp_jitter(self._scatter)
        if probability <= 0.5 or self._other_timing > 0.5:
            self._scatters_since = k
        lasts = seconds(k - self._scatters_since) > search.jitter.options.lasts_s
        if probability <= search.options.believed or not lasts:
            return False
        self._ekf.expected.jitter = math.sqrt(max(deviation**2 - self._stamp_error_s**2, 0.0))
        self.end_of_jitter.clear()
        search.begin_again()
        self.timing.begin_again(self._ekf.expected, self._ekf.delay)
        self._health.note(
            "tracker",
            "jitter",
            f"stamps scatter by {1e3 * deviation:.0f} ms; stamp poses when they are measured, not when they arrive",
        )
        return True

    def _leave_moving_frame(self, open_loop: OpenLoopRun) -> bool:
        """A frame of the tracker that moves; measurements are not fused as long as it does."""
        was, frame = self.moving, self.model_error.frame
        self.moving = not self.late and frame.moves(was)
        if was or not self.moving:
            return False
        velocity, turn = frame.rates(open_loop.tips.last.mean[:3])
        self._health.note(
            "tracker",
            "moving frame",
            f"measured positions depart from the model as by a frame that moves by {1e3 * math.hypot(*velocity):.1f} mm/s and "
            f"{math.degrees(math.hypot(*turn)):.1f} deg/s; check the field generator, the tracker's stand and the robot's base",
        )
        return True

    def _follow_model_error(self) -> bool:
        """A larger model error, with which measurements follow the open-loop run far better than the filter.

        Without it, the filter takes the error of the model for a force and for wrong parameters, which move the velocities too.
        """
        if self.not_fused:
            return False
        found = self.model_error.found(self._ekf.model_error)
        if found is None:
            return False
        self._health.model_error = found
        self._ekf.expect_model_error(found)
        self.model_error.begin_again()
        return True

    def _leave_refuted(self) -> bool:
        """The robot file, where its open-loop run foretells measurements far better than an estimate that refutes it.

        Inputs that were wrong for a while have bent parameters and registration then, which are certain by now and would not come back for long.
        """
        if self.not_fused or not (self._ekf.refuted and self.model_error.astray):
            return False
        self.model_error.forgive()
        return True
