"""The actuator model: inverse and derivative against forward, backlash against its definition, whole rows against one sample after another."""

from dataclasses import dataclass

import numpy as np
import pytest

from ctr_dynamics.robot_files import load_robot
from ctr_dynamics.sensing import ActuatorModel, ActuatorSignal

RNG = np.random.default_rng(2)


@dataclass(frozen=True)
class Eccentric:
    """Encoders whose scale runs around beside the axis: alpha is read too small by a sine of itself."""

    size: float

    def forward(self, drive):
        drive = drive.copy()
        drive[..., :2] += self.size * np.sin(drive[..., :2])
        return drive

    def inverse(self, drive):
        found = drive.copy()
        for _ in range(60):
            found[..., :2] = drive[..., :2] - self.size * np.sin(found[..., :2])
        return found

    def derivative(self, drive):
        slope = np.ones_like(drive)
        slope[..., :2] += self.size * np.cos(drive[..., :2])
        return slope


PLAIN = ActuatorModel(
    np.array([1.02, 0.97]), np.array([0.1, -0.2]), np.zeros(2), np.array([1e-3, -2e-3]), delay=0.02
)
MODELS = {"plain": PLAIN, "corrected": PLAIN.changed(corrections=(Eccentric(0.05), Eccentric(-0.02)))}
READINGS = np.hstack([RNG.normal(size=(30, 2)), RNG.uniform(-0.3, -0.1, (30, 2))])


@pytest.mark.parametrize("kind", MODELS)
def test_inverse_undoes_forward_for_one_sample_and_for_rows(kind):
    model = MODELS[kind]
    drive = model.forward(READINGS)
    np.testing.assert_allclose(model.inverse(drive), READINGS, atol=1e-13)
    np.testing.assert_array_equal(model.forward(READINGS[3]), drive[3])
    np.testing.assert_array_equal(model.inverse(drive[3]), model.inverse(drive)[3])


@pytest.mark.parametrize("kind", MODELS)
@pytest.mark.parametrize("name", ["gain", "offset", "beta_offset"])
def test_derivatives_by_parameters_are_those_of_forward(kind, name):
    model, h = MODELS[kind], 1e-6
    ends = [model.changed(**{name: getattr(model, name) + sign * h}).forward(READINGS) for sign in (1, -1)]
    np.testing.assert_allclose(model.derivative(name, READINGS), (ends[0] - ends[1]) / (2 * h), atol=1e-8)


def test_there_is_no_derivative_by_backlash():
    with pytest.raises(KeyError, match="backlash"):
        PLAIN.derivative("backlash", READINGS)


def test_backlash_keeps_the_tube_within_half_its_width_and_passes_no_motion_inside_the_dead_zone():
    model = PLAIN.changed(backlash=np.array([0.3, 0.0]))
    t = np.linspace(0.0, 10.0, 400)
    drive = np.stack([np.sin(t), np.cos(t), -0.2 + 0 * t, -0.1 + 0 * t], axis=1)
    found = model.behind_backlash(drive)
    assert np.abs(found[:, 0] - drive[:, 0]).max() == pytest.approx(0.15)
    inside = np.abs(found[1:, 0] - drive[1:, 0]) < 0.15 - 1e-12
    assert np.all(np.diff(found[:, 0])[inside] == 0.0)
    np.testing.assert_array_equal(found[:, 1:], drive[:, 1:])


def test_backlash_of_rows_is_that_of_one_sample_after_another():
    model = PLAIN.changed(backlash=np.array([0.3, 0.2]))
    drive = np.hstack([np.cumsum(RNG.normal(0, 0.2, (50, 2)), axis=0), RNG.uniform(-0.3, -0.1, (50, 2))])
    whole, signal = model.behind_backlash(drive), ActuatorSignal(model)
    for k, row in enumerate(drive):
        assert signal.add(k * 10_000_000, row) == "new"
    np.testing.assert_array_equal(np.array(signal.values), whole)


def test_positions_after_one_that_is_dropped_pass_the_backlash_again():
    actuators = ActuatorModel.of_robot(load_robot("till2020_tissue")).changed(backlash=np.array([0.2, 0.0]))
    with_glitch, without = ActuatorSignal(actuators), ActuatorSignal(actuators)
    for stamp, angle in enumerate([0.0, 0.1, 0.5, 0.2, 0.15]):
        value = np.array([angle, angle, -0.2, -0.1])
        with_glitch.add(stamp, value)
        if stamp != 2:
            without.add(stamp, value)
    with_glitch.drop(2)
    with_glitch.drop(7)
    assert with_glitch.stamps == without.stamps
    np.testing.assert_array_equal(with_glitch.values, without.values)
    np.testing.assert_array_equal(with_glitch.drive_positions, without.drive_positions)
