"""Checks of tracker poses: numbers, frame, placeholders, repeats, reach, orientation, stamps, two trackers.

What a pose is compared with: the poses before it, the clock of the joints, and the robot's length at the present translations. The estimate is
not used, except for the order of a quaternion's components, where the caller gives the orientation that it expects.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from typing import TYPE_CHECKING

from ctr_dynamics.io.messages.topics import accepts_frame
from ctr_dynamics.sensing.checks import rejection_texts
from ctr_dynamics.sensing.checks.check_limits import ZERO, CheckOptions
from ctr_dynamics.sensing.checks.orientation_checks import OrientationChecks
from ctr_dynamics.sensing.checks.stamp_checks import StampChecks, known_shift
from ctr_dynamics.sensing.checks.value_trains import ReturnWatch, TwoTrains, Values, distance
from ctr_dynamics.sensing.checks.verdicts import ACCEPT, Findings, Kind, Verdict

if TYPE_CHECKING:
    from ctr_dynamics.robot import Robot

POSE_PERIOD_S = 0.025  # assumed until it is known
CLEARLY_APART = (
    5.0  # smallest steps that count, by which two trains of poses must differ for one of them to be used
)
RECALLED = 8  # distinct poses among which a repeated one is looked for
COMEBACKS = (
    3  # times that a pose may come back among others; a driver that polls too fast interleaves no more
)
NEWS = 64  # poses of which the share of new ones is taken
POLLED_SHARE = 1.8  # poses for each new one from which on a driver polls too fast
PLACEHOLDERS = 4  # poses that are known to stand for none

Pose = tuple[Values, Values]  # position in m, quaternion x, y, z, w


class PoseChecks:
    """Poses of one tracker, in the order of arrival.

    Args:
        robot: for length, registration, lever arm and noise; None: poses only have to lie within the longest robot there is.

    Attributes:
        findings: what was found so far. stamps: of the stream. orientation: see :class:`OrientationChecks`.
        reach: m from the base plate's hole, that no sensor on this robot can exceed at the present translations.
    """

    def __init__(self, robot: Robot | None = None, options: CheckOptions | None = None) -> None:
        self.robot, self.options = robot, options or CheckOptions()
        limits = self.limits = self.options.limits
        self.findings = Findings("tracker")
        self.stamps = StampChecks("pose", self.findings, limits, POSE_PERIOD_S)
        noise = robot.tracker.noise if robot is not None else None
        self._exact = noise is not None and noise.position.value == 0.0 == noise.rotation.value
        step = max(
            limits.pose_step, limits.pose_noise_factor * noise.position.value if noise is not None else 0.0
        )
        self._scale = (step,) * 3
        self._watch = ReturnWatch(self._scale, limits.returns, limits.return_s)
        self.orientation = OrientationChecks(self.findings, limits, self._exact)
        self._geometry()
        self.forget()

    def _geometry(self) -> None:
        """Registration, and by how much a sensor may lie beyond the robot's length."""
        limits, options, robot = self.limits, self.options, self.robot
        self._translation: Sequence[float] = options.translation or ZERO
        self._margin = limits.reach_margin
        if robot is None:
            self.reach = limits.longest_robot
            return
        tracker = robot.tracker
        self._translation = options.translation or tuple(tracker.registration_translation.value)
        lever = options.lever or tuple(tracker.lever_arm.value)
        tolerances = (tracker.registration_translation, tracker.lever_arm)
        self._margin += math.hypot(*lever) + 3.0 * sum(math.hypot(*q.tolerance) for q in tolerances)
        self._margin += 6.0 * tracker.noise.position.value + 3.0 * tracker.noise.drift.value
        self.follow_translations((0.0,) * robot.n_tubes)

    def forget(self) -> None:
        """Start again, as after a reset; findings stay."""
        self.stamps.forget()
        self.orientation.forget()
        self._watch.forget()
        self._last: tuple[int, Pose] | None = None  # as it came
        self._first_ns, self._repeats, self._counted = (
            0,
            0,
            0,
        )  # of the run of equal poses: begin, length, and how many are counted as repeated
        self._news = deque[bool](maxlen=NEWS)  # of the last poses: whether it was a new one
        self._recent: dict[Pose, int] = {}  # poses, oldest first, and how often each came back among others
        self._placeholders = deque[Pose](maxlen=PLACEHOLDERS)
        self._two: TwoTrains | None = None  # of two publishers
        self._joint_ns: int | None = None
        self._joint_offset_ns: int | None = None
        self._moving = True

    def follow_translations(self, translations: Sequence[float]) -> None:
        """Set the reach for the tubes' positions ``translations``: (N,) m, negative behind the base plate."""
        if self.robot is not None:
            length = self.robot.tubes[0].length
            exposed = min(max(length + translations[0], 0.0), length)
            self.reach = exposed * (1.0 + self.limits.reach_share) + self._margin

    def follow_joints(self, newest_ns: int | None, offset_ns: int | None, moving: bool) -> None:
        """Tell the newest stamp of the joints (None where it is not believed), arrival minus stamp of the quickest of them where that is
        known, and whether they move."""
        self._joint_ns, self._joint_offset_ns, self._moving = newest_ns, offset_ns, moving

    def check(
        self,
        stamp_ns: int,
        arrival_ns: int | None,
        position: Sequence[float],
        quaternion_xyzw: Sequence[float],
        frame_id: str = "",
        expected_wxyz: Sequence[float] | None = None,
    ) -> Verdict:
        """Verdict on a pose.

        Args:
            arrival_ns: time of arrival on the clock of the joints' arrivals; None where it is not known.
            position: (3,) m. quaternion_xyzw: (4,), in ROS order, both in the tracker's frame.
            expected_wxyz: (4,) orientation that the tracker should report, where the caller has an estimate of it.
        """
        at = stamp_ns if arrival_ns is None else arrival_ns
        expected = self.options.pose_frame_id or self.options.frame_id
        if not accepts_frame(frame_id, expected):
            text = rejection_texts.pose_in_other_frame(frame_id, expected)
            return self._drop(Kind.OTHER_FRAME, at, 0.0, "", text)
        pose: Pose = (tuple(position), tuple(quaternion_xyzw))
        if not all(map(math.isfinite, (*pose[0], *pose[1]))):
            text = rejection_texts.not_finite("pose", stamp_ns)
            self.stamps.pass_over(stamp_ns, arrival_ns)
            return self._drop(Kind.NOT_FINITE, at, 0.0, "", text)
        wrong = self._placeholder(at, pose) or self._repeated(stamp_ns, at, pose) or self._unlike(at, pose)
        if wrong is not None:
            if wrong.kind in (Kind.PLACEHOLDER, Kind.OUT_OF_REACH):
                self.stamps.pass_over(stamp_ns, arrival_ns)
            return wrong
        unset = self._joint_ns is not None and abs(self._joint_ns) > self.limits.unrelated_s * 1e9
        stamped = self.stamps.check(stamp_ns, arrival_ns, zero_is_wrong=unset)
        if stamped.use == "drop":
            return stamped
        wrong = self._of_other_clock(stamp_ns, arrival_ns, at) or self._of_other_publisher(stamp_ns, at, pose)
        if wrong is not None:
            return wrong
        again = stamp_ns == self.stamps.newest_ns
        timed = self.stamps.take(stamp_ns, arrival_ns)
        if timed.use == "drop":
            return timed
        if again and not self.stamps.mode:
            text = rejection_texts.second_of_stamp("pose", stamp_ns)
            return self._drop(Kind.DUPLICATE, at, 0.0, "", text)
        kind, text = timed.kind or stamped.kind, timed.text or stamped.text
        oriented = ACCEPT
        if self.options.orientation:
            oriented = self.orientation.check(at, pose, expected_wxyz)
            if oriented.use == "drop":
                return oriented
            kind, text = oriented.kind or kind, oriented.text or text
        if kind is None and oriented is ACCEPT:
            return timed
        return Verdict(
            "correct" if "correct" in (timed.use, oriented.use) else "accept",
            kind,
            text,
            timed.stamp_ns,
            orientation=oriented.orientation,
            quaternion_xyzw=oriented.quaternion_xyzw,
            retract_ns=stamped.retract_ns,
            error_s=timed.error_s,
        )

    # -- poses that are none --

    def _placeholder(self, at: int, pose: Pose) -> Verdict | None:
        """Poses that stand for none: at the origin, or one that comes back bit by bit again and again."""
        if not any(pose[0]):
            text = "pose lies exactly at the origin: the tracker has none; such poses are left out; send none when the sensor is not seen"
        elif pose in self._placeholders:
            text = (
                f"pose {_short(pose[0])} m comes back bit by bit among others: it stands for none and is left out; "
                "send none when the sensor is not seen"
            )
        else:
            return None
        self._repeats = self._counted = 0
        return self._drop(Kind.PLACEHOLDER, at, 0.0, "", text)

    def _repeated(self, stamp_ns: int, at: int, pose: Pose) -> Verdict | None:
        """A pose equal bit by bit to one before: measured noise never repeats itself."""
        last, self._last = self._last, (stamp_ns, pose)
        follows = last is not None and last[1] == pose
        if not follows and pose not in self._recent:
            self._recent[pose] = 0
            if len(self._recent) > RECALLED:
                del self._recent[next(iter(self._recent))]
            self._news.append(True)
            self._first_ns, self._repeats, self._counted = at, 0, 0
            return None
        if self._exact and not self._moving and not (last is not None and last[0] == stamp_ns):
            return None  # a tracker without noise at rest
        self._news.append(False)
        if not follows:
            comebacks = self._recent[pose] = self._recent.pop(pose) + 1
            if comebacks > COMEBACKS:
                self._placeholders.append(pose)
        self._repeats = self._repeats + 1 if follows else 0
        lasted = (at - self._first_ns) * 1e-9
        limit = max(self.limits.frozen_s, 3.0 * self.stamps.period_s)
        if lasted > limit and self._repeats >= 3:
            self.findings.uncount(Kind.REPEATED, self._counted)
            rest = "" if self._moving else " (or simulated without noise, as the joints rest)"
            text = (
                f"the same pose, bit by bit, for {lasted:.2f} s, limit {limit:.2g} s: the tracker is frozen{rest}; "
                "repeats are left out; send none when the sensor is not seen"
            )
            early, self._counted = self._counted, 0
            return self._drop(Kind.FROZEN, at, lasted, "s", text, count=1 + early)
        new = sum(self._news)
        if new >= 6 and len(self._news) >= POLLED_SHARE * new:
            early = self.findings.count(Kind.REPEATED)
            self.findings.uncount(Kind.REPEATED, early)
            self._counted = 0
            times = len(self._news) / new
            text = (
                f"every pose comes {times:.1f} times: the tracker is polled faster than it measures; the first of each counts; "
                "publish only new measurements"
            )
            return self._drop(Kind.POLLED, at, times, "", text, count=1 + early)
        self._counted += 1
        text = (
            "a pose equal to one before, bit by bit, is no new measurement; left out; publish only new ones"
        )
        return self._drop(Kind.REPEATED, at, 0.0, "", text)

    def _unlike(self, at: int, pose: Pose) -> Verdict | None:
        """A pose that no sensor on this robot can have: out of reach."""
        shift = self._translation
        away = math.hypot(*(p - t for p, t in zip(pose[0], shift, strict=True))) / self.options.scale
        if away <= self.reach:
            return None
        if pose not in self._placeholders:
            self._placeholders.append(pose)
        hint = "another frame or registration?"
        if 0.2 * self.reach <= away * 1e-3 <= self.reach:
            hint = "millimetres? give metres"
        text = f"pose lies {away:.4g} m from the base plate's hole, limit {self.reach:.4g} m (length, lever arm and tolerances): {hint}; left out"
        return self._drop(Kind.OUT_OF_REACH, at, away, "m", text)

    # -- clock and publisher --

    def _of_other_clock(self, stamp_ns: int, arrival_ns: int | None, at: int) -> Verdict | None:
        """A pose whose stamp is of another clock than the joints'."""
        if self._joint_ns is None:
            return None
        ahead_s = (stamp_ns - self._joint_ns) * 1e-9
        limit = self.limits.unrelated_s
        by = "than the newest joint state"
        if arrival_ns is not None and self._joint_offset_ns is not None:
            own = self.stamps.clock_offset_ns
            ahead_s = (self._joint_offset_ns - (arrival_ns - stamp_ns if own is None else own)) * 1e-9
            limit, by = self.limits.other_clock_s, "than the joints', by arrival"
        if abs(ahead_s) <= limit:
            if abs(ahead_s) > self.limits.clock_offset_s and by.endswith("arrival") and self.stamps.settled:
                text = (
                    f"stamps of the poses are {abs(ahead_s):.3f} s {'later' if ahead_s > 0 else 'earlier'} {by}, "
                    f"limit {self.limits.clock_offset_s:g} s; synchronise the clocks or set tracker.delay_s"
                )
                self.findings.add(Kind.CLOCK_OFFSET, at, abs(ahead_s), "s", text)
            return None
        text = (
            f"stamps of the poses are {abs(ahead_s):.3f} s {'later' if ahead_s > 0 else 'earlier'} {by}, "
            f"limit {limit:g} s{known_shift(abs(ahead_s))}; synchronise the clocks; such poses are left out"
        )
        return self._drop(Kind.OTHER_CLOCK, at, abs(ahead_s), "s", text)

    def _of_other_publisher(self, stamp_ns: int, at: int, pose: Pose) -> Verdict | None:
        """A pose of the other of two trackers on one topic."""
        newest = self.stamps.newest_ns
        if newest is not None and stamp_ns < newest:
            return None
        position = pose[0]
        self._watch.add(stamp_ns, position, self.stamps.rhythm_s, self.stamps.least_period_s)
        if self._watch.two is not None and self._two is None:
            self._two = TwoTrains(*self._watch.two, self._scale, self.stamps.rhythm_s, self.limits.return_s)
        if self._two is None:
            return None
        mine = self._two.mine
        clear = self._two.apart(stamp_ns) >= CLEARLY_APART
        place = self._two.place(stamp_ns, position)
        if place == "mine":
            mine.extend(stamp_ns, position)
        elif place != "other":
            self._two = None
        if place != "other" and (place != "mine" or clear):
            return None
        size = distance(self._two.other.values, mine.values, (1.0,) * 3) if self._two is not None else 0.0
        fate = (
            "the train that was there first is used, the other left out"
            if clear
            else "they are too close to be told apart, and neither is used"
        )
        text = f"two publishers on one topic, poses {size:.3g} m apart, limit {self._scale[0]:.3g} m; {fate}; stop one of them"
        return self._drop(Kind.TWO_PUBLISHERS, at, size, "m", text)

    def _drop(self, kind: Kind, at: int, worst: float, unit: str, text: str, count: int = 1) -> Verdict:
        self.findings.add(kind, at, worst, unit, text, count)
        return Verdict("drop", kind, text)


def _short(position: Values) -> str:
    return "(" + ", ".join(f"{v:.4g}" for v in position) + ")"
