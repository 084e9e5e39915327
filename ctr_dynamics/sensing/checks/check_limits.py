"""Limits of the input checks, each with its reason, and what the checks are told about robot and settings."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

ZERO = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class CheckLimits:
    """Limits of the input checks; SI units and radians. None is fitted to a recording."""

    # -- actuators --
    rotation_speed: float = 20.0
    """rad/s. Geared motors turn tubes at up to about 10 rad/s (the fastest published motions); twice that is left free."""
    translation_speed: float = 0.5
    """m/s. Screw drives and linear stages of this size reach 0.2 m/s; twice that and more is left free."""
    rotation_acceleration: float = 1000.0
    """rad/s^2. It reaches the speed limit within 20 ms. Only a motion there and back within two periods is judged by it."""
    translation_acceleration: float = 25.0
    """m/s^2. It reaches the speed limit within 20 ms; see above."""
    rotation_step: float = 0.01
    """rad. Steps below it are never a jump: coarse encoders step by as much, and it moves a tip 30 mm off the axis by 0.3 mm."""
    translation_step: float = 0.0005
    """m. Steps below it are never a jump: coarse position sensors step by as much, and it moves the tip by as much."""
    noise_factor: float = 8.0
    """Standard deviations of the stated noise by which two readings may differ beside motion; those of their difference are 5.7."""
    largest_angle: float = 20 * math.pi
    """rad. Ten turns: tubes wind up and cables end before; angles in degrees are beyond it."""
    confirm_count: int = 5
    """Joint states in a row that must agree on a position which no actuator can have reached, before it is believed."""
    confirm_s: float = 0.05
    """s. They must also span this long: it is what a driver needs to restart, and half of what the estimator may extrapolate."""
    confirm_zero_s: float = 1.0
    """s. Joint states that are zero throughout are what drivers send before they know better; at the start they must last this long."""
    gap_s: float = 0.1
    """s. A longer silence is a gap. It is the default of ``input_timeout_s``, for which joints are extrapolated."""
    joint_period: float = 0.01
    """s. Assumed between joint states until it is known; 100 Hz is usual."""

    # -- stamps --
    late_s: float = 0.2
    """s. A message may come this long after newer ones; the default of ``filter.window_s``."""
    ahead_s: float = 0.02
    """s. A stamp may lie this far ahead of its arrival: the error of ordinary clock synchronisation. At 10 rad/s a joint is then 0.2 rad off."""
    same_clock_s: float = 1.0
    """s. Stamps and arrivals that differ by less are taken to be on one clock, on which no stamp can lie ahead of its arrival."""
    other_clock_s: float = 0.3
    """s. Poses that differ from the joints by more, by arrival, are on another clock. Up to here a latency can be estimated."""
    clock_offset_s: float = 0.05
    """s. A difference between both clocks is said from here on."""
    unrelated_s: float = 10.0
    """s. Without times of arrival, a pose this far from the newest joint state is on another clock."""
    short_interval: float = 0.1
    """Of the mean interval; shorter intervals between stamps belong to a burst, as no sensor measures at ten times its own rate. Where a full
    window shows the pattern, 4.5 times as much; where half of the messages are lost, the usual interval is 5 times as much."""
    stamp_grid_s: float = 0.002
    """s. Coarser stamps are said to be rounded. A tip at 0.5 m/s moves by 1 mm meanwhile; at 1 ms it is less than a tracker's noise."""

    # -- tracker --
    frozen_s: float = 0.1
    """s. Poses equal bit by bit for longer mean a frozen tracker; trackers leave out single frames."""
    equal_orientations: int = 5
    """Different positions in a row with one orientation, bit by bit, after which the orientation is not a measurement."""
    scalar_first_poses: int = 10
    """Poses in a row that fit the expected orientation only when read scalar first, before the order is called wrong."""
    fitting_rad: float = 0.35
    """rad. An orientation within 20 deg of the expected one fits it: an uncalibrated robot's model is that good."""
    distinct_rad: float = 0.3
    """rad. By so much more the given order must miss than the other one, ten times in a row; it is far beyond a tracker's noise."""
    reach_margin: float = 0.003
    """m. Added to the robot's length, lever arm and tolerances: insertion errors of an uncalibrated robot."""
    reach_share: float = 0.02
    """Of the robot's length, added likewise: scale error of an uncalibrated tracker."""
    longest_robot: float = 2.0
    """m. Limit of a tube's length in robot files; the reach where no robot is given."""
    pose_noise_factor: float = 5.0
    """Standard deviations of the stated noise by which two poses may differ; the length of their difference is 2.4 on average."""
    pose_step: float = 0.001
    """m. Two trains of poses that lie closer are not told apart; beside that stated noise counts."""

    # -- several publishers --
    returns: int = 3
    """Times that a stream must return from the same foreign train of values before two publishers are named."""
    return_s: float = 1.0
    """s. They must follow each other within this time."""

    # -- load --
    bending_rad: float = 10.0
    """rad. Loads that would turn the tip by more in linear beam theory are beyond reason. A legitimate weight of 60 g on the tissue robot
    gives 0.8 rad. From some radians on the tip points along the force, and tubes reach their recoverable strain of 8 %."""
    force: float = 20.0
    """N. Largest force on any robot's tip: ten times what concentric tube robots apply."""


@dataclass(frozen=True)
class CheckOptions:
    """What the checks are told beside the robot file.

    Attributes:
        frame_id: frame of poses and loads; pose_frame_id: of poses, where it is another.
        translation: (3,) m, scale: -, of the registration; lever: (3,) m in the tip frame. None: as in the robot file.
        orientation: whether the tracker's orientation is used at all.
        unwrap: whether angles are unwrapped. turns: rad, by which wrapped angles jump. After a gear it is 2 pi times the scale of the reading.
        limits: see :class:`CheckLimits`.
    """

    frame_id: str = "ctr_base"
    translation: tuple[float, float, float] | None = None
    lever: tuple[float, float, float] | None = None
    scale: float = 1.0
    orientation: bool = True
    unwrap: bool = True
    turns: tuple[float, ...] = (2 * math.pi,)
    pose_frame_id: str = ""
    limits: CheckLimits = field(default_factory=CheckLimits)
