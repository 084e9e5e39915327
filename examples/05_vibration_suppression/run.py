"""Releases a weight of 60 g with and without control, over DDS on this machine, and prints how long the tip takes to settle.

    python examples/05_vibration_suppression/run.py [--speed 0.5] [--output FOLDER]

Estimator, simulated robot and controller are three processes on a ROS domain of their own. `--speed 0` uses the system clock instead of /clock.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import signal
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ctr_dynamics.ros.node_processes import ESTIMATOR, NodeProcess, free_domain

sys.path.insert(0, str(Path(__file__).parent))
from simulated_robot import Hardware, Truth, settling_time

HERE = Path(__file__).parent
BAND_M = 0.003
PATIENCE_S = 900.0  # the first start of the estimator compiles


@dataclass
class Outcome:
    """What the robot really did: time (n,) s, tip (n, 3) m, angle of the drives (n,) rad."""

    t: np.ndarray
    tip: np.ndarray
    delta: np.ndarray

    @property
    def settled_s(self) -> float:
        """Time from the release until the tip stays within BAND_M along y, s."""
        truth = Truth(self.t.tolist(), list(self.tip), self.delta.tolist())
        return settling_time(truth, Hardware.release_s, BAND_M)

    def swing_m(self, begin_s: float, end_s: float) -> float:
        """Largest distance between two tip positions along y in that time, m."""
        part = self.tip[(self.t >= begin_s) & (self.t < end_s), 1]
        return float(np.ptp(part))


def release(
    folder: Path,
    domain: int,
    *,
    control: bool = True,
    seconds: float = 6.0,
    speed: float = 0.5,
    outage_s: tuple[float, float] = (0.0, 0.0),
    kill_estimator_after_s: float | None = None,
    controller: dict[str, Any] | None = None,
) -> Outcome:
    """One release.

    Args:
        folder: for logs and the truth.
        domain: ROS domain.
        outage_s: (from, to) in which the robot sends no joints: the estimator becomes invalid.
        kill_estimator_after_s: kill -9 at that time of the robot.
        controller: parameters of the controller.

    Raises:
        RuntimeError: a process failed.
    """
    folder.mkdir(parents=True, exist_ok=True)
    report = folder / "truth.npz"
    sim_time = {"use_sim_time": speed > 0}
    with contextlib.ExitStack() as stack:

        def start(module: str, values: dict[str, Any], name: str) -> NodeProcess:
            return stack.enter_context(NodeProcess(module, values, domain, folder / f"{name}.log"))

        estimator = start(ESTIMATOR, {"output.policy": "predict", **sim_time}, "estimator")
        commands = start(
            str(HERE / "controller_node.py"),
            {"enabled": control, **sim_time, **(controller or {})},
            "controller",
        )
        robot = start(
            str(HERE / "robot_node.py"),
            {
                "seconds": seconds,
                "speed": speed,
                "report": str(report),
                "outage_from_s": outage_s[0],
                "outage_to_s": outage_s[1],
            },
            "robot",
        )
        begin = time.monotonic()
        killed = kill_estimator_after_s is None
        while robot.code is None:
            if time.monotonic() - begin > PATIENCE_S:
                raise RuntimeError(f"the robot has not finished\n{robot.output()}\n{estimator.output()}")
            if commands.code is not None or (estimator.code is not None and not killed):
                raise RuntimeError(f"a process has ended\n{commands.output()}\n{estimator.output()}")
            if (
                not killed
                and kill_estimator_after_s is not None
                and _robot_time(folder) > kill_estimator_after_s
            ):
                estimator.send(signal.SIGKILL)
                killed = True
            time.sleep(0.01)
        if robot.code != 0:
            raise RuntimeError(robot.output())
    with np.load(report) as data:
        return Outcome(data["t"], data["tip"], data["delta"])


def _robot_time(folder: Path) -> float:
    """The robot's time as it last told it."""
    try:
        return float((folder / "truth.npz.time").read_text() or 0.0)
    except (OSError, ValueError):
        return 0.0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--speed", type=float, default=0.5, help="share of real time; 0: system clock")
    parser.add_argument("--seconds", type=float, default=6.0)
    parser.add_argument("--output", type=Path, help="folder for logs and truth")
    options = parser.parse_args()
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    with tempfile.TemporaryDirectory() as name:
        folder = options.output or Path(name)
        runs = {
            label: release(
                folder / label, free_domain(), control=control, seconds=options.seconds, speed=options.speed
            )
            for label, control in (("without", False), ("with", True))
        }
    figures = {
        label: {
            "settled_s": round(o.settled_s, 3),
            "largest_turn_rad": round(float(np.abs(o.delta).max()), 4),
        }
        for label, o in runs.items()
    }
    figures["ratio"] = round(runs["without"].settled_s / max(runs["with"].settled_s, 1e-3), 2)
    print(json.dumps(figures, indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
