"""A robot that differs from its model as no parameter does: the filter carries the difference that the robot file states."""

import numpy as np
import pytest
from estimation_cases import START_NS, Message, check_outputs, play, rms, truth_error

from ctr_dynamics.kernels.rotations import conjugate, from_vector, matrix, multiply
from ctr_dynamics.robot_files import load_robot, robot_from_dict, robot_to_dict

SHIFT_M, TURN_RAD, TIME_S = 2e-3, 0.05, 0.5


def departure(t):
    """Shift (3,) m and rotation vector (3,) rad of the tip at the time ``t`` (s) from where the model has it."""
    phase = t / TIME_S + np.array([0.3, 1.7, 3.1])
    return SHIFT_M * np.sqrt(2.0) * np.sin(phase), TURN_RAD * np.sqrt(2.0) * np.cos(phase)


@pytest.fixture(scope="module")
def robot():
    data = robot_to_dict(load_robot("till2020_tissue"))
    data["model_error"] = {
        "position": {"value": SHIFT_M, "unit": "m"},
        "rotation": {"value": TURN_RAD, "unit": "rad"},
        "time": {"value": TIME_S, "unit": "s"},
    }
    return robot_from_dict(data)


def shifted_poses(messages, tracker):
    """Messages of a robot that is shifted and turned at the tip by :func:`departure`, as its ``tracker`` sees it."""
    registration = from_vector(np.array(tracker.registration_rotation.value))
    lever, origin = np.array(tracker.lever_arm.value), np.array(tracker.registration_translation.value)
    found = []
    for m in messages:
        if m.kind == "pose":
            position, (x, y, z, w), frame = m.content
            turned = np.array([w, x, y, z])
            shift, turn = departure(m.stamp * 1e-9 - tracker.delay.value)
            tip = matrix(registration).T @ (np.array(position) - origin - matrix(turned) @ lever)
            base = multiply(from_vector(turn), multiply(conjugate(registration), turned))
            p = matrix(registration) @ (tip + shift + matrix(base) @ lever) + origin
            q = multiply(registration, base)
            m = Message(m.kind, m.stamp, m.arrival, (tuple(p), (q[1], q[2], q[3], q[0]), frame))
        found.append(m)
    return found


@pytest.fixture(scope="module")
def departed(sweep):
    """The sweep as a robot makes it that departs from its model."""
    return shifted_poses(sweep, load_robot("till2020_tissue").tracker)


def error(run):
    """Fused tip minus that of the departed robot (steps, 3) m, and the steps."""
    left, steps = truth_error(run, "clean_sweep", "p_trk")
    return left - np.array([departure(t)[0] for t in run.t[steps]]), steps


def test_the_stated_error_is_followed(departed, robot):
    run = play(departed, robot=robot)
    check_outputs(run)
    left, steps = error(run)
    covariance = run.column("tip_covariance")[steps, :3, :3]
    nees = np.einsum("ki,ki->k", left, np.linalg.solve(covariance, left[..., None])[..., 0]) / 3.0
    assert rms(left) < 0.15 * SHIFT_M * np.sqrt(3.0)
    assert 0.2 < nees.mean() < 2.5
    assert all(run.outputs[k].valid for k in steps)
    assert all(i.accepted for out in run.outputs for i in out.innovations)


def test_it_is_in_the_covariance_where_nothing_is_measured(sweep, robot):
    run = play([m for m in sweep if m.kind != "pose"], robot=robot)
    plain = play([m for m in sweep if m.kind != "pose"])
    more = run.last.tip_covariance[:6, :6] - plain.last.tip_covariance[:6, :6]
    assert np.sqrt(np.diag(more)[3:]) == pytest.approx(TURN_RAD, rel=0.05)
    # the rotation of the tip moves it by the sensor's lever arm as well
    assert np.sqrt(np.diag(more)[:3]).min() > 0.98 * SHIFT_M
    assert run.last.stamp_ns > START_NS
