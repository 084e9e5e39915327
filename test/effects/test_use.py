"""Robot files with extensions where they are used: a bag simulated with one is explained by the robot file that names it."""

import copy

import numpy as np
import pytest

from ctr_dynamics.estimation.estimator import Estimator
from ctr_dynamics.io import open_bag
from ctr_dynamics.io.messages.cdr import JointStateIn
from ctr_dynamics.parameters import Settings
from ctr_dynamics.robot_files import load_robot, robot_from_dict, robot_to_dict
from ctr_dynamics.runtime.replay import Player
from ctr_dynamics.sensing import ActuatorModel, ActuatorSignal
from ctr_dynamics.simulation import Scenario, simulate
from ctr_dynamics.simulation.scenario_run import write_recording

PLAIN = load_robot("till2020_tissue")
SCENARIO = Scenario.model_validate(
    {
        "duration_s": 1.2,
        "noise": False,
        "tubes": [
            {
                "rotation": [
                    {"kind": "sine", "duration_s": 1.2, "amplitude": 0.5, "frequency_hz": 1.5, "fade_s": 0.3}
                ],
                "translation": [
                    {
                        "kind": "sine",
                        "duration_s": 1.2,
                        "amplitude": 0.004,
                        "frequency_hz": 1.0,
                        "fade_s": 0.3,
                    }
                ],
            },
            {
                "rotation": [
                    {"kind": "sine", "duration_s": 1.2, "amplitude": 0.4, "frequency_hz": 1.0, "fade_s": 0.3}
                ]
            },
        ],
        "loads": [{"force_N": [0.1, -0.3, 0.0], "end_s": 0.3}],
        "solver": {"dt_s": 0.003, "nodes": 20},
    }
)


def extended(extensions):
    """The tissue robot with extensions."""
    data = copy.deepcopy(robot_to_dict(PLAIN))
    data["extensions"] = extensions
    return robot_from_dict(data)


def residuals(folder, robot, *readers):
    """Tracker's rms against the model alone (m) of every robot in ``readers``, on a bag simulated with ``robot``."""
    path = folder / "run.mcap"
    recording = simulate(SCENARIO, robot)
    assert not recording.failure
    write_recording(path, SCENARIO, robot, recording)
    found = []
    for reader in readers:
        settings = Settings({"output.policy": "wait", "filter.enabled": False, "model.nodes": 20})
        estimator = Estimator(reader, settings)
        outputs = list(Player(estimator).play(open_bag(path)))
        assert all(out.valid for out in outputs)
        assert len(outputs) > 350
        found.append(estimator.summary()["residual_rms_m"]["predicted"])
    return found


@pytest.mark.parametrize(
    ("extensions", "limit_m"),
    [
        (
            {
                "encoder_offset": {"tube1.offset_rad": 0.05},
                "encoder_gain": {"tube2.gain": 1.08},
                "exposed_length": {"tube1.beta_offset_m": 0.002},
            },
            5e-5,
        ),
        ({"actuator_latency": {"delay_s": 0.03}}, 5e-5),
        ({"backlash": {"tube1.width_rad": 0.15, "tube2.width_rad": 0.1}}, 3e-4),
        (
            {
                "tracker_scale": {"scale": 1.03},
                "drift": {"x_m_per_s": 2e-3},
                "clock_skew": {"rate": 0.02},
                "tracker_latency": {"delay_s": 0.01},
                "registration_rotation": {"rz_rad": 0.05},
                "tracker_lever_arm": {"x_m": 0.004},
            },
            5e-5,
        ),
        ({"tracker_averaging": {"window_s": 0.03}, "tip_force": {"Fx_N": 0.05}}, 6e-4),
        ({"payload_mass": {"added_kg": 1.5e-3}, "youngs_modulus": {"all.scale": 0.95}}, 5e-5),
    ],
    ids=["encoders", "latency", "backlash", "tracker", "averaging", "parameters"],
)
def test_a_bag_is_explained_by_the_robot_file_that_made_it(tmp_path, extensions, limit_m):
    robot = extended(extensions)
    own, plain = residuals(tmp_path, robot, robot, PLAIN)
    print(
        f"rms {1e3 * own:.4f} mm with the robot file that made the bag, {1e3 * plain:.4f} mm with the plain one"
    )
    assert own < limit_m
    assert own < 0.4 * plain


@pytest.mark.slow
def test_a_bag_with_other_physics_is_explained_by_the_robot_file_that_made_it(tmp_path):
    robot = extended(
        {
            "clearance": {"play_rad": 0.01},
            "insertion_velocity": {"scale": 1.0},
            "drivetrain_compliance": {"tube1.stiffness_Nm_per_rad": 0.5},
        }
    )
    own, plain = residuals(tmp_path, robot, robot, PLAIN)
    print(
        f"rms {1e3 * own:.4f} mm with the robot file that made the bag, {1e3 * plain:.4f} mm with the plain one"
    )
    assert own < 2e-4
    assert own < 0.1 * plain


def test_encoders_read_what_gain_and_offset_leave_of_the_angle(tmp_path):
    robot = extended({"encoder_offset": {"tube1.offset_rad": 0.05}, "encoder_gain": {"tube1.gain": 1.08}})
    path = tmp_path / "run.mcap"
    write_recording(path, SCENARIO, robot, simulate(SCENARIO.model_copy(update={"duration_s": 0.03}), robot))
    first = next(item.message for item in open_bag(path).inputs() if isinstance(item.message, JointStateIn))
    offset = PLAIN.encoders.offset.value
    assert first.positions[0] * 1.08 + offset + 0.05 == pytest.approx(PLAIN.rest.alpha.value[0], abs=1e-12)
    assert first.positions[1] + offset == pytest.approx(PLAIN.rest.alpha.value[1], abs=1e-12)


def test_drives_pass_backlash_and_delay_in_whatever_order_samples_come():
    rng = np.random.default_rng(3)
    actuators = ActuatorModel(np.ones(2), np.zeros(2), np.array([0.3, 0.0]), np.zeros(2), delay=0.02)
    values = np.concatenate(
        [np.cumsum(rng.normal(0, 0.1, (60, 2)), axis=0), rng.uniform(-0.3, -0.2, (60, 2))], axis=1
    )
    order = np.arange(60)
    order[[10, 11, 30, 31, 32]] = [11, 10, 32, 30, 31]
    drives = ActuatorSignal(actuators)
    for i in order:
        drives.add(int(i) * 10_000_000, values[i])
    assert drives.add(10_000_000, values[0]) == "duplicate"
    expected = actuators.behind_backlash(values)[:, :2]
    assert np.abs(np.array(drives.values)[:, :2] - expected).max() < 1e-15
    value, rate = drives.at(305_000_000)  # alpha of 285 ms, beta of 305 ms
    assert np.allclose(value[:2], 0.5 * (expected[28] + expected[29]))
    assert np.allclose(value[2:], 0.5 * (values[30, 2:] + values[31, 2:]))
    assert np.allclose(rate[:2], (expected[29] - expected[28]) / 0.01)
    drives.forget(300_000_000)
    assert drives.stamps[0] == 280_000_000
    late = np.array([*values[59, :2] + 1.0, -0.2, -0.2])
    drives.add(600_000_000, late)
    assert drives.values[-1][0] == pytest.approx(max(expected[59, 0], late[0] - 0.15))
