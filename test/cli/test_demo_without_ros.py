"""The demo where there is no ROS 2: the bag is replayed, and one line says so."""

from __future__ import annotations

import json
import sys

from ctr_dynamics.cli.demo_command import demo
from ctr_dynamics.io.bag_reader import open_bag
from ctr_dynamics.io.messages import topics


def test_the_demo_replays_and_says_so(tmp_path, capfd, monkeypatch):
    monkeypatch.setitem(sys.modules, "rclpy", None)  # as if it were not installed
    for name in [n for n in sys.modules if n.startswith("ctr_dynamics.ros.")]:
        monkeypatch.delitem(sys.modules, name)
    out = tmp_path / "out"
    assert demo(bag=None, truth=None, output=out, robot="till2020_tissue", policy="wait", duration=2.0) == 0
    shown = " ".join(capfd.readouterr().out.split())
    assert "the live part is skipped" in shown
    figures = json.loads((out / "demo.json").read_text())
    assert {c["reference"] for c in figures["comparisons"]} == {"tracker", "truth"}
    # 2 s in steps of 3 ms
    assert figures["timing"]["steps"] > 600
    assert figures["driver"] == {}
    assert (out / "demo.png").read_bytes().startswith(b"\x89PNG")
    assert open_bag(out / "outputs.mcap").topics[topics.TIP_POSE].messages > 600
