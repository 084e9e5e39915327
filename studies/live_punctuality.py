"""Punctuality of the estimator node over real DDS: steps published late, how late, and none skipped.

The estimator and a driver run as two processes of this machine; nobody but this script's own listener (with
--listen) receives the outputs. Bags are played one after the other, each run with a fresh estimator, until the
asked time has been played. Figures go to standard output as JSON. Beside them stands the machine's own
punctuality: how often a thread of this script that does nothing but sleep until the next 3 ms is as late, and
for how long a virtual machine's processors were given to others.

    python -m studies.live_punctuality BAG [BAG ...] --seconds 60 --policy predict
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ctr_dynamics.io.messages import topics
from ctr_dynamics.ros.listener import Listener
from ctr_dynamics.ros.node_processes import DRIVER, ESTIMATOR, NodeProcess, free_domain
from ctr_dynamics.runtime.playback import load

STEP_NS = 3_000_000
LIMITS = {"late_fraction": 0.001, "late_over_20ms": 0, "skipped": 0}


class Sleeper(threading.Thread):
    """Sleeps from one 3 ms deadline to the next and notes how late it wakes, in ms."""

    def __init__(self) -> None:
        super().__init__(daemon=True)
        self.late_ms: list[float] = []
        self._stopping = threading.Event()

    def run(self) -> None:
        due_ns = time.monotonic_ns() + STEP_NS
        while not self._stopping.is_set():
            time.sleep(max(0, due_ns - time.monotonic_ns()) * 1e-9)
            self.late_ms.append((time.monotonic_ns() - due_ns) * 1e-6)
            due_ns += STEP_NS

    def stop(self) -> dict[str, Any]:
        """End it; returns its figures, named like a node's."""
        self._stopping.set()
        self.join()
        return {
            "steps": len(self.late_ms),
            "late_over_3ms": sum(late > 3.0 for late in self.late_ms),
            "late_over_20ms": sum(late > 20.0 for late in self.late_ms),
            "max_ms": max(self.late_ms, default=0.0),
        }


def run(
    bag: Path,
    settings: dict[str, Any],
    seconds: float,
    listen: bool,
    watch: Callable[[int], object] = lambda pid: None,
) -> dict[str, Any]:
    """One bag live; the estimator's timing report with its processor time. ``watch`` is called with its process number every 0.2 s."""
    domain = free_domain()
    with tempfile.TemporaryDirectory() as name, contextlib.ExitStack() as stack:
        folder = Path(name)
        report = folder / "timing.json"
        estimator = stack.enter_context(
            NodeProcess(
                ESTIMATOR, {**settings, "timing_report": str(report)}, domain, folder / "estimator.log"
            )
        )
        if listen:
            names = [topic.name for topic in topics.OUTPUTS]
            stack.enter_context(Listener(domain, names, depth=5000))
        while estimator.code is None and "waiting for" not in estimator.output():
            time.sleep(0.1)  # kernels are being compiled
        before, stolen_before = processor_time(estimator.pid), stolen_s()
        played = {"bag": str(bag), "duration_s": seconds, "wait_s": 900.0}
        driver = stack.enter_context(NodeProcess(DRIVER, played, domain, folder / "driver.log"))
        sleeper = Sleeper()
        sleeper.start()
        while driver.code is None and estimator.code is None:
            time.sleep(0.2)
            watch(estimator.pid)
        machine = {**sleeper.stop(), "stolen_s": round(stolen_s() - stolen_before, 2)}
        used = processor_time(estimator.pid) - before
        if estimator.code is not None or driver.code != 0 or estimator.stop() != 0:
            raise SystemExit(f"{driver.output()}\n{estimator.output()}")
        return {
            "bag": str(bag),
            **json.loads(report.read_text()),
            "processor_s": round(used, 2),
            "machine": machine,
        }


def processor_time(pid: int) -> float:
    """User and system time of a process in s (Linux); 0 when it is gone."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    except OSError:
        return 0.0
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def stolen_s() -> float:
    """Time in s for which this virtual machine's processors had work and were not given to it (Linux), all together; 0 where nothing tells."""
    try:
        fields = Path("/proc/stat").read_text().split("\n", 1)[0].split()
        return int(fields[8]) / os.sysconf("SC_CLK_TCK")
    except (OSError, IndexError):
        return 0.0


def main() -> int:
    """Run the benchmark; returns 1 when a limit is exceeded."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("bags", nargs="+", type=Path)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--policy", choices=("predict", "wait"), default="predict")
    parser.add_argument("--robot", default="till2020_tissue")
    parser.add_argument("--nodes", type=int, default=None, help="model.nodes")
    parser.add_argument("--record", action="store_true", help="let the node record its inputs and outputs")
    parser.add_argument("--listen", action="store_true", help="subscribe to every output meanwhile")
    options = parser.parse_args()
    runs: list[dict[str, Any]] = []
    left = options.seconds
    spans = {bag: span_s(bag) for bag in options.bags}
    with tempfile.TemporaryDirectory() as folder:
        while left > 0.5:
            bag = options.bags[len(runs) % len(options.bags)]
            settings: dict[str, Any] = {"robot": options.robot, "output.policy": options.policy}
            if options.nodes is not None:
                settings["model.nodes"] = options.nodes
            if options.record:
                settings["record.path"] = str(Path(folder) / f"run{len(runs)}.mcap")
            runs.append(run(bag, settings, min(left, spans[bag]), options.listen))
            left -= spans[bag]
    steps = sum(r["steps"] for r in runs)
    figures = {
        "steps": steps,
        "late_fraction": sum(r["late_over_3ms"] for r in runs) / max(steps, 1),
        "late_over_20ms": sum(r["late_over_20ms"] for r in runs),
        "skipped": sum(r["skipped"] for r in runs),
        "machine_late_fraction": sum(r["machine"]["late_over_3ms"] for r in runs)
        / max(sum(r["machine"]["steps"] for r in runs), 1),
        "machine_stolen_s": round(sum(r["machine"]["stolen_s"] for r in runs), 2),
        "max_lateness_ms": max(r["lateness_ms"]["max"] for r in runs),
        "runs": runs,
    }
    json.dump(figures, sys.stdout, indent=1)
    print()
    missed = [f"{name} {figures[name]} > {limit}" for name, limit in LIMITS.items() if figures[name] > limit]
    print("; ".join(missed) or "within all limits", file=sys.stderr)
    return 1 if missed or not steps else 0


def span_s(bag: Path) -> float:
    """Duration of a bag's inputs in s."""
    messages = load(bag)
    return (messages[-1].log_ns - messages[0].log_ns) * 1e-9


if __name__ == "__main__":
    sys.exit(main())
