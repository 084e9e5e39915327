"""The example controller: its law, and the loop over real DDS around a robot that is not quite the one of the file."""

from __future__ import annotations

import importlib
import math
import os
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

EXAMPLE = Path(__file__).parents[2] / "examples" / "05_vibration_suppression"


def load(name: str):
    """A file of the example, which is a folder of scripts and no package."""
    if str(EXAMPLE) not in sys.path:
        sys.path.insert(0, str(EXAMPLE))
    return importlib.import_module(name)


damper = load("damper")
OMEGA, ZETA, X, PERIOD = 35.0, 0.02, 0.083, 0.01


class Oscillator:
    """The mode that the law is made for; drives take a command over `latency_s` after it was sent."""

    def __init__(self, latency_s: float, omega: float = OMEGA) -> None:
        self.t, self.w, self.rate, self.latency_s, self.omega = 0.0, 0.025, 0.0, latency_s, omega
        self.delta = 0.0
        self.sent: list[tuple[float, float]] = []

    def advance(self, seconds: float) -> None:
        h = 1e-4
        for _ in range(round(seconds / h)):
            before = self.delta
            while self.sent and self.sent[0][0] + self.latency_s <= self.t + 1e-9:
                self.delta = self.sent.pop(0)[1]
            self.rate -= 2 * ZETA * self.omega * (h * self.rate - X * (self.delta - before))
            self.rate -= h * self.omega**2 * (self.w - X * self.delta)
            self.w += h * self.rate
            self.t += h


def closed_loop(
    latency_s: float, seconds: float, valid=lambda t: True, omega: float = OMEGA, told_s: float | None = None
):
    """(t, w, delta) at each command; `told_s` is the latency that the controller believes."""
    plant, drives = Oscillator(latency_s, omega), damper.DriveHistory()
    law = damper.ModalDamper(
        X, PERIOD, damper.Tuning(latency_s=latency_s if told_s is None else told_s, settle_steps=3)
    )
    rows = []
    for _ in range(round(seconds / PERIOD)):
        drives.add(plant.t, plant.delta)
        drive = drives.at(plant.t)
        if valid(plant.t) and drive is not None:
            delta, rate = drive
            law.take(
                damper.Estimate(
                    plant.t, plant.w - X * delta, plant.rate - X * rate, OMEGA, ZETA, 0.005, delta, rate
                )
            )
        delta = law.command(plant.t)
        plant.sent.append((plant.t, delta))
        rows.append((plant.t, plant.w, delta))
        plant.advance(PERIOD)
    return np.array(rows)


@pytest.mark.parametrize("latency_s", [0.0, 0.01, 0.02, 0.04])
def test_law_adds_the_damping_that_it_is_told(latency_s):
    rows = closed_loop(latency_s, 1.6)
    late = np.abs(rows[rows[:, 0] > 1.2, 1]).max()
    free = 0.025 * math.exp(-ZETA * OMEGA * 1.2)
    assert late < 0.1 * free


def test_without_prediction_the_same_gain_loses_its_damping():
    """The delay is what the prediction is for: told that there is none, 40 ms take the damping away."""
    with_it, without = closed_loop(0.04, 1.6), closed_loop(0.04, 1.6, told_s=0.0)
    end = with_it[:, 0] > 1.2
    assert np.abs(without[end, 1]).max() > 5 * np.abs(with_it[end, 1]).max()


@settings(max_examples=40, deadline=None)
@given(st.floats(-0.12, 0.12), st.floats(-0.004, 0.004))
def test_wrong_frequency_and_delay_do_not_destabilise(frequency_error, delay_error):
    rows = closed_loop(0.02, 2.0, omega=OMEGA * (1 + frequency_error), told_s=0.02 + delay_error)
    assert np.abs(rows[rows[:, 0] > 1.5, 1]).max() < 0.01


@settings(max_examples=60, deadline=None)
@given(
    st.lists(
        st.tuples(
            st.floats(allow_nan=True),
            st.floats(allow_nan=True),
            st.floats(-10, 1e3),
            st.floats(-1, 1),
            st.booleans(),
        ),
        min_size=5,
        max_size=60,
    )
)
def test_commands_keep_their_limits_whatever_comes(items):
    limits = damper.Limits()
    law = damper.ModalDamper(X, PERIOD, damper.Tuning(settle_steps=1), limits)
    before = 0.0
    for k, (amplitude, speed, omega, delta, valid) in enumerate(items):
        if valid:
            law.take(damper.Estimate(k * PERIOD, amplitude, speed, omega, ZETA, 0.01, delta, 0.0))
        else:
            law.invalid()
        now = law.command(k * PERIOD)
        assert math.isfinite(now)
        assert abs(now) <= limits.angle + 1e-12
        assert abs(now - before) <= limits.rate * PERIOD + 1e-9
        before = now


def test_open_loop_decays_to_rest():
    rows = closed_loop(0.02, 4.0, valid=lambda t: t < 0.25)
    opened = rows[rows[:, 0] > 0.4]
    assert np.abs(rows[:, 2]).max() > 0.01
    assert np.all(np.diff(np.abs(opened[:, 2])) <= 0.0)
    assert abs(rows[-1, 2]) < 1e-3


def test_stale_estimates_open_the_loop():
    law = damper.ModalDamper(X, PERIOD, damper.Tuning(settle_steps=1))
    law.take(damper.Estimate(0.0, 0.02, 0.5, OMEGA, ZETA, 0.01, 0.0, 0.0))
    law.command(0.01)
    assert law.closed
    law.command(0.2)
    assert not law.closed


def test_no_authority_is_rejected():
    with pytest.raises(ValueError, match="nothing to damp"):
        damper.ModalDamper(0.0, PERIOD)


def test_drive_history_is_linear():
    history = damper.DriveHistory()
    assert history.at(0.0) is None
    for k in range(10):
        history.add(0.01 * k, 0.1 * k)
    assert history.at(0.045) == pytest.approx((0.45, 10.0))
    assert history.at(0.095) == pytest.approx((0.95, 10.0))
    assert history.at(1.0) is None
    history.add(0.0, 0.0)  # the clock went back
    assert history.at(0.0) is None


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Release without control, with it, with an outage of the joints, and with the estimator killed."""
    pytest.importorskip("rclpy")
    example = load("run")
    folder, domain = tmp_path_factory.mktemp("release"), int(os.environ["ROS_DOMAIN_ID"])
    cases = {
        "free": {"control": False},
        "controlled": {},
        "outage": {"outage_s": (1.15, 1.65)},
        "killed": {"kill_estimator_after_s": 1.2},
    }
    return {
        # so slow that what a busy machine takes for a message is little of the robot's time
        name: example.release(folder / name, domain, seconds=4.0, speed=0.15, **options)
        for name, options in cases.items()
    }


@pytest.mark.ros
@pytest.mark.slow
def test_tip_settles_at_least_twice_as_fast(runs):
    free, controlled = runs["free"], runs["controlled"]
    assert free.swing_m(1.05, 2.0) > 0.05  # the large y vibration
    assert np.abs(free.delta).max() == 0.0
    assert controlled.settled_s < 0.5 * free.settled_s
    assert np.abs(controlled.delta).max() <= 0.15
    assert np.abs(np.diff(controlled.delta)).max() <= 3.0 * 0.003 + 1e-9
    assert controlled.swing_m(3.0, 4.0) < 0.003


@pytest.mark.ros
@pytest.mark.slow
@pytest.mark.parametrize("case", ["outage", "killed"])
def test_nothing_grows_when_the_estimator_fails(runs, case):
    free, failed = runs["free"], runs[case]
    for begin in np.arange(1.2, 3.9, 0.2):
        # the opened loop leaves at most what the fading angle moves
        assert failed.swing_m(begin, begin + 0.2) < 1.05 * free.swing_m(begin, begin + 0.2) + 0.012
    assert np.abs(failed.delta).max() <= 0.15
    assert np.abs(failed.delta[failed.t > 3.5]).max() < 0.005
    if case == "outage":  # the loop is closed again and ends what is left
        assert failed.settled_s < free.settled_s
