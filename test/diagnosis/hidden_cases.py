"""Effects hidden by a simulator of its own, sealed until the verdict is in: cases, and what every outcome has."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from truth.cases import make_case

from ctr_dynamics.diagnosis.output.findings_keys import undocumented


def diagnosed(folder: Path, stratum: str, seed: int, effects, duration: float):
    """Make a case, run the command on it in a process of its own, then open the answer: findings, answer, and folder of the outputs."""
    case = make_case(seed, stratum, folder, effects=effects, duration_s=duration)
    arguments = [
        str(case.protocol),
        "--validate",
        str(case.sweep),
        "--robot",
        case.robot,
        "--output",
        str(folder / "out"),
        "--workers",
        "1",
    ]
    done = subprocess.run(
        [sys.executable, "-m", "ctr_dynamics.cli.main", "diagnose", *arguments, "--json"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout), case.unseal(), folder / "out"


def check_files(findings, folder: Path) -> None:
    """Findings are plain JSON without NaN, and the files that they name are there."""
    stored = json.loads((folder / "findings.json").read_text(), parse_constant=lambda text: pytest.fail(text))
    assert stored["schema"] == "ctr_dynamics/findings/1"
    assert undocumented(stored) == set()
    assert stored["verdict"] == findings["verdict"]
    for key in ("extended_robot", "recalibrated_robot"):
        assert (folder / stored[key]).is_file()
    report = (folder / "report.html").read_text()
    assert "<script src" not in report
    assert "mathdefault" not in report  # ticks of an axis as TeX that nobody typesets
    assert ">nominal<" in report
