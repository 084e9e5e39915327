"""Mistakes of the configuration, and what a tracker that sends no rotation may say of them."""

from dataclasses import replace

import numpy as np
import pytest

from ctr_dynamics.diagnosis.configuration_mistakes import find_mistake
from ctr_dynamics.diagnosis.diagnosis_options import DiagnosisOptions
from ctr_dynamics.diagnosis.inference.residual_tests import rms
from ctr_dynamics.diagnosis.pipeline import diagnose_recordings
from ctr_dynamics.diagnosis.recording import measured_axes
from ctr_dynamics.diagnosis.run_context import RunContext


@pytest.fixture
def mirrored(recording):
    """The recording as a tracker of three degrees of freedom sends it, with joints of the wrong sign."""
    joints = recording.joints * np.array([1.0, -1.0, -1.0, 1.0, 1.0])
    still = np.tile([1.0, 0.0, 0.0, 0.0], (len(recording.stamps), 1))
    return replace(recording, joints=joints, quaternion=still)


def test_rotations_that_are_not_measured_hide_no_mistake(mirrored, robot):
    mask = measured_axes([mirrored], [])
    assert not mask[3:].any()
    found = find_mistake(mirrored, robot, mask, DiagnosisOptions(), RunContext(workers=1))
    assert found is not None
    assert found.name == "sign_of_alpha"
    assert found.misfit_undone < 0.1 * found.misfit


def test_a_mistake_states_the_nominal_rms_of_positions(mirrored, robot):
    found = diagnose_recordings(robot, [mirrored], context=RunContext(workers=1))
    assert found.mistake is not None
    plain = diagnose_recordings(
        robot,
        [mirrored],
        context=RunContext(workers=1, time_budget_s=0.0),
        options=replace(
            DiagnosisOptions(), configuration=replace(DiagnosisOptions().configuration, gross=1e9)
        ),
    )
    assert plain.mistake is None
    assert found.nominal_rms == pytest.approx(plain.nominal_rms, rel=1e-3)
    assert found.nominal_rms == pytest.approx(rms(plain.residual_nominal[0][:, :3]), rel=1e-3)
