"""Restarts, and what may be left of what was before."""

import numpy as np
import pytest
from estimation_cases import START_NS, bag_messages, estimator, joints, play

from ctr_dynamics.estimation.runs import MAX_FAILURES
from ctr_dynamics.io.messages.topics import STEP_NS
from ctr_dynamics.model.model import Model
from ctr_dynamics.model.simulator import StepResult
from ctr_dynamics.model.statics import Statics
from ctr_dynamics.robot_files import load_robot

REST = np.array([1.5708, 1.5708, -0.2521, -0.1977])


@pytest.fixture
def running():
    """An estimator in the middle of a bag, under `predict`."""
    return play(bag_messages("clean_sweep", 1.0), {"output.policy": "predict"}).estimator


def test_late_inputs_do_not_lead_back_to_before_a_restart(running):
    k = running.k
    running.runs.stop()
    outputs = running.advance(START_NS + (k + 3) * STEP_NS)
    assert outputs[0].solver.outcome == "at rest"
    late = running.inputs.joints.stamps[-1] - 1_000_000
    running.add_joint_state(late, *joints(0.0, running.inputs.joints.values[-1]).content)
    outputs += running.advance(START_NS + (k + 6) * STEP_NS)
    assert [out.k for out in outputs] == list(range(k + 1, k + 7))
    assert all(out.valid for out in outputs)
    assert running.late.history.checkpoints[0].k == k + 1


def test_measurements_that_were_fused_before_a_restart_are_not_fused_again(running):
    k, queue = running.k, running.inputs.measurements
    before = queue.fused()
    assert before
    running.runs.start(k)
    assert queue.fused() == {stamp: at for stamp, at in before.items() if at < k}


def test_a_reinitialised_filter_begins_with_the_parameters_of_the_file(running):
    """Its factor belongs to the robot that it goes on with, not to the one that the estimate had come to."""
    ekf, state, t = running.runs.fused.ekf, running.runs.open_loop.state, running.k * STEP_NS * 1e-9
    factors = []
    for off_nominal in (False, True):
        ekf.forget_parameters()
        if off_nominal:
            ekf.theta[0] = ekf.uncertainty.highest[0]
            ekf.simulator.parameters += ekf.uncertainty.effect[:, 0] * ekf.theta[0]
        ekf.start(state.copy(), t)
        factors.append(ekf.factor.fields.copy())
    np.testing.assert_array_equal(*factors)


def test_measurements_of_the_same_stamps_are_fused_again_after_a_reset_and_counted_once():
    messages = bag_messages("clean_sweep", 0.5)
    made = estimator({"output.policy": "predict"})
    counted, fused = [], []
    for _ in range(2):
        for message in sorted(messages, key=lambda m: m.arrival):
            message.give(made)
            made.advance(START_NS + message.arrival)
        made.finish()
        counted.append(made.health.measurements.nis_count)
        fused.append(made.runs.fused.ekf.theta.copy())
        made.reset()
    assert counted[0] > 10
    assert counted[1] == counted[0]
    assert fused[0].any()
    np.testing.assert_array_equal(*fused)


def test_after_a_gap_actuators_go_on_from_where_the_steps_had_them():
    """Steps run on for 0.1 s by the last rate and then hold; joints that return do not find the tubes elsewhere after a gap that is too long to be
    taken again."""
    rate = np.array([1.0, -0.5, 0.0, 0.0])

    def at(t):
        return joints(t, REST + rate * min(t, 0.5))

    moving = [at(0.01 * k) for k in range(41)]
    run = play([*moving, *(at(0.01 * k) for k in range(380, 400))], {"output.policy": "predict"}, tick=0.003)
    drives = run.estimator.inputs.joints
    first = next(i for i, stamp in enumerate(drives.stamps) if stamp > START_NS + 3_700_000_000)
    np.testing.assert_allclose(drives.values[first], REST + rate * 0.5, atol=1e-9)


@pytest.mark.parametrize(("failing", "given_up"), [(3, False), (MAX_FAILURES, True)])
def test_a_way_back_bears_as_many_failed_steps_as_the_way_on(running, monkeypatch, failing, given_up):
    runs, k = running.runs, running.k
    taken = runs.step
    failed = []

    def step(number, *arguments, **options):
        if len(failed) < failing:
            failed.append(number)
            return StepResult(False, "made to fail", 0, 0, 0)
        return taken(number, *arguments, **options)

    monkeypatch.setattr(runs, "step", step)
    stamps = running.inputs.joints.stamps
    between = (stamps[-4] + stamps[-5]) // 2  # a joint state that came late
    running.add_joint_state(between, *joints(0.0, running.inputs.joints.values[-4]).content)
    running.late.correct()
    assert running.k == k
    assert failed[0] < k
    assert runs.running != given_up
    assert running.health.restarts == int(given_up)
    assert running.health.reasons["made to fail"] == len(failed)


def test_an_equilibrium_keeps_sections_that_fit():
    model = Model(load_robot("till2020_tissue"), nodes=12)
    beta = REST[2:].copy()
    key, _ = model.mesh(beta)
    for _ in range(40):
        beta[0] -= 1e-4
        if model.mesh(beta)[0] != model.mesh(beta, key)[0]:
            break
    else:
        pytest.fail("the sections never differ")
    fresh, known = (Statics(model).solve(beta, REST[:2], key=known_key) for known_key in (None, key))
    assert (fresh.key, known.key) == (model.mesh(beta)[0], key)
    assert np.linalg.norm(fresh.nodes[-1, :3] - known.nodes[-1, :3]) < 1e-6


def test_until_a_measurement_counts_the_covariance_reaches_to_the_last_one(running):
    """What was known of the difference between tracker and open-loop run is lost with the estimate."""
    fused, k = running.runs.fused, running.k
    fused._apart = np.array([4e-3, 0.0, 0.0])  # of a robot file that is wrong
    fused.reinitialise(running.runs.open_loop, k)
    rest = [m for m in bag_messages("clean_sweep", 1.2) if m.stamp >= 1.0e9]
    deviations, fused_since = [], False
    for message in rest:
        message.give(running)
        for out in running.advance(START_NS + message.arrival):
            fused_since = fused_since or any(i.accepted for i in out.innovations)
            deviations.append((fused_since, out.tip_covariance[0, 0] ** 0.5))
    assert min(deviation for since, deviation in deviations if not since) > 4e-3
    assert max(deviation for since, deviation in deviations if since) < 1e-3


@pytest.mark.parametrize(("open_loop_m", "withdrawn"), [(1e-3, True), (20e-3, False)])
def test_an_estimate_that_knows_less_than_the_open_loop_run_shows_is_not_published(
    running, monkeypatch, open_loop_m, withdrawn
):
    fused = running.runs.fused
    fused.ekf.pi *= 400.0
    monkeypatch.setattr(fused.disagreement, "of_open_loop", lambda stamp_ns: open_loop_m)
    (out,) = running.advance(START_NS + (running.k + 1) * STEP_NS)
    assert out.valid
    assert (out.tip_position.tolist() == out.predicted_position.tolist()) == withdrawn
    assert out.tip_covariance[:3, :3].trace() ** 0.5 > 2e-3
