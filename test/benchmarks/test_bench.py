"""`ctr-dynamics bench`: what it writes. No time is asserted."""

import json
import math

import pytest

from ctr_dynamics.cli.main import main


def numbers(item):
    """Every number in nested data."""
    if isinstance(item, dict):
        for value in item.values():
            yield from numbers(value)
    elif isinstance(item, list):
        for value in item:
            yield from numbers(value)
    elif isinstance(item, (int, float)) and not isinstance(item, bool):
        yield item


def test_quick_bench_writes_figures_and_plots(tmp_path, capsys):
    assert main(["bench", "--quick", "--output", str(tmp_path), "--page", str(tmp_path / "page.md")]) == 0
    result = json.loads((tmp_path / "bench.json").read_text())
    assert set(result) == {
        "quick", "machine", "sweeps", "simulate", "sensitivities", "replay", "rank", "time_error", "figure_13", "figure_14", "snap",
    }  # fmt: skip
    assert result["machine"]["cores"] >= 1
    assert {"numpy", "numba", "ctr_dynamics", "python"} <= set(result["machine"]["versions"])

    plain = {(r["tubes"], r["nodes"]): r["sweep_us"] for r in result["sweeps"] if r["lanes"] == 1}
    assert set(plain) == {(2, 12), (2, 100)}
    for row in result["sweeps"]:
        assert row["sweep_us"] > 0
        assert row["ratio_to_plain_sweep"] == pytest.approx(
            row["sweep_us"] / plain[row["tubes"], row["nodes"]]
        )
    for row in result["simulate"]:
        assert row["sweeps_per_step"] >= 3
        assert row["sweeps_per_solve"] * 3 - row["sweeps_per_step"] < 1e-9
        assert row["step_ratio_to_plain_sweep"] > row["sweeps_per_step"] * 0.2
    for row in result["sensitivities"]:
        assert row["simulations"] > 1.0
    for row in result["replay"]:
        assert (
            0
            < row["tick_ms"]["p50"]
            <= row["tick_ms"]["p99"]
            <= row["tick_ms"]["p99.9"]
            <= row["tick_ms"]["max"]
        )
        assert sum(row["histogram"]["counts"]) == row["steps"]
    ratios = [
        row["realtime_ratio"] for part in ("simulate", "replay", "figure_13") for row in result[part]
    ] + [row["realtime_ratio"] for row in result["figure_14"]["rows"]]
    assert all(ratio > 0 and math.isfinite(ratio) for ratio in ratios)
    assert all(math.isfinite(x) for x in numbers(result))

    # what does not depend on the machine, or only as ratios within the run do
    for row in result["simulate"]:
        assert (
            row["sweeps_per_step"] + 2 * row["jacobians_per_step"] <= 20
        )  # the load is cut amid this short run
        assert row["sweeps_per_solve"] <= 5
        assert (
            row["step_ratio_to_plain_sweep"] < 60
        )  # three times what it is; a quarter of it would be lost to Python
    lanes = {(r["nodes"], r["lanes"]): r["lane_ratio_to_plain_sweep"] for r in result["sweeps"]}
    assert lanes[100, 8] < 0.6  # of a plain sweep a lane: lanes vectorise
    error = {r["scheme"]: r["error_m"] for r in result["time_error"]["schemes"]}
    assert error["radau"] < 0.2 * error["sdirk3"]
    assert error["sdirk3"] < error["sdirk2"] < error["bdf2"] < error["backward_euler"]
    over = {round(1e6 * r["dt_s"]): r for r in result["time_error"]["steps"]}
    assert over[3000]["divided_error_m"] < over[3000]["error_m"]
    assert over[1500]["divided_error_m"] < 0.7 * over[3000]["divided_error_m"]
    space = [r["error_m"] for r in result["figure_14"]["rows"]]
    assert space[0] > 10 * space[1] > 10 * space[2] or space[2] < 1e-8
    euler = {r["nodes"]: r["euler_error_m"] for r in result["figure_14"]["rows"]}
    assert 1.7 < euler[24] / euler[48] < 2.6  # first order
    assert euler[48] > 1000 * space[2]

    for name in ("sweeps", "ticks", "figure_13", "figure_14", "time_error"):
        assert (tmp_path / f"{name}.png").read_bytes().startswith(b"\x89PNG")
    assert (tmp_path / "page.md").read_text().startswith("# Performance")
    shown = capsys.readouterr().out
    assert "sweeps/step" in shown
    assert str(tmp_path / "bench.json") in shown
