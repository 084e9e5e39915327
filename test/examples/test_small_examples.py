"""The small examples run and show what they say."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest

EXAMPLES = Path(__file__).parents[2] / "examples"


def load(number: str):
    """The example whose file begins with that number; its name is no module's."""
    [path] = EXAMPLES.glob(f"{number}_*.py")
    spec = importlib.util.spec_from_file_location(f"example_{number}", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_static_shapes_differ_and_are_drawn(tmp_path, capsys):
    tips = load("01").main(tmp_path / "shape.png")
    assert capsys.readouterr().out.count("tip at") == 3
    rest, turned, loaded = tips.values()
    assert np.linalg.norm(turned - rest) > 5e-3
    assert loaded[1] < rest[1]
    assert (tmp_path / "shape.png").stat().st_size > 10_000


def test_the_released_tip_swings(tmp_path):
    tips = load("02").main(tmp_path / "release.png")
    height = tips["sdirk3"][:, 1]
    assert len(height) == 334
    assert np.ptp(height) > 0.02
    assert 1e-4 < np.abs(tips["bdf2"][:, 1] - height).max() < 0.01
    assert (tmp_path / "release.png").stat().st_size > 10_000


def test_the_fused_tip_is_better_than_the_open_loop(tmp_path):
    rms = load("03").main(tmp_path / "replay.png")
    assert rms["fused"] < 0.5 * rms["open loop"]
    assert (tmp_path / "replay.png").stat().st_size > 10_000


@pytest.mark.slow
def test_the_heavier_payload_is_found(tmp_path, capsys):
    module = load("04")
    findings = module.main(tmp_path)
    assert findings["verdict"] == "named"
    [cause] = findings["causes"]
    assert cause["effect"] == "payload_mass"
    low, high = cause["parameters"]["added_kg"]["ci99"]
    assert low < module.HEAVIER_KG < high
    assert (tmp_path / "findings" / "report.html").stat().st_size > 10_000
    assert "payload_mass: added_kg" in capsys.readouterr().out


def test_every_example_is_listed():
    text = (EXAMPLES / "README.md").read_text()
    names = sorted(path.name for path in EXAMPLES.glob("0*"))
    assert [name[:2] for name in names] == ["01", "02", "03", "04", "05", "06", "07"]
    assert all(name in text for name in names)
