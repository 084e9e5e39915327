"""What the figures were measured on."""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from ctr_dynamics import __version__


def machine() -> dict[str, Any]:
    """Processor, cores and load of this machine, and versions of what does the work."""
    packages = {"ctr_dynamics": __version__, "python": platform.python_version()}
    for name in ("numpy", "scipy", "numba", "llvmlite", "filterpy"):
        try:
            packages[name] = version(name)
        except PackageNotFoundError:
            packages[name] = "not installed"
    return {
        "processor": _processor(),
        "cores": os.cpu_count(),
        "load_1min": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
        "system": platform.platform(),
        "versions": packages,
    }


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()


def best_of(call: Callable[[], object], repeats: int, rounds: int = 5) -> float:
    """Time of one `call` in s: the fastest of `rounds` rounds of `repeats` calls, which is what other programs disturb least."""
    call()
    times = []
    for _ in range(rounds):
        begin = time.perf_counter()
        for _ in range(repeats):
            call()
        times.append((time.perf_counter() - begin) / repeats)
    return min(times)
