"""Over DDS: diagnosis reads the bag that a running node leaves behind when the model misfits."""

import pytest

from ctr_dynamics.diagnosis.recording import read_recording
from ctr_dynamics.io.messages import topics
from ctr_dynamics.robot_files import load_robot


@pytest.mark.ros
def test_a_misfit_leaves_a_bag_that_diagnosis_reads(start, tmp_path):
    path = tmp_path / "rolling.mcap"
    with start({"record.rolling_s": 20.0, "record.rolling_path": str(path)}) as live:
        robot = live.resting_robot()
        live.wait_for_more(topics.INNOVATION, 150)
        answer = live.trigger("save_snapshot")
        assert answer.success, answer.message
        live.wait(path.exists, "the recording of the snapshot")
        asked = read_recording(path, load_robot("till2020_tissue"))
        assert live.status("misfit").level == bytes([0]), live.status("misfit")
        agreeing = robot.agreeing_pose

        def shifted():
            pose = agreeing()
            x, y, z = pose.position
            return pose._replace(position=(x + 0.02, y, z))

        robot.agreeing_pose = shifted
        status = live.wait_for_status("misfit", 1, "2 times written")
        assert (
            f"run: ctr-dynamics diagnose {path} --robot till2020_tissue --output findings" in status.message
        )
        recording = read_recording(path, load_robot("till2020_tissue"))
        assert recording.duration > asked.duration
        assert recording.joints.shape[1] == 5
        assert set(recording.sha256) == {"rolling.mcap"}
    assert "exit under an alarm" in live.process.output()
