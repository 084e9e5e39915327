"""Outputs are neither of the future nor of the past: what the step loop and the estimator do about late rounds and joints that are stamped ahead."""

from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
import pytest

from ctr_dynamics.estimation.estimator import Estimator
from ctr_dynamics.io.messages.topics import STEP_NS
from ctr_dynamics.parameters import Settings
from ctr_dynamics.robot_files import load_robot
from ctr_dynamics.runtime.step_loop import Clock, StepLoop
from ctr_dynamics.runtime.timing import StepTiming

MS = 1_000_000


class Out(NamedTuple):
    k: int
    stamp_ns: int
    valid: bool = True
    reason: str = ""


class Steady:
    """Takes every step that is due."""

    lead_ns, correcting = 0, False

    def __init__(self, t0_ns):
        self.t0_ns, self.k = t0_ns, 0

    def advance(self, now_ns=None, spare_s=None, most=None, too_old=None):
        steps = []
        while self.t0_ns + self.k * STEP_NS <= now_ns and (most is None or len(steps) < most):
            steps.append(Out(self.k, self.t0_ns + self.k * STEP_NS))
            self.k += 1
        return steps

    def do_idle_work(self):
        pass

    def reset(self):
        raise AssertionError("a pause of two seconds is caught up with")


def test_what_a_stopped_node_catches_up_with_is_invalid():
    """SIGSTOP for two seconds: the steps of that time go out, and say how old they are; then all is as before."""
    clock = SimpleNamespace(now=10_000 * MS)
    published = []
    loop = StepLoop(
        Steady(clock.now),
        lambda step, by_now: published.append(by_now(step)) is None,
        lambda now, idle: None,
        Clock(lambda: clock.now),
        StepTiming("predict", 100 * MS),
        lambda text: None,
        gather_ns=0,
        max_age_ns=60 * MS,
    )
    loop._round()
    clock.now += 2_000 * MS
    while published[-1].stamp_ns + STEP_NS <= clock.now:
        loop._round()
    assert [out.k for out in published] == list(range(len(published)))
    for out in published[1:]:
        assert out.valid == (clock.now - out.stamp_ns <= 60 * MS)
    assert "output is 1.997 s old when it goes out, limit 0.06 s" in published[1].reason
    assert loop.timing.too_old == sum(not out.valid for out in published) > 600
    clock.now += 3 * MS
    loop._round()
    assert published[-1].valid


@pytest.mark.parametrize("policy", ["predict", "wait"])
def test_a_joint_state_that_is_stamped_ahead_does_not_take_the_outputs_with_it(policy):
    robot = load_robot("till2020_tissue")
    estimator = Estimator(robot, Settings({"output.policy": policy}))
    names = [f"tube{i}_{kind}" for i in (1, 2) for kind in ("rotation", "translation")]
    positions = [0.1, -0.2521, 0.1, -0.1977]
    start_ns, ahead_ns = 1_000_000 * MS, 900 * MS
    for k in range(30):
        now_ns = start_ns + 10 * k * MS
        estimator.add_joint_state(now_ns + (ahead_ns if k == 20 else 0), names, positions)
        for out in estimator.advance(now_ns):
            assert out.stamp_ns <= now_ns
    assert out.stamp_ns > now_ns - STEP_NS - (10 * MS if policy == "wait" else 0)


def test_a_step_that_is_too_old_moves_the_model_and_has_no_estimate():
    names = [f"tube{i}_{kind}" for i in (1, 2) for kind in ("rotation", "translation")]
    start_ns, held_up, steps = 1_000_000 * MS, range(10, 20), 30
    outputs = []
    for too_old in (
        lambda stamp_ns: "",
        lambda stamp_ns: "late" * ((stamp_ns - start_ns) // STEP_NS in held_up),
    ):
        estimator = Estimator(load_robot("till2020_tissue"), Settings({"output.policy": "wait"}))
        for k in range(steps + 1):
            estimator.add_joint_state(start_ns + k * STEP_NS, names, [2e-4 * k, -0.2521, 2e-4 * k, -0.1977])
        outputs.append(estimator.advance(too_old=too_old))
    for a, b in zip(*outputs, strict=True):
        if a.k in held_up:
            assert (b.valid, b.reason) == (False, "late")
            assert not np.isfinite(b.tip_position).any()
        else:
            assert b.valid
            np.testing.assert_array_equal(a.tip_position, b.tip_position)
            np.testing.assert_allclose(a.tip_covariance, b.tip_covariance, rtol=1e-2, atol=1e-9)
