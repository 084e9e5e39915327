"""What the covariance factor does not know of the tip's velocity (docs/filter.md, "The twist's covariance").

A position error of a tenth of a millimetre is small at any frequency. As a velocity it counts by its frequency, and there the factor is silent: it
follows few columns, in steps of several milliseconds, and knows nothing of the errors of nodes and steps.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.estimation.discretisation import RESOLVED_HZ, VibrationErrors
from ctr_dynamics.estimation.filter.ekf import RodEkf
from ctr_dynamics.estimation.filter.expected_tracker import ExpectedTracker
from ctr_dynamics.estimation.filter.filter_records import TipEstimate
from ctr_dynamics.estimation.filter.rational_step import FOLLOWED_S, Stride, error_rates
from ctr_dynamics.estimation.step_output import Modes
from ctr_dynamics.kernels.output_errors import (
    add_by_modes,
    add_frame_error,
    add_hidden_vibrations,
    add_motion_error,
    follow_motion,
    motion_square,
)
from ctr_dynamics.robot import Robot
from ctr_dynamics.sensing import Tip

Floats = NDArray[np.float64]
MEMORY_S = (
    1.0  # in which the frequency of the motion is measured: a period of slow turning, some of a vibration
)
MOST = 2.0  # mean square of the difference of two vibrations of unknown phase, by that of one
KEPT = 0.5  # part of a column's vibration that it may lose in the time for which columns count, and still corrects the mode
SMALLEST = 1e-30  # m^2 s: a tracker without noise tells all
OVER = 1e-3  # of its amplitude: a vibration that has decayed so far is over


class MotionFrequency:
    """The angular frequency of the tip's motion: the ratio of speed and excursion of late, as of one sine.

    An error of the position is as likely a part of the motion, as by a wrong friction, as it is constant. Then it has the motion's frequency.
    """

    def __init__(self) -> None:
        self.clear()

    def clear(self) -> None:
        """Nothing has moved."""
        self._stamp_ns: int | None = None
        self._moments = np.zeros(5)  # mean position, m; mean squares of excursion and speed, m^2 and m^2/s^2

    def add(self, stamp_ns: int, position: Floats, velocity: Floats) -> None:
        """Take in the tip ``position`` (3,) m and ``velocity`` (3,) m/s of a run that measurements do not move."""
        if self._stamp_ns is None:
            self._moments[:3] = position
        else:
            new = -math.expm1(-max(stamp_ns - self._stamp_ns, 0) * 1e-9 / MEMORY_S)
            follow_motion(self._moments, new, position, velocity)
        self._stamp_ns = stamp_ns

    def square(self, variance: float) -> float:
        """Square of the frequency, 1/s^2. An excursion within the position's ``variance`` (m^2) is no motion."""
        return float(motion_square(self._moments, variance))

    def inflate(self, covariance: Floats, rows: Floats, pi: Floats) -> None:
        """Add to the twist in the ``covariance`` (12, 12) of the tip, in place, what an error of its pose is then.

        ``rows`` (6, r): of the pose, by coefficients of covariance ``pi`` (r, r) or more.
        """
        add_motion_error(self._moments, rows, pi, covariance)


class LoadVibration:
    """Vibrations that changes of the known load have excited, as far as model and factor do not follow them.

    Args:
        modes: how the robot vibrates at rest, and how well that is followed.

    Attributes:
        vibrating: whether anything does.
    """

    def __init__(self, modes: VibrationErrors) -> None:
        self._modes, self._of_one = modes, of_modes(modes)
        self.clear()

    def clear(self) -> None:
        """Nothing vibrates."""
        self._amplitude = np.zeros(len(self._modes.exponent), complex)  # modal coordinates at `_stamp_ns`
        self._stamp_ns = 0
        self._since_ns = np.zeros(len(self._amplitude))  # when a vibration got most of its amplitude
        self.vibrating = False

    def load_changed(self, from_ns: int, to_ns: int, difference: Floats) -> None:
        """The known load (6,) N, N m has changed evenly by ``difference`` between two stamps: the robot is off its new equilibrium."""
        if not difference.any():
            return
        over_s = max(to_ns - from_ns, 1) * 1e-9
        mu = self._modes.exponent
        excited = -(self._modes.by_load @ difference) * np.expm1(mu * over_s) / (mu * over_s)
        before = self._at(to_ns) if self.vibrating else self._amplitude
        newer = np.abs(excited) > np.abs(before)
        self._since_ns[newer] = to_ns
        self._amplitude, self._stamp_ns = before + excited, to_ns
        self.vibrating = bool(self._amplitude.any())

    def _at(self, stamp_ns: int) -> NDArray[np.complexfloating]:
        """Modal coordinates at ``stamp_ns``, at the earliest those of the last change."""
        elapsed_s = max(stamp_ns - self._stamp_ns, 0) * 1e-9
        return self._amplitude * np.exp(self._modes.exponent * elapsed_s)

    def inflate(self, covariance: Floats, stamp_ns: int, lost: Floats) -> None:
        """Add to the ``covariance`` (12, 12) of the tip at ``stamp_ns``, in place, the vibrations' errors.

        A vibration is off by its phase, which goes astray with time; of unknown phase, it is off by as much as it vibrates.

        Args:
            lost: (m,) 1/s, of each mode's error by the parameters' tolerances, what the columns of the covariance factor lose.
        """
        if not self.vibrating:
            return
        modes = self._modes
        size = np.abs(self._at(stamp_ns))
        if not (size > OVER * np.abs(self._amplitude)).any():
            self.clear()
            return
        age = np.maximum(stamp_ns - self._since_ns, 0.0) * 1e-9
        # by columns that follow a mode, measurements correct it
        age = np.where(lost * FOLLOWED_S < KEPT, np.minimum(age, FOLLOWED_S), age)
        by_tolerances = np.abs(modes.exponent) * modes.tolerance * age * np.minimum(lost * age, 1.0)
        square = np.minimum((modes.phase_rate * age) ** 2 + by_tolerances**2, MOST)
        square[~modes.resolved] = 1.0  # the model follows the mean
        add_by_modes(size**2 * square, self._of_one, covariance)


class UnseenVibration:
    """A vibration that the robot may have when the model starts at rest, before anything has shown how it moves. All modes have the same energy.

    Args:
        modes: how the robot vibrates at rest.
        deviation: m, of the tip.
    """

    def __init__(self, modes: VibrationErrors, deviation: float) -> None:
        self._deviation, self._covariance = deviation, np.zeros((12, 12))
        of_one = of_modes(modes)
        at_tip = of_one.reshape(-1, 12, 12)[:, range(3), range(3)].sum(axis=1)
        moves = at_tip > 0.0
        if not moves.any():
            self._covariance[range(3), range(3)] = deviation**2 / 3.0
            return
        part = modes.reach[moves] ** 2 / (modes.reach[moves] ** 2).sum()
        add_by_modes(deviation**2 * part / at_tip[moves], of_one[moves], self._covariance)

    def inflate(self, covariance: Floats, apart: float) -> None:
        """Add it to the ``covariance`` (12, 12) of the tip, in place; ``apart``: m, that a measurement has shown."""
        covariance += max(apart / self._deviation, 1.0) ** 2 * self._covariance


class EncoderVibration:
    """Vibrations that the model has and the robot has not: the noise of the encoders turns its tubes alone.

    Args:
        modes: how the robot vibrates at rest.
        noise: deviation of a rotation that is read, rad.
    """

    def __init__(self, modes: VibrationErrors, noise: float) -> None:
        self._exponent = modes.exponent
        self._by_noise = noise**2 * (np.abs(modes.by_rotation) ** 2).sum(axis=1)
        self._of_one = of_modes(modes)
        self._stamp_ns: int | None = None
        self._variance = np.zeros(len(modes.exponent))  # of the modal coordinates
        # between joint states and between steps, s; what such a step keeps of the variance, and adds to it
        self._lengths = 0.0, 0.0
        self._kept, self._added = np.ones(len(modes.exponent)), np.zeros(len(modes.exponent))

    def add(self, stamp_ns: int, period_s: float) -> None:
        """Go on to ``stamp_ns``, with readings every ``period_s``. A reading turns the tubes evenly from the one before, and back to the next."""
        elapsed_s = 0.0 if self._stamp_ns is None else max(stamp_ns - self._stamp_ns, 0) * 1e-9
        self._stamp_ns = stamp_ns
        if (period_s, elapsed_s) != self._lengths:  # they are even: once for many steps
            self._lengths = period_s, elapsed_s
            angle = self._exponent * period_s
            by_one = self._by_noise * np.abs(np.expm1(angle)) ** 4 / np.abs(angle) ** 2
            self._kept = np.exp(2.0 * elapsed_s * self._exponent.real)
            self._added = by_one * (elapsed_s / period_s)
        self._variance *= self._kept
        self._variance += self._added

    def inflate(self, covariance: Floats) -> None:
        """Add them to the ``covariance`` (12, 12) of the tip, in place."""
        add_by_modes(self._variance, self._of_one, covariance)


class HiddenVibration:
    """Vibrations whose phases a linear filter does not hold for certain, as a tracker that averages or smooths hides them.

    The tolerances leave a frequency open by w (rad/s). Of the phase of a vibration of amplitude a, poses tell i = g^2 a^2 / (2 s^2 T) in a second,
    with their noise s and period T, and the part g of the amplitude that the tracker certainly shows. After t the phase has the variance
    t^2 / (1 / w^2 + i t^3 / 3), at most v = (6 w / i)^(2/3) / 3. The filter takes the sine for its tangent and errs by the next term. Its mean
    square is 3/4 v^2 times that of the vibration; at most, the phase is unknown.
    In modes that are too fast for the steps, the model has no vibration, but follows the motion of the others.

    Args:
        tolerance: relative deviation of a frequency. noise: of a measured position, m.
    """

    def __init__(self, tolerance: float, noise: float) -> None:
        self._tolerance, self._noise = tolerance, noise
        self._known = np.zeros((12, 12))  # what was added last

    def inflate(self, covariance: Floats, modes: Modes, period_s: float, expected: ExpectedTracker) -> None:
        """Add them to the ``covariance`` (12, 12) of the tip, in place; ``period_s``: between two poses of the ``expected`` tracker.

        While no modes are known, as after a correction, it is what it was.
        """
        if not len(modes.frequency_hz):
            covariance += self._known
            return
        of_poses = max(self._noise**2 * period_s, SMALLEST)
        told = expected.seen_of(modes.frequency_hz) ** 2 * (0.5 / of_poses)
        self._known = np.zeros((12, 12))
        add_hidden_vibrations(
            self._tolerance, told, MOST, RESOLVED_HZ, modes.frequency_hz, modes.amplitude, modes.rate, modes.direction, self._known,
        )  # fmt: skip
        covariance += self._known


def of_modes(modes: VibrationErrors) -> Floats:
    """(m, 144) covariance (12, 12) of pose and twist of the tip, row by row, by each modal coordinate of variance 1 and any phase."""
    whole = np.hstack([modes.twist / modes.exponent[:, None], modes.twist])
    found: Floats = 2.0 * (whole[:, :, None] * whole[:, None].conj()).real
    return found.reshape(len(whole), 144)


class FrameError:
    """The twist turned by what the registration, and moved by what the lever arm may be off.

    Args:
        rotation: (3,) rad, deviations of the registration. lever: (3,) m, deviations of the lever arm.
    """

    def __init__(self, rotation: Floats, lever: Floats) -> None:
        self._rotation, self._lever = rotation, lever

    def inflate(self, covariance: Floats, twist: Floats, quaternion: Floats) -> None:
        """Add it to the ``covariance`` (12, 12) of the tip, in place; ``twist`` (6,) and ``quaternion`` (4,) wxyz are the tip's."""
        add_frame_error(self._rotation, self._lever, twist, quaternion, covariance)


class TwistError:
    """All: errors of the twist by the frequency of the motion, by vibrations that a load has left or that the tracker hides, by the noise of the
    encoders, and by the tracker's frame and sensor.

    Args:
        modes: how the robot vibrates at rest, and how well that is followed.
        robot: has the noise of the encoders, and the tolerances of registration and lever arm.
    """

    def __init__(self, modes: VibrationErrors, robot: Robot) -> None:
        tracker = robot.tracker
        self._motion, self._vibration = MotionFrequency(), LoadVibration(modes)
        self._encoders = EncoderVibration(modes, robot.encoders.noise.value)
        self._frame = FrameError(
            np.array(tracker.registration_rotation.tolerance), np.array(tracker.lever_arm.tolerance)
        )
        self._hidden = HiddenVibration(modes.tolerance, tracker.noise.position.value)
        self._frequency_hz = modes.exponent.imag / (2 * np.pi)
        self._stride: Stride | None = None  # of the columns, and what they lose by it
        self._lost = np.zeros(len(self._frequency_hz))

    def load_changed(self, from_ns: int, to_ns: int, difference: Floats) -> None:
        """The known load (6,) N, N m has changed evenly by ``difference`` between two stamps."""
        self._vibration.load_changed(from_ns, to_ns, difference)

    def inflate(
        self,
        tip: TipEstimate,
        stamp_ns: int,
        open_loop: Tip,
        ekf: RodEkf,
        periods_s: tuple[float, float],
        vibrating: Modes,
    ) -> None:
        """Add to the covariance of ``tip`` at ``stamp_ns``, in place.

        ``open_loop``: the tip that measurements do not move. ``periods_s``: between two joint states, and between two poses. ``vibrating``: the
        modes now. Where no poses are fused, their period is infinite, and there is no more unknown than the tolerances say.
        """
        covariance = tip.covariance
        self._motion.add(stamp_ns, open_loop.mean[:3], open_loop.mean[7:10])
        self._motion.inflate(covariance, ekf.tips.last.columns[:6], ekf.pi)
        if self._vibration.vibrating and ekf.stride is not None:
            if ekf.stride is not self._stride:
                self._stride, over_s = ekf.stride, ekf.stride.steps * ekf.simulator.scheme.dt
                self._lost = error_rates(ekf.stride.fraction, self._frequency_hz, over_s)
            self._vibration.inflate(covariance, stamp_ns, self._lost)
        self._frame.inflate(covariance, tip.twist, tip.quaternion)
        if periods_s[0] > 0.0:
            self._encoders.add(stamp_ns, periods_s[0])
        if ekf.expected.response and math.isfinite(periods_s[1]):
            self._hidden.inflate(covariance, vibrating, periods_s[1], ekf.expected)
        self._encoders.inflate(covariance)
