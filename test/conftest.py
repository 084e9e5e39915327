"""Isolation of every test run: its own ROS domain on this machine only, its own figures backend; a browser for the reports."""

from __future__ import annotations

import gc
import os
import shutil
import subprocess
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

# Set before anything imports rclpy; child processes inherit both. 0 and the low ids are left to people.
os.environ["ROS_DOMAIN_ID"] = str(
    20 + os.getpid() % 80
)  # above 101 its ports are those that Linux gives to clients
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
os.environ.setdefault("MPLBACKEND", "Agg")

import pytest

# Before anything imports NumPy: the workers of a run share the cores.
from ctr_dynamics.one_blas_thread import one_blas_thread

one_blas_thread()


WITHOUT_ROS = find_spec("rclpy") is None
collect_ignore = ["ros"] if WITHOUT_ROS else []


@pytest.fixture(scope="module", autouse=True)
def _what_is_loaded_is_no_garbage():
    """A run of all tests holds millions of objects. A collection that searches them takes seconds, and a step loop makes one every second."""
    gc.collect()
    gc.freeze()


def pytest_report_header() -> list[str]:
    """Say in one line what is left out."""
    return ["no ROS 2 here: test/ros and the tests marked ros are skipped"] if WITHOUT_ROS else []


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Tests that need ROS 2 are skipped where there is none."""
    for item in items:
        if WITHOUT_ROS and item.get_closest_marker("ros"):
            item.add_marker(pytest.mark.skip(reason="no ROS 2 here"))


@dataclass(frozen=True)
class Shown:
    """What a browser made of a page: the document after its scripts ran, its console, a screenshot."""

    document: str
    console: str
    screenshot: Path


class Browser:
    """Headless Chromium without a network: every name resolves to nothing."""

    def __init__(self, program: str, folder: Path) -> None:
        self.program, self.folder, self.count = program, folder, 0

    def show(self, page: Path | str, size: tuple[int, int] = (1100, 1400), seconds: float = 3.0) -> Shown:
        """Open a file (or an address of this machine), let its scripts run, dump the document and take a picture."""
        self.count += 1
        address = page.resolve().as_uri() if isinstance(page, Path) else page
        picture = self.folder / f"shown{self.count}.png"
        common = [
            self.program, "--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--disable-dev-shm-usage",
            "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1", "--no-first-run", "--disable-background-networking",
            f"--user-data-dir={self.folder / 'profile'}", f"--window-size={size[0]},{size[1]}",
            f"--virtual-time-budget={round(1e3 * seconds)}", "--enable-logging=stderr",
        ]  # fmt: skip
        dumped = subprocess.run(
            [*common, "--dump-dom", address], capture_output=True, text=True, timeout=120, check=True
        )
        subprocess.run(
            [*common, f"--screenshot={picture}", address], capture_output=True, timeout=120, check=True
        )
        console = "\n".join(line for line in dumped.stderr.splitlines() if "CONSOLE" in line)
        return Shown(dumped.stdout, console, picture)


@pytest.fixture(scope="session")
def browser(tmp_path_factory) -> Browser:
    """Headless Chromium; .ci/run installs it."""
    names = ("chromium", "chromium-headless-shell", "chromium-browser", "google-chrome")
    program = os.environ.get("CHROMIUM") or next(filter(None, map(shutil.which, names)), None)
    if program is None:
        pytest.skip("no Chromium on this machine (apt-get install chromium, or set CHROMIUM)")
    return Browser(program, tmp_path_factory.mktemp("browser"))
