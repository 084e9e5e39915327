"""Parameters: the table itself, checks of values, parameter files and the generated documents."""

import math
import warnings
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from ctr_dynamics.cli.recording_options import settings_from
from ctr_dynamics.errors import InputError
from ctr_dynamics.parameters import (
    PARAMETERS,
    Settings,
    axes_mask,
    parameter,
    parse_assignments,
    read_parameter_file,
)
from ctr_dynamics.parameters.settings import GivenTwice
from tools import tables

ROOT = Path(__file__).resolve().parent.parent


def test_every_default_passes_its_own_check():
    for p in PARAMETERS:
        assert p.check(p.default) == p.default
        assert p.text.endswith(".")
    names = [p.name for p in PARAMETERS]
    assert len(set(names)) == len(names)


@pytest.mark.parametrize("name", ["tracker.delay_s", "model.nodes", "model.scheme", "filter.rank"])
def test_names_that_callers_rely_on(name):
    assert parameter(name).name == name


def test_settings_are_defaults_then_file_then_overrides(tmp_path):
    file = tmp_path / "p.yaml"
    file.write_text("model: {nodes: 100}\nfilter.rank: 12\n")
    values = Settings(
        read_parameter_file(file) | {"filter.rank": "10", "tracker.lever_arm_m": "[0, 0, 2.5e-3]"}
    )
    assert values["model.nodes"] == 100
    assert values["filter.rank"] == 10
    assert values["tracker.lever_arm_m"] == (0.0, 0.0, 0.0025)
    assert values["model.scheme"] == parameter("model.scheme").default
    assert len(values) == len(PARAMETERS)


def test_a_value_is_set_where_it_was_given_be_it_the_default(tmp_path):
    settings = Settings({"tracker.axes": "xyzrpy"})
    assert settings.was_set("tracker.axes")
    assert not settings.was_set("tracker.delay_s")
    assert settings == Settings(), "the values are the same"
    later = settings.replace({"tracker.delay_s": 0.0})
    assert later.was_set("tracker.axes")
    assert later.was_set("tracker.delay_s")
    assert Settings(later).was_set("tracker.delay_s")
    assert not Settings(later).was_set("model.nodes")
    # a file may hold every default; it sets what differs, and undoes what a command sets by itself
    file = tmp_path / "all.yaml"
    file.write_text("tracker.axes: xyzrpy\nmodel.nodes: 20\noutput.policy: predict\n")
    found = settings_from(file, ["input_timeout_s=0.1"], {"output.policy": "wait"})
    assert [name for name in found if found.was_set(name)] == ["input_timeout_s", "model.nodes"]
    assert found["output.policy"] == "predict"


def test_settings_cannot_be_changed():
    values = Settings()
    with pytest.raises(TypeError):
        values["model.nodes"] = 5  # type: ignore[index]
    assert values.replace({"model.nodes": 50})["model.nodes"] == 50
    assert values["model.nodes"] == parameter("model.nodes").default


@pytest.mark.parametrize(
    "text",
    [
        "/ctr/estimator:\n  ros__parameters:\n    model: {nodes: 64}\n    use_sim_time: true\n",
        "ctr:\n  estimator:\n    ros__parameters:\n      model.nodes: 64\n",
        "/**:\n  ros__parameters:\n    model:\n      nodes: 64\n",
        "driver:\n  ros__parameters: {speed: 2.0}\nestimator:\n  ros__parameters:\n    model: {nodes: 64}\n",
    ],
)
def test_ros_parameter_files(tmp_path, text):
    file = tmp_path / "p.yaml"
    file.write_text(text)
    assert Settings(read_parameter_file(file))["model.nodes"] == 64


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("model: {nodes: 5}\n", "parameter model.nodes: 5 is outside its range; write 8 to 1000"),
        ("model: {nods: 5}\n", "unknown parameter 'model.nods'; did you mean 'model.nodes'"),
        ("/ctr/driver:\n  ros__parameters: {speed: 1.0}\n", "none of the estimator"),
        ("joints: {translation_scale: [0.0]}\n", "write a factor other than 0"),
        ("- 1\n", "holds no parameters"),
        ("a: [\n", "not valid YAML"),
        ("model: {nodes: 20, nodes: 30}\n", "key 'nodes' is given twice"),
    ],
)
def test_bad_parameter_files_are_one_line(tmp_path, text, part):
    file = tmp_path / "p.yaml"
    file.write_text(text)
    with pytest.raises(InputError) as caught:
        Settings(read_parameter_file(file))
    assert part in str(caught.value)
    assert str(file) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_missing_parameter_file(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        Settings(read_parameter_file(tmp_path / "none.yaml"))


@pytest.mark.parametrize(
    ("name", "value", "part"),
    [
        ("model.nodes", "many", "'many' is not a whole number"),
        ("model.nodes", 24.0, "24.0 is not a whole number"),
        ("model.nodes", True, "True is not a whole number"),
        ("model.alpha", math.nan, "nan is not finite"),
        ("joints.rotation_scale", [0.0], "joints.rotation_scale: 0 throughout"),
        ("joints.rotation_scale", "0,0", "joints.rotation_scale: 0 throughout"),
        ("joints.translation_scale", 0, "joints.translation_scale: 0 throughout"),
        ("model.scheme", "rk4", "'rk4' is not known; write backward_euler"),
        ("filter.enabled", "maybe", "'maybe' is not true or false"),
        ("filter.enabled", 1, "1 is not true or false"),
        ("tracker.lever_arm_m", [0.0, 1.0], "has 2 numbers, needs 3"),
        ("tracker.lever_arm_m", "0,0", "has 2 numbers, needs 3"),
        ("tracker.lever_arm_m", [0.0, 0.0, 2.5], "2.5 m is outside its range; write -1 to 1 m"),
        ("tracker.delay_s", 18.0, "18 s is outside its range"),
        ("tracker.axes", "zyx", "not a subset of 'xyzrpy'"),
        ("robot", 3, "3 is not text"),
        ("qos.subscription_reliability", "sometimes", "write best_effort or reliable"),
    ],
)
def test_bad_values(name, value, part):
    with pytest.raises(InputError) as caught:
        Settings({name: value})
    assert part in str(caught.value)
    assert name in str(caught.value)


def test_values_come_in_their_own_type():
    values = Settings(
        {
            "model.tolerance": "1e-8",
            "tracker.delay_s": 0,
            "model.nodes": np.int64(30),
            "filter.enabled": "False",
            "tracker.lever_arm_m": np.array([0, 0, 1e-3]),
        }
    )
    assert values["model.tolerance"] == 1e-8
    assert isinstance(values["tracker.delay_s"], float)
    assert type(values["model.nodes"]) is int
    assert values["filter.enabled"] is False
    assert values["tracker.lever_arm_m"] == (0.0, 0.0, 1e-3)


def test_assignments_of_a_command_line():
    given_values = parse_assignments(["tracker.delay_s=0.018", "record.path = a=b.mcap"])
    assert given_values == {"tracker.delay_s": "0.018", "record.path": "a=b.mcap"}
    for bad, part in [
        (["tracker.delay_s"], "is not NAME=VALUE"),
        (["delay=3"], "unknown parameter 'delay'"),
    ]:
        with pytest.raises(InputError, match=part):
            parse_assignments(bad)


def test_of_a_parameter_given_twice_the_last_value_counts_and_that_is_said():
    with pytest.warns(
        GivenTwice, match="'output.policy' is given as predict and as wait; the last one counts"
    ):
        found = parse_assignments(["output.policy=predict", "model.nodes=20", "output.policy=wait"])
    assert found == {"output.policy": "wait", "model.nodes": "20"}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert parse_assignments(["model.nodes=20", "model.nodes=20"]) == {"model.nodes": "20"}


@pytest.mark.parametrize(
    ("axes", "mask"),
    [
        ("xyz", "111000"),
        ("xyzrpy", "111111"),
        ("xyzrp", "111110"),
        ("rpy", "000111"),
        ("y", "010000"),
        ("zy", "001001"),
    ],
)
def test_axes_mask(axes, mask):
    assert axes_mask(axes) == tuple(c == "1" for c in mask)


@given(
    st.sampled_from(PARAMETERS), st.one_of(st.text(), st.floats(), st.integers(), st.none(), st.booleans())
)
def test_any_value_is_taken_or_rejected_in_one_line(p, value):
    try:
        checked = p.check(value)
    except InputError as error:
        assert "\n" not in str(error)
        return
    assert p.check(checked) == checked


# --- generated documents ------------------------------------------------------------------------------------


def test_generated_tables_and_estimator_yaml_are_up_to_date():
    late = [str(path.relative_to(ROOT)) for path in tables.outdated(ROOT)]
    assert not late, f"run python -m tools.tables --write: {late}"


def test_estimator_yaml_holds_every_default_in_its_ros_type():
    text = tables.estimator_yaml()
    block = yaml.safe_load(text)["/ctr/estimator"]["ros__parameters"]
    for p in PARAMETERS:
        node = block
        for key in p.name.split("."):
            node = node[key]
        kinds = {"floats": list, "texts": list, "str": str, "int": int, "float": float, "bool": bool}
        assert type(node) is kinds[p.type], p.name
        assert p.check(node) == p.default


def test_estimator_yaml_is_read_back(tmp_path):
    file = tmp_path / "estimator.yaml"
    file.write_text(tables.estimator_yaml())
    assert Settings(read_parameter_file(file)) == Settings()


def test_a_least_deviation_above_the_largest_is_rejected():
    with pytest.raises(
        InputError, match=r"tip_force_sigma_N is 0\.3 N, limit filter\.tip_force_sigma_max_N, 0\.2 N"
    ):
        Settings({"filter.tip_force_sigma_N": 0.3, "filter.tip_force_sigma_max_N": 0.2})
    Settings({"filter.tip_force_sigma_N": 0.3})
    Settings({"filter.tip_force_sigma_N": 0.3, "filter.tip_force_sigma_max_N": 0.3})


def test_outdated_tables_are_found_and_brought_up_to_date(tmp_path, capsys):
    (tmp_path / "docs").mkdir()
    for page in tables.SECTIONS:
        (tmp_path / page).write_text((ROOT / page).read_text().replace("`model.nodes`", "`model.knots`"))
    assert tables.main(["--root", str(tmp_path)]) == 1
    assert "parameters.md is out of date" in capsys.readouterr().err
    assert tables.main(["--root", str(tmp_path), "--write"]) == 0
    assert tables.main(["--root", str(tmp_path)]) == 0
    for page in tables.SECTIONS:
        assert (tmp_path / page).read_text() == (ROOT / page).read_text()
    with pytest.raises(InputError, match="marker"):
        tables.render(Path("docs/topics.md"), "# no markers")
