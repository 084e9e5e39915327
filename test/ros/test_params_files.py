"""Parameter files as rcl reads them: the shipped one starts every kind of estimator, and an empty list is a list without entries."""

from importlib.resources import files

import pytest
import rclpy

from ctr_dynamics.errors import InputError
from ctr_dynamics.io.messages import topics
from ctr_dynamics.parameters import Settings
from ctr_dynamics.ros.node_processes import MANAGED_ESTIMATOR
from ctr_dynamics.ros.parameter_declaration import TableNode, declare

SHIPPED = files("ctr_dynamics") / "config" / "estimator.yaml"
pytestmark = pytest.mark.ros


@pytest.fixture
def declared():
    """Declares the estimator's parameters on a node that is started with a file; returns the settings and what the node then has."""
    contexts = []

    def start(file):
        context = rclpy.Context()
        contexts.append(context)
        rclpy.init(args=["--ros-args", "--params-file", str(file)], context=context)

        node = TableNode("estimator", "/ctr", context)
        settings = declare(node)
        names = {name: node.get_parameter(name).value for name in settings}
        node.destroy_node()
        return settings, names

    yield start
    for context in contexts:
        context.try_shutdown()


def params_file(folder, text):
    file = folder / "params.yaml"
    file.write_text(f"/ctr/estimator:\n  ros__parameters:\n    {text}\n")
    return file


def test_the_shipped_file_holds_the_defaults(declared):
    settings, had = declared(SHIPPED)
    assert settings == Settings()
    assert had["joints.rotation_names"] == had["joints.translation_names"] == [""]


@pytest.mark.parametrize("names", ["[]", "['']", "['a', 'b']"])
def test_a_list_of_names_may_be_empty(declared, tmp_path, names):
    settings, had = declared(params_file(tmp_path, f"joints.rotation_names: {names}"))
    wanted = ("a", "b") if "a" in names else ()
    assert settings["joints.rotation_names"] == wanted
    assert had["joints.rotation_names"] == list(wanted or ("",))


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        ("tracker.lever_arm_m: []", r"tracker\.lever_arm_m: has 0 numbers, needs 3"),
        ("joints.rotation_scale: []", r"joints\.rotation_scale: has 0 numbers, needs at least one"),
        ("joints.rotation_name: []", r"joints\.rotation_name is unknown.*joints\.rotation_names"),
    ],
)
def test_an_empty_list_that_cannot_be_is_rejected(declared, tmp_path, text, wanted):
    with pytest.raises(InputError, match=wanted):
        declared(params_file(tmp_path, text))


def test_the_estimator_starts_with_the_shipped_file(start):
    with start(ros_arguments=["--params-file", str(SHIPPED)]) as live:
        live.resting_robot()
        live.wait_for_more(topics.TIP_POSE, 20)


def test_the_managed_estimator_starts_with_the_shipped_file(start):
    with start(ros_arguments=["--params-file", str(SHIPPED)], module=MANAGED_ESTIMATOR) as live:
        [names] = live.get_parameters(["joints.rotation_names"])
        assert list(names.string_array_value) == [""]
        assert live.set_parameter("joints.unwrap", False).successful
