"""Whatever comes, and in whatever order: every message gets a verdict."""

from __future__ import annotations

import numpy as np
import pytest

from ctr_dynamics.robot_files import load_robot
from ctr_dynamics.sensing.checks.check_limits import CheckOptions
from ctr_dynamics.sensing.checks.input_checks import InputChecks

T0, S = 1_700_000_000_000_000_000, 1_000_000_000
PERIODS = {"joints": S // 100, "pose": S // 40, "load": S // 20}
TROUBLES = ("even", "burst", "pause", "zero", "back", "rounded", "stand", "ahead", "huge")


class Stamps:
    """Stamps of three streams, in one trouble after the other, and arrivals on one clock."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng, self.trouble, self.arrival = rng, "even", T0
        self.last = dict.fromkeys(PERIODS, T0)

    def next(self, stream: str) -> tuple[int, int | None]:
        rng, last, period = self.rng, self.last[stream], PERIODS[stream]
        if rng.random() < 0.06:
            self.trouble = str(rng.choice(TROUBLES))
        trouble, stamp = self.trouble, last + period
        if trouble == "pause":
            stamp += int(rng.choice([S // 2, S, 3 * S, 10 * S]))
            self.trouble = "even"
        elif trouble == "burst":
            stamp = last + (int(rng.integers(0, 3)) if rng.random() < 0.75 else 4 * period)
        elif trouble == "back":
            stamp = last - int(rng.choice([S // 100, S // 3, 5 * S]))
        elif trouble == "rounded":
            stamp -= stamp % (S // 10)
        elif trouble == "stand":
            stamp = last
        if trouble in ("ahead", "huge"):
            self.trouble = "even"
            given = stamp + int(rng.choice([0.4, 0.9, 7200.0]) * S) if trouble == "ahead" else 2**63 - 2
        else:
            self.last[stream], given = stamp, 0 if trouble == "zero" else stamp
        self.arrival = max(self.arrival, min(stamp + int(rng.integers(0, 3_000_000)), self.arrival + 10 * S))
        return given, self.arrival if rng.random() < 0.95 else None


def joints(rng: np.random.Generator, values: np.ndarray) -> np.ndarray:
    out, chance = values.copy(), rng.random()
    if chance < 0.03:
        out[rng.integers(4)] = rng.choice([np.nan, np.inf, 1e160, 0.0, -1e9])
    elif chance < 0.06:
        out[0] += rng.choice([2 * np.pi, -2 * np.pi, 1.0])
    elif chance < 0.08:
        out[:] = 0.0
    return out


def pose(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    at, turned, chance = np.array([0.05, 0.02, 0.1]), np.array([0.0, 0.0, 0.0, 1.0]), rng.random()
    if chance < 0.03:
        at = np.full(3, rng.choice([np.nan, 1e160, 0.0, -9999.0]))
    elif chance < 0.05:
        turned = rng.choice([0.0, np.nan, 1e200]) * np.ones(4)
    elif chance > 0.2:
        at = at + rng.normal(0.0, 5e-4, 3)
    return at, turned


@pytest.mark.parametrize("seed", range(60))
def test_every_message_gets_a_verdict(seed):
    rng = np.random.default_rng(seed)
    checks, stamps = InputChecks(2, load_robot("till2020_tissue"), CheckOptions()), Stamps(rng)
    values = np.array([1.57, 1.57, -0.2521, -0.1977])
    for _ in range(rng.integers(5, 200)):
        stream = str(rng.choice(["joints", "joints", "pose", "pose", "load"]))
        stamp, arrival = stamps.next(stream)
        if stream == "joints":
            values[:2] += rng.normal(0.0, 0.01, 2)
            read = joints(rng, values).tolist()
            verdict = checks.joint_state(stamp, arrival, read[:2], read[2:])
        elif stream == "pose":
            expected = (1.0, 0.0, 0.0, 0.0) if rng.random() < 0.3 else None
            position, quaternion = (tuple(part.tolist()) for part in pose(rng))
            frame = str(rng.choice(["ctr_base", "ctr_base", "other", ""]))
            verdict = checks.pose(stamp, arrival, position, quaternion, frame, expected)
        else:
            force = tuple((rng.normal(0.0, 0.01, 3) * rng.choice([1.0, 5000.0, np.nan])).tolist())
            verdict = checks.load(stamp, arrival, force, (0.0, 0.0, 0.0), "ctr_base")
        assert verdict.use in ("accept", "correct", "drop")
