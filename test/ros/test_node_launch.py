"""Launch files against small stand-ins of `launch` and `launch_ros`, which are not on PyPI."""

import importlib.util
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest

from ctr_dynamics.parameters import PARAMETERS
from ctr_dynamics.runtime.node_parameters import DRIVER, VIEW

ROOT = Path(__file__).parents[2]
KNOWN = {
    "estimator": {p.name for p in PARAMETERS} | {"use_sim_time"},
    "driver": {p.name for p in DRIVER} | {"use_sim_time"},
    "tube_markers": {p.name for p in VIEW} | {"use_sim_time"},
}
MODULES = {
    "launch": ["LaunchDescription"],
    "launch.actions": ["DeclareLaunchArgument", "EmitEvent", "RegisterEventHandler"],
    "launch.conditions": ["IfCondition"],
    "launch.event_handlers": ["OnProcessExit"],
    "launch.events": ["Shutdown"],
    "launch.substitutions": ["LaunchConfiguration"],
    "launch_ros": [],
    "launch_ros.actions": ["Node"],
    "launch_ros.substitutions": ["FindPackageShare"],
}


def stand_in(name):
    """A class that keeps what it was made with."""

    def __init__(self, *arguments, **options):
        self.arguments, self.options = arguments, options

    return type(name, (), {"__init__": __init__})


@pytest.fixture
def launch_file(monkeypatch):
    for module, names in MODULES.items():
        stub = ModuleType(module)
        for name in names:
            setattr(stub, name, stand_in(name))
        monkeypatch.setitem(sys.modules, module, stub)

    def load(name):
        path = ROOT / "launch" / f"{name}.launch.py"
        spec = importlib.util.spec_from_file_location(name, path)
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        [entities] = module.generate_launch_description().arguments
        by_kind = {}
        for entity in entities:
            by_kind.setdefault(type(entity).__name__, []).append(entity)
        return SimpleNamespace(
            nodes={node.options["executable"]: node.options for node in by_kind["Node"]},
            arguments={a.arguments[0]: a.options for a in by_kind["DeclareLaunchArgument"]},
            handlers=by_kind.get("RegisterEventHandler", []),
        )

    return load


@pytest.mark.parametrize(
    ("name", "executables"),
    [
        ("live", {"estimator", "tube_markers"}),
        ("replay", {"estimator", "tube_markers", "driver"}),
        ("demo", {"estimator", "tube_markers", "driver"}),
    ],
)
def test_launch_files_start_known_executables_with_known_parameters(launch_file, name, executables):
    launched = launch_file(name)
    assert set(launched.nodes) == executables
    scripts = (ROOT / "setup.py").read_text()
    used = set()
    for executable, node in launched.nodes.items():
        assert f'"{executable} = ' in scripts
        assert (node["package"], node["namespace"]) == ("ctr_dynamics", "ctr")
        assert node["name"] == {"tube_markers": "view"}.get(executable, executable)
        for group in node["parameters"]:
            if isinstance(group, dict):
                assert set(group) <= KNOWN[executable]
                used |= {v.arguments[0] for v in group.values() if type(v).__name__ == "LaunchConfiguration"}
            else:
                used.add(group.arguments[0])
    view = launched.nodes["tube_markers"]["condition"].arguments[0].arguments[0]
    assert used | {view} == set(launched.arguments)
    assert launched.arguments[view]["default_value"] == "false"
    assert all(options["description"] for options in launched.arguments.values())


def test_replay_goes_by_the_bags_clock_and_ends_with_it(launch_file):
    launched = launch_file("replay")
    _, parameters = launched.nodes["estimator"]["parameters"]
    assert parameters["use_sim_time"] is True
    assert launched.arguments["policy"]["default_value"] == "wait"
    [driver] = launched.nodes["driver"]["parameters"]
    assert driver["clock_hz"] > 0
    assert len(launched.handlers) == 1


@pytest.mark.parametrize("name", ["live", "replay", "demo"])
def test_all_take_the_shipped_parameter_file(launch_file, name):
    share = launch_file(name).arguments["params"]["default_value"]
    assert share[0].arguments == ("ctr_dynamics",)
    assert (ROOT / "ctr_dynamics" / share[1].lstrip("/")).is_file()
