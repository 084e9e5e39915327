"""Predictions and derivatives of one second of a motion: interpolation, columns, smoothness."""

import math
from dataclasses import replace

import numpy as np

from ctr_dynamics.diagnosis import forward_model as forward_model_module
from ctr_dynamics.diagnosis.diagnosis_options import DiagnosisOptions
from ctr_dynamics.diagnosis.forward_model import ForwardModel, at_times, smooth
from ctr_dynamics.diagnosis.inference.fit_problem import make_problem
from ctr_dynamics.diagnosis.learned.learn import on_robot
from ctr_dynamics.diagnosis.recording import Recording
from ctr_dynamics.kernels.rotations import from_vector, multiply_rows
from ctr_dynamics.model.trajectory import Trajectory

OPTIONS = DiagnosisOptions()
AIR = ("air_drag", "linear_Ns_per_m2")
STIFFNESS = ("youngs_modulus", "tube1.scale")


def test_interpolation_is_exact_for_cubics_and_held_outside():
    t = np.arange(20) * 0.003
    values = np.stack([t**3 - t, 2 * t**2], axis=1)
    at = np.array([0.0, 0.0041, 0.02, 0.0559])
    np.testing.assert_allclose(at_times(values, t, at), np.stack([at**3 - at, 2 * at**2], axis=1), atol=1e-14)
    np.testing.assert_allclose(at_times(values, t, np.array([9.0])), values[-1:], atol=1e-14)


def test_joints_are_smooth_between_samples_straight_across_gaps_and_held_outside():
    t = np.concatenate([0.01 * np.arange(6), 0.2 + 0.01 * np.arange(4)])
    values = np.stack([3.0 * t**2 - t, np.cos(40.0 * t)], axis=1)
    at = smooth(t, values, OPTIONS.forward_model.joint_gap_s)
    np.testing.assert_allclose(at(t)[0], values, atol=1e-14)
    inner = np.linspace(0.0101, 0.0399, 50)
    np.testing.assert_allclose(at(inner)[0][:, 0], 3.0 * inner**2 - inner, atol=1e-14)  # parabolas exactly
    times, h = np.linspace(0.001, 0.0489, 400), 1e-7
    numbers = (at(times + h)[0] - at(times - h)[0]) / (2 * h)
    np.testing.assert_allclose(at(times)[1], numbers, atol=2e-3)
    assert (
        np.abs(np.diff(at(times)[1], axis=0)).max() < 2.0 * 40.0**2 * np.diff(times).max()
    )  # no jump at a sample
    gap = np.array([0.08, 0.11, 0.14])
    assert np.ptp(at(gap)[1], axis=0).max() < 1e-12
    value, rate = at(np.array([-1.0, 0.0, 1.0]))
    np.testing.assert_array_equal(value, values[[0, 0, -1]])
    assert not rate.any()


def test_columns_together_are_those_apart(recording, robot, known):
    """With a cause that needs the extended model, plain columns go through that one too."""
    forward_model = ForwardModel(recording, robot)

    def apart():
        """Largest difference of the stiffness' columns, of their size on each axis; and all columns."""
        alone = forward_model.jacobian({}, [known[STIFFNESS]])[1][:, :, 0]
        together = forward_model.jacobian({}, [known[STIFFNESS], known[AIR]])[1]
        return np.abs((together[:, :, 0] - alone) / np.abs(alone).max(axis=0)).max(), together

    difference, together = apart()
    assert difference < 1e-3  # what the sweeps of a step leave
    step = 0.01
    shifted = [
        forward_model.predict({AIR: known[AIR].off + side * step * known[AIR].scale}).position
        for side in (0, 1)
    ]
    slope = (shifted[1] - shifted[0]) / step
    assert np.abs(together[:, :3, 1] - slope).max() < 0.03 * np.abs(slope).max()


def test_a_part_before_the_first_measurement_has_no_columns(recording, robot, known):
    """Where parts of several recordings grow together, one may have measurements so early and another none."""
    early = replace(recording, stamps=recording.stamps + 0.5)
    of = [known[STIFFNESS], known[AIR]]
    prediction, columns = ForwardModel(early, robot).until(0.4).jacobian({}, of)
    assert not prediction.failure
    assert columns.shape == (0, 6, 2)


def test_a_recording_without_measurements_yet_adds_nothing(recording, robot, known):
    """Parts of recordings grow together, each by the same fraction of its length."""
    late = replace(recording, stamps=recording.stamps + 0.5)
    found = []
    for recordings in ([recording, late], [recording]):
        problem = make_problem(robot, recordings, (known[STIFFNESS],), np.ones(6, bool))
        part = problem.until([0.4] * len(recordings))
        assert part.size
        linear, residual = part.linearise({}, [known[STIFFNESS]]), part.residual({})
        assert linear is not None
        assert residual is not None
        found.append((*linear, residual))
    for both, alone in zip(*found, strict=True):
        np.testing.assert_array_equal(both, alone)


def test_limits_of_nuisances_are_the_same_on_parts_and_other_recordings(recording, robot, known):
    """A search with nuisances that may go as far as they like fits growing parts too, and a learned force has a robot of its own."""
    problem = make_problem(robot, [recording], (known[STIFFNESS],), np.ones(6, bool))
    free = replace(problem, reach=math.inf, tolerance_factor=3.0, workers=2)
    other = robot.model_copy(update={"name": "other"})
    for part in (
        free.until([0.4]),
        free.on([recording]),
        on_robot(free, other),
        on_robot(free, other, [recording]),
    ):
        assert (part.reach, part.tolerance_factor, part.workers) == (math.inf, 3.0, 2)
    assert on_robot(free, other).robot.name == "other"


def test_the_misfit_is_a_smooth_function_of_delays(robot, known):
    """Drives and load later by as much as the tracker is earlier is the same experiment, wherever in the steps their samples fall."""
    rng = np.random.default_rng(2)
    t = np.arange(101) / 100.0
    turn = 0.3 * (1.0 - np.cos(np.pi * np.clip(t / 0.3, 0.0, 1.0)))[:, None] + 5e-4 * rng.standard_normal(
        (101, 2)
    )
    joints = np.column_stack([t, robot.rest.alpha.value + turn, np.tile(robot.rest.beta.value, (len(t), 1))])
    load = np.zeros((4, 7))
    load[:, 0], load[:, 2] = (0.0, 0.5, 0.51, 1.0), (-0.3, -0.3, 0.0, 0.0)
    stamps = np.arange(2, 39) / 40.0
    nothing = np.zeros((len(stamps), 3))
    recording = Recording(
        "", "", {}, joints, load, stamps, nothing, np.tile([1.0, 0, 0, 0], (len(stamps), 1)), ()
    )
    forward_model = ForwardModel(recording, robot)

    def seen(drives, tracker):
        later = {("actuator_latency", "delay_s"): drives, ("load_time", "delay_s"): drives}
        return forward_model.predict({**later, ("tracker_latency", "delay_s"): tracker}).position

    base, moved = seen(0.0, 0.004), seen(0.0, 0.0)
    shifts = [seen(d, 0.004 - d) for d in (0.0003, 0.0007, 0.0013, 0.0019, 0.0026, 0.004)]
    assert max(np.abs(shift - base).max() for shift in shifts) < 0.02 * np.abs(moved - base).max()


def test_the_roll_of_a_sensor_with_five_degrees_of_freedom_is_no_misfit(recording, robot):
    """It is whatever the tracker makes of it, and turns with time here."""
    seen = ForwardModel(recording, robot).predict({})
    roll = np.outer(1.0 + recording.stamps, [0.0, 0.0, 1.0])
    rolled = multiply_rows(seen.quaternion, np.stack([from_vector(r) for r in roll]))
    blind = replace(recording, position=seen.position, quaternion=rolled, axes=(True,) * 5 + (False,))
    np.testing.assert_allclose(ForwardModel(blind, robot).residual(seen), 0.0, atol=1e-9)
    whole = ForwardModel(replace(blind, axes=(True,) * 6), robot).residual(seen)
    np.testing.assert_allclose(whole[:, 5], roll[:, 2], atol=1e-9)


def test_what_collocation_cannot_follow_is_stepped_stage_by_stage(recording, robot, monkeypatch):
    forward_model = ForwardModel(recording, robot)
    whole = forward_model.predict({}).trajectory
    monkeypatch.setattr(
        forward_model_module,
        "run_collocation",
        lambda *_, **__: Trajectory(whole.t[:1], whole.tip[:1], None, "stopped"),
    )
    found = forward_model.predict({})
    assert not found.failure
    np.testing.assert_allclose(found.trajectory.tip[:, :3], whole.tip[:, :3], atol=5e-5)
