"""The package as others get it: versions agree, sdist and wheel are complete, colcon builds and tests it."""

import os
import re
import shutil
import subprocess
import sys
import tarfile
import xml.etree.ElementTree as ET
import zipfile
from importlib.util import find_spec
from pathlib import Path

import pytest
import yaml

import ctr_dynamics

ROOT = Path(__file__).resolve().parent.parent
ROBOTS = ("three_tube", "till2020_snap", "till2020_snap_example", "till2020_tissue")
EXECUTABLES = ("ctr-dynamics", "driver", "estimator", "managed_estimator", "tube_markers")


def run(*command, cwd, **extra):
    """Run to the end with the whole environment; the output of a failure is shown."""
    done = subprocess.run(
        [str(part) for part in command], cwd=cwd, env={**os.environ, **extra}, text=True, capture_output=True
    )
    assert done.returncode == 0, f"{command}\n{done.stdout}\n{done.stderr}"
    return done.stdout


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    """A copy of the source tree without what git ignores, so that building leaves no trace."""
    target = tmp_path_factory.mktemp("workspace") / "src" / "ctr_dynamics"
    leave = shutil.ignore_patterns(
        ".git",
        ".venv*",
        "__pycache__",
        "*.egg-info",
        ".*_cache",
        ".hypothesis",
        "build",
        "dist",
        "install",
        "log",
    )
    shutil.copytree(ROOT, target, symlinks=True, ignore=leave)
    return target


def test_versions_agree():
    version = ctr_dynamics.__version__
    assert re.fullmatch(r"\d+\.\d+\.\d+", version)
    assert ET.parse(ROOT / "package.xml").getroot().findtext("version") == version
    assert yaml.safe_load((ROOT / "CITATION.cff").read_text())["version"] == version
    assert run(sys.executable, "setup.py", "--version", cwd=ROOT).splitlines()[-1] == version
    assert f"## {version}" in (ROOT / "CHANGELOG.md").read_text()


def test_config_is_the_packages_own_files():
    assert (ROOT / "config").resolve() == ROOT / "ctr_dynamics" / "config"
    assert sorted(p.stem for p in (ROOT / "config" / "robots").glob("*.yaml")) == sorted(ROBOTS)


def test_ros_dependencies_of_the_code_are_declared():
    declared = {e.text for e in ET.parse(ROOT / "package.xml").getroot().iter("exec_depend")}
    used = set()
    for file in [*(ROOT / "ctr_dynamics").rglob("*.py"), *(ROOT / "launch").rglob("*.py")]:
        used |= set(
            re.findall(r"^\s*(?:from|import) (\w+_msgs|rclpy|std_srvs|launch\w*)\b", file.read_text(), re.M)
        )
    assert used - {"builtin_interfaces"} <= declared | {"rcl_interfaces"}


def test_ros_stays_in_the_nodes():
    for file in (ROOT / "ctr_dynamics").rglob("*.py"):
        if file.relative_to(ROOT / "ctr_dynamics").parts[0] != "ros":
            found = re.search(r"^(?:from|import) (rclpy|\w+_msgs)\b", file.read_text(), re.MULTILINE)
            assert found is None, f"{file.relative_to(ROOT)}: {found[0]}"


def pins(name):
    """Packages that a file of requirements pins."""
    found = set()
    for line in (ROOT / name).read_text().splitlines():
        if line and not line.startswith("#"):
            assert re.fullmatch(r"[a-z0-9-]+==[\w.]+( ; [^;]+)?", line), line
            found.add(line.split("==")[0])
    return found


def test_requirements_pin_every_package_for_every_python():
    pinned = pins("requirements.txt") | pins("requirements-ros-kilted.txt")
    setup = (ROOT / "setup.py").read_text()
    wanted = {name.lower() for name in re.findall(r'"([A-Za-z][\w-]*)[>=]=[\d.]+"', setup)}
    assert {"numpy", "numba", "rosbags", "ros-kilted-rclpy"} <= wanted
    assert wanted <= pinned


def test_every_distribution_has_the_same_messages():
    kilted, jazzy = pins("requirements-ros-kilted.txt"), pins("requirements-ros-jazzy.txt")
    wanted = {name.replace("kilted", "jazzy") for name in kilted if name.startswith("ros-kilted-")}
    assert "ros-jazzy-rclpy" in wanted
    assert wanted <= jazzy
    assert not any(name.startswith("ros-") for name in pins("requirements.txt"))


def test_sdist_and_wheel_are_complete_and_the_wheel_works(source, tmp_path):
    run(sys.executable, "-m", "build", "--no-isolation", "--outdir", tmp_path, source, cwd=tmp_path)
    [wheel] = tmp_path.glob("*.whl")
    [sdist] = tmp_path.glob("*.tar.gz")
    in_wheel = zipfile.ZipFile(wheel).namelist()
    with tarfile.open(sdist) as archive:
        in_sdist = [name.split("/", 1)[-1] for name in archive.getnames()]
    for name in ROBOTS:
        assert f"ctr_dynamics/config/robots/{name}.yaml" in in_wheel
        assert f"ctr_dynamics/config/robots/{name}.yaml" in in_sdist
        assert any(entry.endswith(f"share/ctr_dynamics/config/robots/{name}.yaml") for entry in in_wheel)
    assert "ctr_dynamics/config/estimator.yaml" in in_wheel
    modules = {file.relative_to(ROOT).as_posix() for file in (ROOT / "ctr_dynamics").rglob("*.py")}
    assert modules <= set(in_wheel)
    assert modules <= set(in_sdist)
    assert {"py.typed", "__init__.pyi"} <= {entry.removeprefix("ctr_dynamics/") for entry in in_wheel}
    assert not {entry.split("/")[0] for entry in in_wheel} & {"test", "tools", "studies", "examples"}
    assert {"studies/__init__.py", "tools/tables.py", "examples/01_static_shape.py"} <= set(in_sdist)
    assert {"LICENSE", "package.xml", "requirements.txt", "resource/ctr_dynamics"} <= set(in_sdist)

    target = tmp_path / "site"
    run(
        sys.executable,
        "-m",
        "pip",
        "install",
        "--no-deps",
        "--quiet",
        "--target",
        target,
        wheel,
        cwd=tmp_path,
    )
    code = "import ctr_dynamics.robot_files as r; print(r.__file__, *map(r.load_robot, r.robot_names()), sep='\\n')"
    shown = run(sys.executable, "-c", code, cwd=tmp_path, PYTHONPATH=str(target))
    assert shown.startswith(str(target))
    assert len(shown.splitlines()) == 1 + len(ROBOTS)


@pytest.mark.slow
@pytest.mark.skipif(find_spec("colcon_core") is None, reason="colcon is not installed")
def test_colcon_lists_builds_and_tests_the_package(source):
    workspace = source.parent.parent
    colcon = [sys.executable, "-c", "import sys; from colcon_core.command import main; sys.exit(main())"]
    # Without its notifications and desktop extensions; the log stays in the workspace.
    extra = {"COLCON_LOG_PATH": str(workspace / "log"), "COLCON_HOME": str(workspace / "home")}
    listed = run(*colcon, "list", "--base-paths", "src", cwd=workspace, **extra)
    assert listed.split() == ["ctr_dynamics", "src/ctr_dynamics", "(ros.ament_python)"]

    run(*colcon, "build", "--packages-select", "ctr_dynamics", cwd=workspace, **extra)
    prefix = workspace / "install" / "ctr_dynamics"
    assert (prefix / "share/ament_index/resource_index/packages/ctr_dynamics").is_file()
    assert (prefix / "share/ctr_dynamics/package.xml").is_file()
    for name in ROBOTS:
        assert (prefix / f"share/ctr_dynamics/config/robots/{name}.yaml").is_file()
    # What `ros2 run` lists: the executable files of lib/ctr_dynamics.
    programs = [p for p in (prefix / "lib/ctr_dynamics").iterdir() if os.access(p, os.X_OK)]
    assert sorted(p.name for p in programs) == sorted(EXECUTABLES)
    [site] = prefix.glob("lib/python*/site-packages")
    shown = run(prefix / "lib/ctr_dynamics/ctr-dynamics", "--version", cwd=workspace, PYTHONPATH=str(site))
    assert shown.strip() == f"ctr-dynamics {ctr_dynamics.__version__}"

    # One file of tests: the whole suite would run itself.
    tests = ["--pytest-args", "test/test_robot.py", "-p", "no:cacheprovider"]
    run(*colcon, "test", "--packages-select", "ctr_dynamics", *tests, cwd=workspace, **extra)
    result = run(*colcon, "test-result", "--all", cwd=workspace, **extra)
    counts = re.search(r"Summary: (\d+) tests, 0 errors, 0 failures", result)
    assert counts is not None, result
    assert int(counts[1]) > 50


def test_commands_find_the_kernels_that_make_has_compiled(tmp_path):
    made = Path(sys.prefix) / "numba-cache"
    elsewhere = tmp_path / ".cache" / "ctr_dynamics"
    show = "from ctr_dynamics.kernels.compiler import cache_folder; print(cache_folder())"
    for given, expected in (
        ({}, made if os.access(made, os.W_OK) else elsewhere),
        ({"NUMBA_CACHE_DIR": str(tmp_path / "given")}, tmp_path / "given"),
    ):
        env = {k: v for k, v in os.environ.items() if k not in ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME")}
        env.update(given, HOME=str(tmp_path))
        where = subprocess.check_output([sys.executable, "-c", show], cwd=ROOT, env=env, text=True).strip()
        assert Path(where) == expected
