"""Stamps of one stream: zero, ahead, set back, in bursts, rounded; lost, late and jittering messages are none of these."""

from __future__ import annotations

import numpy as np
import pytest
from stream_cases import T0

from ctr_dynamics.sensing.checks.check_limits import CheckLimits
from ctr_dynamics.sensing.checks.stamp_checks import StampChecks, known_shift
from ctr_dynamics.sensing.checks.verdicts import Findings, Kind, Verdict

PERIOD = 25_000_000


@pytest.fixture
def stamps() -> StampChecks:
    return StampChecks("pose", Findings("tracker"), CheckLimits(), 0.025)


def feed(stamps: StampChecks, messages: list[tuple[int, int | None]]) -> list[Verdict]:
    verdicts = []
    for stamp, arrival in messages:
        verdict = stamps.check(stamp, arrival)
        if verdict.use != "drop":
            taken = stamps.take(stamp, arrival)
            verdict = verdict if taken.kind is None else taken
        verdicts.append(verdict)
    return verdicts


def even(count: int, delay: int = 2_000_000) -> list[tuple[int, int | None]]:
    return [(T0 + k * PERIOD, T0 + k * PERIOD + delay) for k in range(count)]


def test_even_stamps_are_believed(stamps):
    assert {v.use for v in feed(stamps, even(200))} == {"accept"}
    assert stamps.period_s == pytest.approx(0.025)
    assert stamps.clock_offset_ns == 2_000_000
    assert not list(stamps.findings)


@pytest.mark.parametrize("case", ["jitter", "network", "lost", "late", "no arrival", "coarse clock", "drift"])
def test_ordinary_trouble_on_the_way_is_not_a_fault(stamps, case):
    rng = np.random.default_rng(3)
    messages = even(400)
    if case == "jitter":
        messages = [
            (s + d, a + d)
            for (s, a), d in zip(messages, rng.integers(-5_000_000, 5_000_000, 400).tolist(), strict=True)
        ]
    elif case == "network":
        messages = [
            (s, a + d)
            for (s, a), d in zip(messages, rng.exponential(8e6, 400).astype(int).tolist(), strict=True)
        ]
    elif case == "lost":
        messages = [m for m in messages if rng.random() > 0.5]
    elif case == "late":
        messages = sorted(
            (
                (s, a + d)
                for (s, a), d in zip(messages, rng.integers(0, 150_000_000, 400).tolist(), strict=True)
            ),
            key=lambda m: m[1],
        )
    elif case == "no arrival":
        messages = [(s, None) for s, _ in messages if rng.random() > 0.2]
    elif case == "coarse clock":
        messages = [(s, a // 33_000_000 * 33_000_000) for s, a in messages]
    else:
        messages = [(s, T0 + round((a - T0) * 1.0005)) for s, a in messages]
    assert {v.use for v in feed(stamps, messages)} == {"accept"}
    assert not list(stamps.findings)


def test_stamps_of_zero_are_dropped_and_counted_from_the_first(stamps):
    verdicts = feed(stamps, [(0, T0 + k * PERIOD) for k in range(20)])
    assert [v.use for v in verdicts] == ["accept"] + ["drop"] * 19
    assert stamps.findings.count(Kind.STAMP_ZERO) == 20
    assert not stamps.believed


def test_a_simulation_may_begin_at_zero(stamps):
    assert {v.use for v in feed(stamps, [(k * PERIOD, T0 + k * PERIOD) for k in range(100)])} == {"accept"}
    assert not list(stamps.findings)


@pytest.mark.parametrize("ahead", [0.03, 0.4, 0.9, 3600.0])
def test_one_stamp_ahead_of_its_arrival_is_dropped(stamps, ahead):
    messages = even(100)
    messages[60] = (messages[60][0] + round(ahead * 1e9), messages[60][1])
    verdicts = feed(stamps, messages)
    assert [i for i, v in enumerate(verdicts) if v.use == "drop"] == [60]
    assert stamps.findings.count(Kind.STAMP_AHEAD) == 1


@pytest.mark.parametrize("behind_s", [0, 1041])
def test_a_stamp_ahead_says_by_how_much_and_the_limit(stamps, behind_s):
    """Against the arrivals where these are of the same clock, else against the stamps before it."""
    messages = [(s - behind_s * 1_000_000_000, a) for s, a in even(100)]
    messages[60] = (messages[60][0] + 402_000_000, messages[60][1])
    feed(stamps, messages)
    said = stamps.findings[Kind.STAMP_AHEAD].text
    same, other = (
        "0.400 s after its arrival, limit 0.020 s",
        "0.402 s ahead of those before it, by their arrivals, limit 0.02 s",
    )
    assert (other if behind_s else same) in said


def test_a_stamp_ahead_is_taken_back_where_arrivals_are_unknown(stamps):
    messages: list[tuple[int, int | None]] = [(s, None) for s, _ in even(100)]
    wrong = messages[60][0] + 900_000_000
    messages[60] = (wrong, None)
    verdicts = feed(stamps, messages)
    assert verdicts[61].retract_ns == wrong
    assert {v.use for v in verdicts} == {"accept"}


def test_a_clock_that_is_set_ahead_is_followed_after_two_messages(stamps):
    messages = even(100)
    messages[50:] = [(s + 3600 * 10**9, a) for s, a in messages[50:]]
    verdicts = feed(stamps, messages)
    assert [i for i, v in enumerate(verdicts) if v.use == "drop"] == [50, 51]
    assert "1 h" in known_shift(3600.0)
    assert stamps.findings.count(Kind.CLOCK_AHEAD) == 1


def test_a_clock_that_is_set_back_is_named_with_a_hint(stamps):
    messages = even(100)
    messages[50:] = [(s - 86_400 * 10**9, a) for s, a in messages[50:]]
    verdicts = feed(stamps, messages)
    assert {v.use for v in verdicts[50:]} == {"drop"}
    assert stamps.findings.count(Kind.CLOCK_BACK) == 50
    assert "midnight" in stamps.findings[Kind.CLOCK_BACK].text


def test_a_recording_that_is_played_again_stays_dropped_to_its_end(stamps):
    again = [(s, a + 5 * 10**9) for s, a in even(100)]
    verdicts = feed(stamps, even(100) + again)
    assert {v.use for v in verdicts[100:199]} == {"drop"}


@pytest.mark.parametrize("size", [2, 4, 10])
@pytest.mark.parametrize("spacing", [0, 100_000])
def test_stamps_of_arrival_in_bursts_are_spaced_evenly(stamps, size, spacing):
    messages = []
    for k in range(400):
        last = (k // size * size + size - 1) * PERIOD
        stamp = T0 + last + k % size * spacing
        messages.append((stamp, stamp + k % size * 20_000 + 1_000_000))
    verdicts = feed(stamps, messages)
    assert stamps.mode == "bursts"
    named = next(i for i, v in enumerate(verdicts) if v.kind is Kind.BURSTS)
    assert named <= 3 * size + 4
    errors = [
        v.stamp_ns - (T0 + i * PERIOD) for i, v in enumerate(verdicts) if i > named + 2 * size and v.stamp_ns
    ]
    assert len(errors) > 300
    assert max(abs(e) for e in errors) < 1_500_000


def test_bursts_with_a_lost_message_recover(stamps):
    messages = []
    for k in range(800):
        if k == 400:
            continue
        last = (k // 4 * 4 + 3) * PERIOD
        stamp = T0 + last + k % 4 * 100_000
        messages.append((stamp, stamp))
    verdicts = feed(stamps, messages)
    late = [v.stamp_ns - (T0 + (i + 1) * PERIOD) for i, v in enumerate(verdicts) if i > 700 and v.stamp_ns]
    assert max(abs(e) for e in late) < 8_000_000


def bursts(count, size=4, left_out=range(0)):
    """Stamps of arrival of ``count`` messages, handed over by ``size``, without those ``left_out``; and their true times."""
    found = []
    for k in range(count):
        stamp = T0 + (k // size * size + size - 1) * PERIOD + k % size * 100_000
        if k not in left_out:
            found.append((T0 + k * PERIOD, stamp))
    return found


@pytest.mark.parametrize("size", [2, 4, 10])
def test_bursts_are_spaced_evenly_as_soon_as_a_pause_is_over(stamps, size):
    messages = bursts(800, size, range(400, 500))
    verdicts = feed(stamps, [(stamp, stamp) for _, stamp in messages])
    errors = [v.stamp_ns - true for v, (true, _) in zip(verdicts[400:], messages[400:], strict=True)]
    assert max(map(abs, errors)) < 1_500_000


def test_messages_that_are_left_out_keep_their_place_in_a_burst(stamps):
    rng, errors = np.random.default_rng(4), []
    for k, (true, stamp) in enumerate(bursts(800)):
        if k > 300 and rng.random() < 0.4:
            stamps.pass_over(stamp, stamp)
            continue
        (verdict,) = feed(stamps, [(stamp, stamp)])
        if k > 300:
            errors.append(verdict.stamp_ns - true)
    assert max(map(abs, errors)) < 1_500_000


def test_bursts_amid_an_even_rhythm_are_left_out_until_they_are_known(stamps):
    first, size = 201, 4
    messages = [(s, s) for s, _ in even(first)] + bursts_from(first, 200, size) + bursts_from(401, 100, 1)
    wrong = 0
    for k, (verdict, (stamp, _)) in enumerate(zip(feed(stamps, messages), messages, strict=True)):
        if verdict.use != "drop":
            used = stamp if verdict.stamp_ns is None else verdict.stamp_ns
            wrong += abs(used - (T0 + k * PERIOD)) > 2_000_000
    assert wrong <= 3  # the first of each of some bursts
    assert stamps.findings.count(Kind.BURSTS) > 150


def rounded(stamp: int, grid: int = 20_000_000) -> int:
    return T0 + (stamp - T0) // grid * grid


@pytest.mark.parametrize("size", [3, 4, 6])
def test_bursts_are_seen_where_rounding_parts_their_stamps(stamps, size):
    """Half of every burst is stamped just before a multiple of the grid, the others just after."""
    messages = []
    for k in range(400):
        arrival = T0 + (k // size) * 20_000_000 * round(1.25 * size) + (k % size - size // 2) * 100_000
        messages.append((rounded(arrival), arrival))
    feed(stamps, messages)
    assert stamps.mode == "bursts"


@pytest.mark.parametrize("size", [2, 4, 8])
@pytest.mark.parametrize("first", range(4))
def test_packets_of_rounded_times_of_measurement_are_no_bursts(stamps, size, first):
    """They are handed over together, but the stamps go on within a packet."""
    messages = []
    for k in range(400):
        newest = T0 + (k // size * size + size - 1 + first) * PERIOD
        messages.append((rounded(T0 + (k + first) * PERIOD), newest + 1_000_000 + (k % size) * 100_000))
    feed(stamps, messages)
    assert stamps.mode != "bursts"


def bursts_from(first, count, size):
    """Stamps and arrivals of ``count`` messages from number ``first`` on, handed over by ``size``."""
    rows = range(first, first + count)
    found = [
        T0 + (first + (k - first) // size * size + size - 1) * PERIOD + (k - first) % size * 100_000
        for k in rows
    ]
    return [(stamp, stamp) for stamp in found]


@pytest.mark.parametrize("lost", [0.1, 0.3])
def test_where_messages_of_bursts_are_lost_the_error_of_their_times_is_told(stamps, lost):
    rng = np.random.default_rng(5)
    kept = [row for row in bursts(2000) if rng.random() > lost]
    errors, told = [], []
    for k, (true, stamp) in enumerate(kept):
        (verdict,) = feed(stamps, [(stamp, stamp)])
        if k > 100 and verdict.stamp_ns:
            errors.append(verdict.stamp_ns - true)
            told.append(verdict.error_s * 1e9)
    rms = np.sqrt(np.mean(np.square(errors)))
    assert rms < PERIOD
    assert 0.5 * rms < np.sqrt(np.mean(np.square(told))) < 2.0 * rms


def test_times_of_whole_bursts_are_known_well(stamps):
    verdicts = feed(stamps, [(stamp, stamp) for _, stamp in bursts(200)])
    assert 0.0 < verdicts[-1].error_s < 1e-3


@pytest.mark.parametrize(
    ("grid", "arrives"),
    [(10_000_000, True), (7_000_000, True), (16_000_000, True), (10_000_000, False), (7_000_000, False)],
)
def test_rounded_stamps_are_named_and_mended(stamps, grid, arrives):
    messages = []
    for k in range(400):
        true = T0 + 3_000_000 + k * PERIOD
        messages.append((true // grid * grid, true + 4_000_000 if arrives else None))
    verdicts = feed(stamps, messages)
    assert Kind.ROUNDED in stamps.findings
    errors = [
        v.stamp_ns - (T0 + 3_000_000 + k * PERIOD) for k, v in enumerate(verdicts) if v.stamp_ns and k > 100
    ]
    assert len(errors) == 299
    raw = [m[0] - (T0 + 3_000_000 + k * PERIOD) for k, m in enumerate(messages) if k > 100]
    assert np.std(errors) < 0.5 * np.std(raw)
    assert stamps.error_s > 0.0


def test_stamps_that_stand_for_a_second_cannot_be_used(stamps):
    messages = [((T0 + k * PERIOD) // 10**9 * 10**9, T0 + k * PERIOD) for k in range(400)]
    verdicts = feed(stamps, messages)
    assert stamps.mode == "unusable"
    assert {v.use for v in verdicts[20:]} == {"drop"}


def test_messages_lost_from_even_stamps_are_no_coarse_stamps(stamps):
    rng = np.random.default_rng(0)
    messages = [(T0 + k * 10_000_000, None) for k in range(600) if rng.random() > 0.3]
    feed(stamps, messages)
    assert not list(stamps.findings)


@pytest.mark.parametrize("before", range(1, 15))
def test_a_pause_soon_after_the_start_is_got_over(stamps, before):
    """As where a node is stopped for a moment: the rhythm is taken from the stretch behind it."""
    pause = 4_000_000_000
    messages = even(before + 40)
    later = [(s + pause, a + pause) for s, a in messages[before:]]
    assert {v.use for v in feed(stamps, messages[:before] + later)} == {"accept"}
    assert stamps.rhythm_s == pytest.approx(0.025)


@pytest.mark.parametrize("before", range(6, 60))
def test_a_pause_amid_bursts_is_got_over(stamps, before):
    """Also where they have just been recognised, and the place of the last message in its burst was not known."""
    stamped = [stamp + 4_000_000_000 * (k >= before) for k, (_, stamp) in enumerate(bursts(before + 60))]
    verdicts = feed(stamps, [(stamp, stamp) for stamp in stamped])
    assert verdicts[-1].kind is Kind.BURSTS
    assert verdicts[-1].use == "correct"
