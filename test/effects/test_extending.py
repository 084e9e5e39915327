"""docs/extending.md: its two examples, each as one file, are seen by simulation, estimator and diagnosis; switched off they change no bit."""

import copy
import importlib.util
import re
import sys
from pathlib import Path

import numpy as np
import pytest

from ctr_dynamics.diagnosis.forward_model import ForwardModel
from ctr_dynamics.diagnosis.recording import read_recording
from ctr_dynamics.effects import EFFECTS, EffectParameter, effect, effect_quantities, register
from ctr_dynamics.errors import InputError
from ctr_dynamics.estimation.estimator import Estimator
from ctr_dynamics.io import open_bag
from ctr_dynamics.parameters import Settings
from ctr_dynamics.robot_files import load_robot, robot_from_dict, robot_to_dict
from ctr_dynamics.runtime.replay import Player
from ctr_dynamics.simulation import Scenario, simulate
from ctr_dynamics.simulation.scenario_run import write_recording

PAGE = Path(__file__).parents[2] / "docs" / "extending.md"
PLAIN = load_robot("till2020_tissue")


def turning(amplitude, frequency_hz):
    """Rest, so that the model starts as the robot does, then a sine."""
    sine = {
        "kind": "sine",
        "duration_s": 2.6,
        "amplitude": amplitude,
        "frequency_hz": frequency_hz,
        "fade_s": 0.3,
    }
    return [{"kind": "hold", "duration_s": 0.4}, sine]


SCENARIO = Scenario.model_validate(
    {
        "duration_s": 3.2,
        "noise": False,
        "tubes": [{"rotation": turning(0.8, 1.0)}, {"rotation": turning(0.5, 0.7)}],
        "solver": {"dt_s": 0.003, "nodes": 12},
    }
)
SIZES = {"bent_field": ("bend_1_per_m", 1.5), "warming": ("rise_K", 8.0), "worn_belt": ("tube1.slip", 0.2)}


def load_example(file, folder):
    """The module of the example that the page calls ``file``, written to ``folder`` and imported from there."""
    blocks = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    (code,) = [block for block in blocks if block.startswith(f"# {file}\n")]
    path = folder / file
    path.write_text(code, encoding="utf-8")
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[path.stem] = module
    spec.loader.exec_module(module)
    return module


class WornBelt:
    """A belt that gives 1 + slip sin(alpha) of a turn."""

    def __init__(self, slip):
        self.slip = slip

    def __eq__(self, other):
        return isinstance(other, WornBelt) and np.array_equal(self.slip, other.slip)

    __hash__ = None

    def forward(self, drive):
        found = drive.copy()
        found[..., :2] -= self.slip * np.cos(drive[..., :2])
        return found

    def inverse(self, drive):
        found = drive.copy()
        for _ in range(50):
            found[..., :2] = drive[..., :2] + self.slip * np.cos(found[..., :2])
        return found

    def derivative(self, drive):
        slope = np.ones_like(drive)
        slope[..., :2] += self.slip * np.sin(drive[..., :2])
        return slope


@effect(
    "worn_belt",
    EffectParameter("tubeN.slip", "rad", 0.0, 0.02, text="amplitude of the error over a turn"),
    text="A belt runs unevenly.",
    source="first harmonic of a turn",
)
def worn_belt(plant, values):
    slip = np.array([values["tube1.slip"], values["tube2.slip"]])
    if slip.any():
        plant.correct_actuators(WornBelt(slip))


@pytest.fixture(params=SIZES)
def name(request, tmp_path):
    """Name of an effect that one file has declared and one call has registered."""
    if request.param == "worn_belt":
        register(worn_belt)
    else:
        register(getattr(load_example(f"{request.param}.py", tmp_path), request.param))
    yield request.param
    del EFFECTS[request.param]
    sys.modules.pop(request.param, None)


def robot_with_effect(name, value):
    """The tissue robot whose file names the effect."""
    data = copy.deepcopy(robot_to_dict(PLAIN))
    data["extensions"] = {name: {SIZES[name][0]: value}}
    return robot_from_dict(data)


def simulated(path, robot):
    """A bag of the scenario."""
    recording = simulate(SCENARIO, robot)
    assert not recording.failure
    write_recording(path, SCENARIO, robot, recording)
    return [(item.topic, item.log_ns, item.message) for item in open_bag(path).inputs()]


def replayed(path, robot):
    """Tips (steps, 3) of the open-loop model and rms of the tracker's distance from it, m."""
    estimator = Estimator(robot, Settings({"output.policy": "wait", "filter.enabled": False}))
    outputs = list(Player(estimator).play(open_bag(path)))
    tips = np.array([out.predicted_position for out in outputs])
    return tips, estimator.summary()["residual_rms_m"]["predicted"]


def test_an_effect_of_one_file_is_seen_everywhere_and_off_it_changes_no_bit(name, tmp_path):
    size = SIZES[name][1]
    own, off = robot_with_effect(name, size), robot_with_effect(name, 0.0)
    plain_bag, own_bag = tmp_path / "plain.mcap", tmp_path / "own.mcap"
    # simulation
    plain = simulated(plain_bag, PLAIN)
    assert simulated(tmp_path / "off.mcap", off) == plain
    assert simulated(own_bag, own) != plain
    # estimator: the robot file that made a bag explains it, the plain one does not
    tips, nominal = replayed(plain_bag, PLAIN)
    tips_off, same = replayed(plain_bag, off)
    assert np.array_equal(tips_off, tips)
    assert same == nominal
    explained, missed = replayed(own_bag, own)[1], replayed(own_bag, PLAIN)[1]
    print(f"{name}: rms {1e3 * explained:.4f} mm with the effect, {1e3 * missed:.4f} mm without")
    assert explained < 0.05 * missed
    # diagnosis: prediction, derivative and what the derivative says of the bag
    forward = ForwardModel(read_recording(own_bag, PLAIN), PLAIN)
    (quantity,) = [q for q in effect_quantities(PLAIN) if q.key == (name, SIZES[name][0])]
    zero = {quantity.key: quantity.off}
    assert np.array_equal(forward.predict(zero).position, forward.predict({}).position)
    prediction, columns = forward.jacobian({}, [quantity])
    residual = forward.residual(prediction)
    left = forward.residual(forward.predict({quantity.key: size}))
    assert np.abs(left[:, :3]).max() < 0.1 * np.abs(residual[:, :3]).max()
    h = 1e-3
    there = forward.residual(forward.predict({quantity.key: h * quantity.scale}))
    difference = (residual - there) / h
    assert np.linalg.norm(columns[:, :, 0] - difference) < 0.01 * np.linalg.norm(difference)


def test_a_robot_file_is_held_to_the_names_and_bounds_of_the_effect(name):
    parameter = SIZES[name][0]
    with pytest.raises(InputError, match=f"extension '{name}' has no parameter 'bend'"):
        robot_from_dict({**robot_to_dict(PLAIN), "extensions": {name: {"bend": 1.0}}})
    if name == "warming":
        with pytest.raises(InputError, match="must lie between -40 and 40"):
            robot_with_effect(name, 50.0)
    assert robot_with_effect(name, 0.5).extensions == {name: {parameter: 0.5}}


def test_two_effects_of_one_name_are_rejected():
    with pytest.raises(ValueError, match="'backlash' is registered twice"):
        register(effect("backlash", text="Another.", source="none")(lambda plant, values: None))
    assert EFFECTS["backlash"].source != "none"


def test_a_file_may_name_the_effect_only_once_it_is_registered():
    with pytest.raises(InputError, match="unknown extension 'bent_field'"):
        robot_from_dict({**robot_to_dict(PLAIN), "extensions": {"bent_field": {"bend_1_per_m": 1.0}}})
