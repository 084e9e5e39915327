"""The diagnosis as one function of the public interface: from bags to findings."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from ctr_dynamics.diagnosis.request import Request, run
from ctr_dynamics.diagnosis.run_context import RunContext
from ctr_dynamics.parameters import Settings
from ctr_dynamics.robot import Robot
from ctr_dynamics.robot_files import load_robot


def diagnose(
    bags: Sequence[str | Path],
    robot: Robot | str | Path,
    output: str | Path,
    *,
    validate: Sequence[str | Path] = (),
    workers: int = 2,
    report: bool = True,
    progress: Callable[[str], None] | None = None,
    settings: Settings | Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Find what the simulation of a robot gets wrong about recordings of it, and how much.

    Takes minutes: the model is fitted with every effect that may be the cause (docs/diagnosis.md).

    Args:
        bags: recordings to fit, MCAP files or folders.
        robot: a robot, the name of a shipped one, or a robot file.
        output: folder for ``findings.json``, ``report.html`` and the extended robot file; made if it is not there.
        validate: recordings that are predicted only: what the extension is worth on them.
        workers: simulations at once.
        report: whether to write the page.
        progress: is told of every stage as it begins.
        settings: parameters, of which ``joints`` and ``tracker`` say what the bags' names, units and frames mean.

    Returns:
        The content of ``findings.json``: ``verdict`` ("clean", "named", "ambiguous", "unknown", ...), ``causes`` with their sizes in SI units,
        ``validation``, ``notes`` and more (docs/findings.md lists the keys).

    Raises:
        InputError: a bag that cannot be used or is given twice, no such robot, or a folder that cannot be written to.

    Example:
        The shipped recording agrees with its robot file:

        >>> from tempfile import TemporaryDirectory
        >>> from ctr_dynamics import diagnose
        >>> from ctr_dynamics.io.shipped_bags import shipped_bag
        >>> with TemporaryDirectory() as folder:
        ...     findings = diagnose([shipped_bag()], "till2020_tissue", folder, report=False)
        >>> findings["verdict"], findings["causes"]
        ('clean', [])
    """
    loaded = robot if isinstance(robot, Robot) else load_robot(robot)
    fitted, predicted = [str(bag) for bag in bags], [str(bag) for bag in validate]
    words = ["ctr-dynamics", "diagnose", *fitted, *(["--validate", *predicted] if predicted else [])]
    words += ["--robot", loaded.source or loaded.name, "--output", str(output)]
    checked = settings if isinstance(settings, Settings) else Settings(settings)
    request = Request(loaded, fitted, predicted, str(output), shlex.join(words), workers, report, checked)
    context = RunContext(workers=workers) if progress is None else RunContext(progress, workers)
    return run(request, context)
