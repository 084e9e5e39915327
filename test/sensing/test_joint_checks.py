"""Joint states: wraps, jumps, glitches, two drivers, gaps; and the innocent streams that look like them."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from stream_cases import BETA, PERIOD, T0, Row, feed_joints, joint_rows, still, sweep

from ctr_dynamics.robot_files import load_robot
from ctr_dynamics.sensing.checks import CheckLimits, CheckOptions, JointChecks, Kind


@pytest.fixture
def checks() -> JointChecks:
    return JointChecks(2, load_robot("till2020_tissue"))


def kinds(checks: JointChecks) -> dict[Kind, int]:
    return {found.kind: found.count for found in checks.findings}


def turned(row: Row, change: float, tube: int = 0) -> Row:
    rotations = list(row[2])
    rotations[tube] += change
    return row[0], row[1], tuple(rotations), row[3]


def delayed(
    row: Row, by_ns: int, rotations: tuple[float, ...], translations: tuple[float, ...] = BETA
) -> Row:
    return row[0] + by_ns, (row[1] or 0) + by_ns, rotations, translations


@pytest.mark.parametrize("motion", [sweep, still])
def test_motion_and_rest_with_encoder_noise_are_accepted_as_they_are(checks, motion):
    verdicts = feed_joints(checks, joint_rows(600, motion))
    assert {v.use for v in verdicts} == {"accept"}
    assert not kinds(checks)
    assert checks.moving == (motion is sweep)


def test_rest_without_noise_repeats_values_and_is_accepted(checks):
    rows = [(T0 + k * PERIOD, T0 + k * PERIOD, (1.5, 1.2), BETA) for k in range(300)]
    assert {v.use for v in feed_joints(checks, rows)} == {"accept"}
    assert not kinds(checks)


@pytest.mark.parametrize("moved", [0.0, 1.0])
def test_repeats_of_noisy_encoders_are_left_out_until_they_measure_again(checks, moved):
    """In motion as at rest."""

    def rest_first(t: float) -> tuple[float, float]:
        angle, _ = still(t)
        return angle + moved * (1.0 - math.cos(3.0 * max(t - 2.0, 0.0))), angle

    rows = joint_rows(600, rest_first)
    for k in range(300, 400):
        rows[k] = *rows[k][:2], *rows[299][2:]
    verdicts = feed_joints(checks, rows)
    assert [k for k, verdict in enumerate(verdicts) if verdict.use == "drop"] == list(range(300, 400))
    assert kinds(checks)[Kind.FROZEN] == 100
    assert "for 1.00 s, though the encoders are noisy" in checks.findings[Kind.FROZEN].text


def test_coarse_encoders_that_creep_and_then_rest_are_at_rest(checks):
    """A count a reading, slower than what counts as motion; then no reading differs."""
    count = 1e-5
    rows = [(T0 + k * PERIOD, T0 + k * PERIOD, (count * min(k, 100), 1.2), BETA) for k in range(300)]
    assert {v.use for v in feed_joints(checks, rows)} == {"accept"}
    assert not kinds(checks)


def test_coarse_encoders_are_no_jumps(checks):
    step = 0.01
    rows = [
        (stamp, arrival, tuple(round(a / step) * step for a in rotations), beta)
        for stamp, arrival, rotations, beta in joint_rows(600)
    ]
    assert {v.use for v in feed_joints(checks, rows)} == {"accept"}
    assert not kinds(checks)


def test_a_driver_polled_ten_times_as_fast_as_it_reads_is_no_jump(checks):
    rows = []
    for stamp, arrival, rotations, beta in joint_rows(400):
        rows += [(stamp + k * PERIOD // 10, arrival + k * PERIOD // 10, rotations, beta) for k in range(10)]
    assert {v.use for v in feed_joints(checks, rows)} == {"accept"}
    assert not kinds(checks)


def test_values_that_are_no_numbers_are_named_by_joint(checks):
    rows = joint_rows(3)
    rows[1] = turned(rows[1], math.nan, tube=1)
    verdicts = feed_joints(checks, rows)
    assert [v.use for v in verdicts] == ["accept", "drop", "accept"]
    assert verdicts[1].kind is Kind.NOT_FINITE
    assert verdicts[1].text.startswith("tube2_rotation")


def test_degrees_and_millimetres_are_out_of_range(checks):
    stamp, arrival, rotations, beta = joint_rows(1)[0]
    degrees = checks.check(stamp, arrival, tuple(math.degrees(a) for a in rotations), beta)
    assert (degrees.use, degrees.kind) == ("drop", Kind.OUT_OF_RANGE)
    assert "degrees" in degrees.text
    millimetres = checks.check(stamp, arrival, rotations, tuple(1e3 * b for b in beta))
    assert millimetres.kind is Kind.OUT_OF_RANGE
    assert "millimetres" in millimetres.text


def test_wrapped_angles_become_the_unwrapped_ones():
    rows = joint_rows(600, lambda t: (math.pi + 0.8 * math.sin(7.0 * t), 1.2))
    wrapped = [
        (stamp, arrival, (math.remainder(a, 2 * math.pi), b), beta) for stamp, arrival, (a, b), beta in rows
    ]
    checks = JointChecks(2)
    verdicts = feed_joints(checks, wrapped)
    got = [v.rotations[0] if v.rotations else w[2][0] for v, w in zip(verdicts, wrapped, strict=True)]
    shift = got[0] - rows[0][2][0]
    assert shift % (2 * math.pi) == pytest.approx(0, abs=1e-9)
    assert got == pytest.approx([r[2][0] + shift for r in rows], abs=1e-9)
    assert kinds(checks).keys() == {Kind.WRAPPED}
    assert "drop" not in {v.use for v in verdicts}


def test_wraps_are_told_from_motion_after_a_gap_once_they_are_known():
    rows = joint_rows(600, lambda t: (math.pi + 0.8 * math.sin(7.0 * t), 1.2))
    wrapped = [(s, a, (math.remainder(r[0], 2 * math.pi), r[1]), b) for s, a, r, b in rows]
    checks = JointChecks(2)
    verdicts = feed_joints(checks, wrapped[:300] + wrapped[360:])
    got = [
        v.rotations[0] if v.rotations else w[2][0] for v, w in zip(verdicts[-10:], wrapped[-10:], strict=True)
    ]
    shift = got[0] - rows[-10][2][0]
    assert abs(math.remainder(shift, 2 * math.pi)) < 1e-9
    assert abs(shift) < 7.0
    assert Kind.GAP_IN_MOTION in kinds(checks)


def test_unwrapping_can_be_switched_off():
    checks = JointChecks(2, options=CheckOptions(unwrap=False))
    rows = joint_rows(20, still)
    verdicts = feed_joints(checks, [*rows[:10], turned(rows[10], 2 * math.pi), *rows[11:]])
    assert verdicts[10].kind is Kind.JUMP
    assert kinds(checks) == {Kind.GLITCH: 1}


def test_turns_of_a_motor_behind_a_gear_are_unwrapped_by_its_share():
    checks = JointChecks(2, options=CheckOptions(turns=(2 * math.pi / 5,)))
    rows = joint_rows(400, lambda t: (0.6 + 0.4 * math.sin(3.0 * t), 1.2))
    wrapped = [(s, a, (r[0] % (2 * math.pi / 5), r[1]), b) for s, a, r, b in rows]
    verdicts = feed_joints(checks, wrapped)
    got = [v.rotations[0] if v.rotations else w[2][0] for v, w in zip(verdicts, wrapped, strict=True)]
    assert got == pytest.approx([r[2][0] + got[0] - rows[0][2][0] for r in rows], abs=1e-9)


@pytest.mark.parametrize("size", [0.3, 1.0, -2.5, 9.0])
def test_a_single_glitch_is_left_out(checks, size):
    rows = joint_rows(200)
    verdicts = feed_joints(checks, [*rows[:100], turned(rows[100], size), *rows[101:]])
    assert [i for i, v in enumerate(verdicts) if v.use != "accept"] == [100]
    assert kinds(checks) == {Kind.GLITCH: 1}
    assert "limit" in checks.findings[Kind.GLITCH].text


def test_a_small_glitch_is_taken_back_by_the_next_joint_state(checks):
    rows = joint_rows(200)
    verdicts = feed_joints(checks, [*rows[:100], turned(rows[100], 0.12), *rows[101:]])
    assert [(i, v.retract_ns) for i, v in enumerate(verdicts) if v.retract_ns] == [(101, rows[100][0])]
    assert kinds(checks) == {Kind.GLITCH: 1}


def test_a_sharp_turn_is_no_glitch(checks):
    def triangle(t: float) -> tuple[float, float]:
        return 1.0 + 4.0 * abs((t % 0.5) - 0.25), 1.2

    assert {v.use for v in feed_joints(checks, joint_rows(400, triangle))} == {"accept"}
    assert not kinds(checks)


def test_a_jump_that_stays_is_believed_after_it_is_confirmed(checks):
    rows = joint_rows(200, still)
    verdicts = feed_joints(checks, [*rows[:100], *(turned(row, 2.5) for row in rows[100:])])
    dropped = [i for i, v in enumerate(verdicts) if v.use == "drop"]
    assert dropped == list(range(100, 100 + len(dropped)))
    assert 4 <= len(dropped) <= 6
    assert kinds(checks) == {Kind.JUMP: 1}
    assert "believed" in checks.findings[Kind.JUMP].text


def test_a_wrong_first_joint_state_is_given_up_for_the_next_two(checks):
    rows = joint_rows(100)
    verdicts = feed_joints(checks, [turned(rows[0], 1.5), *rows[1:]])
    assert [v.use for v in verdicts[:4]] == ["accept", "drop", "accept", "accept"]


@pytest.mark.parametrize("phase", [0, 1, 4, 9])
@pytest.mark.parametrize("other", [(0.0, 0.0), (3.0, 0.2)])
def test_of_two_drivers_the_one_that_was_there_is_used(checks, phase, other):
    rows = joint_rows(300)
    mixed = list(rows[:100])
    strange = []
    for row in rows[100:]:
        mixed.append(row)
        strange.append(len(mixed))
        mixed.append(delayed(row, phase * PERIOD // 10 + 1, other))
    verdicts = feed_joints(checks, mixed)
    assert [i for i, v in enumerate(verdicts) if v.use == "drop"] == strange
    assert kinds(checks)[Kind.TWO_PUBLISHERS] >= 195
    assert sum(kinds(checks).values()) <= 200


@pytest.mark.parametrize("apart", [0.06, 0.18])
def test_two_drivers_that_nearly_agree_are_told_apart_by_their_alternation(checks, apart):
    """What is apart by no more than actuators can move is told by the rhythm of the first driver."""
    rows = joint_rows(300)
    mixed = list(rows[:100])
    strange = set()
    for row in rows[100:]:
        mixed.append(row)
        strange.add(len(mixed))
        mixed.append(delayed(row, 4 * PERIOD // 10, tuple(a + apart for a in row[2])))
    verdicts = feed_joints(checks, mixed)
    assert [i for i, v in enumerate(verdicts) if v.use == "drop"] == sorted(strange)
    assert kinds(checks) == {Kind.TWO_PUBLISHERS: 200}


def test_a_second_driver_that_the_first_one_passes_by_is_left_out(checks):
    """It stands still where the first one comes along: each can be reached from the other for some messages."""
    mixed, strange = [], []
    for i, row in enumerate(joint_rows(300)):
        mixed.append(row)
        if i >= 100:
            strange.append(len(mixed))
            mixed.append(delayed(row, 4 * PERIOD // 10, joint_rows(112)[-1][2]))
    verdicts = feed_joints(checks, mixed)
    left_out = [i for i, v in enumerate(verdicts) if v.use == "drop"]
    assert not set(left_out) - set(strange)
    taken = [mixed[i] for i in strange if i not in left_out]
    near = [abs(a - b) for row in taken for a, b in zip(row[2], joint_rows(112)[-1][2], strict=True)]
    assert max(near, default=0.0) < 0.02


def test_a_second_driver_that_agreed_while_the_robot_rested_is_left_out_when_it_moves(checks):
    """Twice as many messages are no new rhythm of the first driver."""
    begins = 250 * PERIOD * 1e-9

    def motion(t):
        return sweep(max(t - begins, 0.0))

    mixed, strange = [], []
    for i, row in enumerate(joint_rows(350, motion)):
        mixed.append(row)
        if i >= 100:
            strange.append(len(mixed))
            mixed.append(delayed(row, 4 * PERIOD // 10, sweep(0.0)))
    verdicts = feed_joints(checks, mixed)
    left_out = [i for i, v in enumerate(verdicts) if v.use == "drop"]
    assert not set(left_out) - set(strange)
    assert left_out[-97:] == strange[-97:], "from the third message of the motion on"
    assert list(kinds(checks)) == [Kind.TWO_PUBLISHERS]


def test_of_two_drivers_in_step_the_one_that_repeats_its_values_is_the_other():
    """Messages of one stamp in any order, equal while the robot rests: no rhythm tells. But encoders have noise. Most are told apart."""
    begins, right = 250 * PERIOD * 1e-9, 0
    rows = joint_rows(400, lambda t: sweep(max(t - begins, 0.0)))
    for seed in range(12):
        rng, mixed, foreign = np.random.default_rng(seed), list(rows[:100]), []
        for row in rows[100:]:
            pair = [(row, False), ((row[0], row[1], rows[0][2], BETA), True)]
            for message, strange in pair if rng.random() < 0.5 else pair[::-1]:
                mixed.append(message)
                foreign.append(strange)
        used = [v.use != "drop" for v in feed_joints(JointChecks(2, load_robot("till2020_tissue")), mixed)][
            480:
        ]
        strange = foreign[380:]
        own = sum(u for u, s in zip(used, strange, strict=True) if not s)
        right += own > 0.75 * (len(strange) - sum(strange)) and not any(
            u and s for u, s in zip(used, strange, strict=True)
        )
    assert right >= 8


def test_one_message_off_the_rhythm_and_beside_the_motion_is_left_out(checks):
    rows = joint_rows(200)
    mixed = [
        *rows[:100],
        delayed(rows[99], 4 * PERIOD // 10, tuple(a + 0.1 for a in rows[99][2])),
        *rows[100:],
    ]
    verdicts = feed_joints(checks, mixed)
    assert [i for i, v in enumerate(verdicts) if v.use == "drop"] == [100]
    (text,) = [checks.findings[kind].text for kind in kinds(checks)]
    assert "beside its motion, limit" in text
    assert "left out; look for a second driver" in text


def test_a_second_driver_does_not_take_over_while_the_first_sends_no_numbers(checks):
    """The first moves by where the second one rests: the actuators could have come there."""
    rows, used = joint_rows(400), []
    rest = tuple(a + 0.1 for a in rows[299][2])
    for k, row in enumerate(rows):
        broken = 300 <= k < 345
        checks.check(*(turned(row, math.nan) if broken else row))
        if k >= 300:
            used.append(checks.check(*delayed(row, 4_000_000, rest)).use)
    assert used.count("drop") >= 95


def test_a_driver_that_loses_its_rhythm_is_used_on(checks):
    """As where it begins to stamp on arrival: what lies on the line of its motion is no second driver's."""
    rng, rows = np.random.default_rng(2), joint_rows(300)
    uneven = [delayed(row, round(0.5 * PERIOD * rng.random()), row[2]) for row in rows[100:]]
    verdicts = feed_joints(checks, [*rows[:100], *uneven])
    assert all(v.use != "drop" for v in verdicts)


def test_a_driver_that_goes_on_alone_is_taken_over(checks):
    rows = joint_rows(400, still)
    mixed = list(rows[:100])
    for row in rows[100:200]:
        mixed += [row, delayed(row, 4_000_000, (3.0, 0.2))]
    mixed += [delayed(row, 4_000_000, (3.0, 0.2)) for row in rows[200:]]
    verdicts = feed_joints(checks, mixed)
    assert verdicts[-1].use == "accept"
    assert {v.use for v in verdicts[-150:]} == {"accept"}


@pytest.mark.parametrize("motion", [still, sweep])
@pytest.mark.parametrize(("gap", "apart", "left_out"), [(0, 0.0, 0), (0, 1.0, 4), (50, 0.0, 0), (50, 1.0, 0)])
def test_a_driver_that_starts_again_is_used_at_once_unless_it_jumps(checks, motion, gap, apart, left_out):
    rows = joint_rows(500, motion)
    again = [delayed(row, 4_000_000, tuple(a + apart for a in row[2])) for row in rows[300 + gap :]]
    verdicts = feed_joints(checks, [*rows[:300], *again])
    assert [i for i, v in enumerate(verdicts) if v.use == "drop"] == list(range(300, 300 + left_out))


@pytest.mark.parametrize("motion", [still, sweep])
@pytest.mark.parametrize(("apart", "left_out_s"), [(0.0, 0.0), (0.1, 0.24), (1.0, 0.24)])
def test_a_driver_that_starts_before_the_other_stops_takes_over(checks, motion, apart, left_out_s):
    rows = joint_rows(500, motion)
    other = [delayed(row, 4_000_000, tuple(a + apart for a in row[2])) for row in rows[250:]]
    both = sorted([*rows[:300], *other], key=lambda row: row[0])
    verdicts = feed_joints(checks, both)
    late = [
        row[0] for row, v in zip(both, verdicts, strict=True) if v.use == "drop" and row[0] > rows[300][0]
    ]
    assert len(late) == round(100 * left_out_s)


@pytest.mark.parametrize("before", [True, False])
def test_a_second_driver_that_sends_zeros_at_the_same_stamps_is_left_out(checks, before):
    mixed, zeros = [], []
    for row in joint_rows(200):
        zero = (row[0], row[1], (0.0, 0.0), (0.0, 0.0))
        zeros.append(len(mixed) + (not before))
        mixed += [zero, row] if before else [row, zero]
    verdicts = feed_joints(checks, mixed)
    assert [i for i, v in enumerate(verdicts) if v.use == "drop"] == zeros
    assert kinds(checks)[Kind.TWO_PUBLISHERS] >= 190


def test_zeros_before_the_drives_are_homed_are_not_believed(checks):
    rows = joint_rows(200)
    start = [(row[0], row[1], (0.0, 0.0), (0.0, 0.0)) for row in rows[:60]]
    verdicts = feed_joints(checks, start + rows[60:])
    assert {v.use for v in verdicts[:60]} == {"drop"}
    assert {v.use for v in verdicts[60:]} == {"accept"}
    assert kinds(checks) == {Kind.ALL_ZERO: 60}


def test_a_robot_that_rests_at_zero_starts_there():
    robot = load_robot("till2020_tissue")
    rest = robot.rest.model_copy(
        update={
            "alpha": robot.rest.alpha.model_copy(update={"value": (0.0, 0.0)}),
            "beta": robot.rest.beta.model_copy(update={"value": (0.0, 0.0)}),
        }
    )
    checks = JointChecks(2, robot.model_copy(update={"rest": rest}))
    rows = [(T0 + k * PERIOD, None, (0.0, 0.0), (0.0, 0.0)) for k in range(5)]
    assert {v.use for v in feed_joints(checks, rows)} == {"accept"}


def test_a_gap_in_motion_says_how_long_and_how_fast(checks):
    rows = joint_rows(300)
    verdicts = feed_joints(checks, rows[:100] + rows[125:])
    assert verdicts[100].kind is Kind.GAP_IN_MOTION
    assert "0.260 s" in verdicts[100].text
    assert "rad/s" in verdicts[100].text
    assert {v.use for v in verdicts} == {"accept"}


def test_a_gap_at_rest_is_only_a_note(checks):
    rows = joint_rows(300, still)
    verdicts = feed_joints(checks, rows[:100] + rows[190:])
    assert verdicts[100].kind is Kind.GAP
    assert checks.findings[Kind.GAP].level == "note"


def test_numbers_that_are_missing_in_motion_make_a_gap(checks):
    rows = joint_rows(300)
    rows[100:160] = [turned(row, math.nan) for row in rows[100:160]]
    verdicts = feed_joints(checks, rows)
    assert verdicts[160].kind is Kind.GAP_IN_MOTION
    assert kinds(checks) == {Kind.NOT_FINITE: 60, Kind.GAP_IN_MOTION: 1}


def test_the_same_joint_state_twice_counts_once(checks):
    row = joint_rows(1)[0]
    assert checks.check(*row).use == "accept"
    assert checks.check(*row).kind is Kind.REPEATED


def test_speed_limits_of_the_actuators_can_be_given():
    slow = CheckOptions(limits=dataclasses.replace(CheckLimits(), rotation_speed=1.0))
    checks = JointChecks(2, options=slow)
    verdicts = feed_joints(checks, joint_rows(100))
    assert Kind.JUMP in {v.kind for v in verdicts}


def test_after_a_reset_everything_begins_anew(checks):
    feed_joints(checks, joint_rows(100))
    checks.forget()
    earlier = [(s - 10**12, a, tuple(v + 2.0 for v in r), b) for s, a, r, b in joint_rows(50)]
    assert {v.use for v in feed_joints(checks, earlier)} == {"accept"}


def test_joint_states_without_stamps_start_nothing(checks):
    """They come on a wall clock; what follows with stamps is right, and judged by itself."""
    rows = joint_rows(400)
    verdicts = feed_joints(checks, [(0, *row[1:]) for row in rows[:100]] + rows[100:])
    assert {v.use for v in verdicts[:100]} == {"drop"}
    assert {v.use for v in verdicts[100:]} == {"accept"}
    assert kinds(checks) == {Kind.STAMP_ZERO: 100}


def test_joint_states_that_stand_still_without_stamps_start_nothing(checks):
    rows = [(0, row[1], *joint_rows(1)[0][2:]) for row in joint_rows(100)]
    assert {v.use for v in feed_joints(checks, rows)} == {"drop"}
    assert kinds(checks) == {Kind.STAMP_ZERO: 100}


@pytest.mark.parametrize("recorded", [False, True])
def test_a_simulation_begins_at_zero(checks, recorded):
    """Recorded on a wall clock, its first joint state is not used, as it may be without a stamp; nothing is found wrong."""
    rows = [(s - T0, a if recorded else a - T0, *values) for s, a, *values in joint_rows(200)]
    verdicts = feed_joints(checks, rows)
    assert [v.use for v in verdicts] == ["drop" if recorded else "accept"] + ["accept"] * 199
    assert kinds(checks) == {}
