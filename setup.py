"""Build of the ament_python package; also a plain `pip install .`."""

import re
from pathlib import Path

from setuptools import find_packages, setup

PACKAGE = "ctr_dynamics"
HERE = Path(__file__).resolve().parent


def version() -> str:
    text = (HERE / PACKAGE / "__init__.py").read_text(encoding="utf-8")
    match = re.search(r'^__version__ = "([^"]+)"', text, re.MULTILINE)
    if match is None:
        raise RuntimeError(f"{PACKAGE}/__init__.py holds no __version__")
    return match.group(1)


def shared_files(source: str, target: str) -> list[tuple[str, list[str]]]:
    """Files below `source`, by folder, for share/ctr_dynamics/`target` (paths relative, as colcon wants)."""
    folders: dict[str, list[str]] = {}
    for path in sorted((HERE / source).rglob("*")):
        if path.is_file() and "__pycache__" not in path.parts and path.suffix != ".pyc":
            folder = Path("share") / PACKAGE / target / path.parent.relative_to(HERE / source)
            folders.setdefault(folder.as_posix(), []).append(path.relative_to(HERE).as_posix())
    return list(folders.items())


ROS_MESSAGES = ["std", "geometry", "sensor", "nav", "diagnostic", "visualization"]

setup(
    name=PACKAGE,
    version=version(),
    packages=find_packages(include=[PACKAGE, f"{PACKAGE}.*"]),
    package_data={
        PACKAGE: ["config/*.yaml", "config/*/*.yaml", "config/view/*", "data/bags/*", "py.typed", "*.pyi"]
    },
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (f"share/{PACKAGE}", ["package.xml"]),
        *shared_files(f"{PACKAGE}/config", "config"),
        *shared_files("launch", "launch"),
        *shared_files("msg_docs", "msg_docs"),
        *shared_files("examples", "examples"),
    ],
    install_requires=[
        "setuptools",
        "numpy>=2.2",
        "scipy>=1.15",
        "numba>=0.61",
        "filterpy>=2.0",
        "mcap>=1.2",
        "rosbags>=0.11",
        "pydantic>=2.7",
        "PyYAML>=6.0",
        "typer>=0.12",
        "rich>=13",
        "matplotlib>=3.9",
        "joblib>=1.3",
        "zstandard>=0.22",
        "lz4>=4.3",
    ],
    extras_require={
        # A sourced ROS 2 brings its own; a plain machine gets these with one pip command.
        "ros": [
            "ros-kilted-rclpy==9.1.2",
            "ros-kilted-rmw-fastrtps-cpp==9.3.3",
            "ros-kilted-rosgraph-msgs==2.3.0",
            "ros-kilted-std-srvs==5.5.1",
            *(f"ros-kilted-{name}-msgs==5.5.1" for name in ROS_MESSAGES),
        ],
        # `ctr-dynamics diagnose --cluster`
        "cluster": ["distributed>=2024.8"],
        # `ctr-dynamics view`, 54 MB.
        "view": ["foxglove-sdk>=0.14"],
        # colcon runs pytest when it finds it in this extra.
        "test": [
            "distributed>=2024.8",
            "pytest>=8",
            "pytest-cov>=5",
            "pytest-xdist>=3.5",
            "hypothesis>=6.100",
            "import-linter>=2",
            "ruff",
            "mypy",
            "types-PyYAML",
            "build",
        ],
    },
    python_requires=">=3.10",
    zip_safe=False,
    author="ctr_dynamics developers",
    maintainer="ctr_dynamics developers",
    maintainer_email="ctr-dynamics@example.org",
    description="Real-time dynamics and state estimation of concentric tube robots, with a ROS 2 node.",
    long_description="Dynamic Cosserat-rod model of concentric tube robots advanced at fixed 3 ms steps, "
    "fused with a tip tracker by a reduced-rank Kalman filter, live in ROS 2 or from recorded bags.",
    license="Apache-2.0",
    entry_points={
        "console_scripts": [
            "ctr-dynamics = ctr_dynamics.cli.main:main",
            "estimator = ctr_dynamics.ros.programs:estimator",
            "managed_estimator = ctr_dynamics.ros.programs:managed_estimator",
            "driver = ctr_dynamics.ros.programs:driver",
            "tube_markers = ctr_dynamics.ros.programs:tube_markers",
        ],
    },
)
