"""Nodes as processes of their own, on a ROS domain of their own on this machine."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

ESTIMATOR = "ctr_dynamics.ros.estimator_node"
MANAGED_ESTIMATOR = "ctr_dynamics.ros.managed_estimator_node"
DRIVER = "ctr_dynamics.ros.driver_node"


def free_domain() -> int:
    """A ROS domain that others on this machine hardly use: 1 to 100 by process id (0 is everybody's)."""
    return 1 + os.getpid() % 100


def environment(domain_id: int) -> dict[str, str]:
    """The present environment on that domain, seen on this machine only."""
    return {
        "OPENBLAS_NUM_THREADS": "1",  # as the executables set it
        **os.environ,  # whole: the ROS wheels keep their library path in it
        "ROS_DOMAIN_ID": str(domain_id),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "PYTHONUNBUFFERED": "1",
    }


class NodeProcess:
    """A node in its own process; leaving the context stops it.

    Args:
        module: `ESTIMATOR`, `DRIVER`, another module, or the path of a script (.py).
        parameters: its ROS parameters.
        domain_id: ROS domain.
        log: file for its standard output and error.
        ros_arguments: further arguments behind --ros-args.
    """

    def __init__(
        self,
        module: str,
        parameters: Mapping[str, Any],
        domain_id: int,
        log: Path,
        ros_arguments: Sequence[str] = (),
    ) -> None:
        self.log = log
        program = [module] if module.endswith(".py") else ["-m", module]
        command = [sys.executable, *program, "--ros-args", *ros_arguments]
        for name, value in parameters.items():
            command += ["-p", f"{name}:={json.dumps(value)}"]  # JSON is YAML, with texts in quotes
        with log.open("wb") as stream:
            self._process = subprocess.Popen(
                command, stdout=stream, stderr=subprocess.STDOUT, env=environment(domain_id)
            )

    @property
    def pid(self) -> int:
        return self._process.pid

    @property
    def code(self) -> int | None:
        """Exit code, None while it runs."""
        return self._process.poll()

    def wait(self, timeout_s: float) -> int:
        """Exit code once it has ended by itself.

        Raises:
            subprocess.TimeoutExpired: it runs on.
        """
        return self._process.wait(timeout_s)

    def send(self, number: int) -> None:
        """Send a signal, if the process still runs."""
        if self.code is None:
            self._process.send_signal(number)

    def stop(self, timeout_s: float = 20.0) -> int:
        """End it by SIGINT, by SIGKILL when that does not help; returns the exit code."""
        self.send(signal.SIGINT)
        try:
            return self.wait(timeout_s)
        except subprocess.TimeoutExpired:
            self._process.kill()
            return self.wait(timeout_s)

    def output(self, lines: int = 20) -> str:
        """The last lines of its log."""
        return "\n".join(self.log.read_text(encoding="utf-8", errors="replace").splitlines()[-lines:])

    def __enter__(self) -> NodeProcess:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()
