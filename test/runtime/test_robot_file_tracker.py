"""What a robot file says of the tracker is seen by those that write bags and by those that read them."""

import numpy as np
import pytest

from ctr_dynamics import load_robot, load_scenario, replay
from ctr_dynamics.diagnosis.diagnosis_options import RecordingOptions
from ctr_dynamics.diagnosis.recording import read_recording
from ctr_dynamics.robot_files import robot_from_dict, robot_to_dict
from ctr_dynamics.simulation import simulate, write_recording

MOUNT = (0.3, 1.2, -0.4)


@pytest.fixture(scope="module")
def robots():
    """The tissue robot, and one whose sensor is turned in its tip and measures no roll."""
    plain = load_robot("till2020_tissue")
    data = robot_to_dict(plain.with_mount(MOUNT))
    data["tracker"]["axes"] = "xyzrp"
    return plain, robot_from_dict(data)


@pytest.fixture(scope="module")
def bags(robots, tmp_path_factory):
    """A second of the sweep, simulated with both."""
    folder = tmp_path_factory.mktemp("mount")
    scenario = load_scenario("sweep").model_copy(update={"duration_s": 1.0})
    paths = []
    for i, robot in enumerate(robots):
        paths.append(folder / f"{i}.mcap")
        write_recording(paths[-1], scenario, robot, simulate(scenario, robot))
    return paths


def test_the_mount_is_in_the_bag_and_taken_off_again(robots, bags):
    (plain, turned), (first, second) = robots, bags
    options = RecordingOptions(shortest_s=0.5)
    wanted = read_recording(first, plain, options)
    found = read_recording(second, turned, options)
    np.testing.assert_allclose(found.quaternion, wanted.quaternion, atol=1e-12)
    assert np.abs(read_recording(second, plain, options).quaternion - wanted.quaternion).max() > 0.1
    assert found.axes == (True, True, True, True, True, False)


def test_replay_goes_by_the_robot_file(robots, bags):
    plain, turned = robots
    good = replay(bags[1], turned).summary
    wrong = replay(bags[1], plain).summary
    assert good["parameters"]["tracker.axes"] == "xyzrp"
    assert good["nis"]["mean"] < 1.5
    assert wrong["nis"]["mean"] > 10.0 * good["nis"]["mean"]
