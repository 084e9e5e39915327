"""The report of a replay: written by the command, opened in a browser without a network."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from ctr_dynamics.cli import main as cli
from ctr_dynamics.io.bag_reader import open_bag
from ctr_dynamics.io.bag_writer import write_bag
from ctr_dynamics.io.messages import topics
from ctr_dynamics.io.messages.encode import encode_pose_stamped

BAGS = Path(__file__).parents[1] / "data" / "bags"
HEADINGS = (
    "Backbone", "Tip before and after fusion", "Distance from the tracker", "Innovations", "NIS", "Unknown tip force",
    "Time per step", "Provenance",
)  # fmt: skip


@pytest.fixture(scope="module")
def report(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("report")
    bag = folder / "<b>clean & <script>x.mcap"
    bag.write_bytes((BAGS / "clean_release.mcap").read_bytes())
    assert (
        cli.main(
            ["replay", str(bag), "--report", str(folder / "r.html"), "--summary", str(folder / "s.json")]
        )
        == 0
    )
    return folder / "r.html"


def test_report_holds_every_part(report):
    text = report.read_text()
    for heading in HEADINGS:
        assert f"<h2>{heading}</h2>" in text
    summary = json.loads((report.parent / "s.json").read_text())
    assert f"{1e3 * summary['residual_rms_m']['fused']:.3f} mm" in text
    assert summary["inputs"][0]["sha256"] in text
    assert "&lt;b&gt;clean &amp; &lt;script&gt;x.mcap" in text
    assert text.count("<svg") == 6
    assert "mathdefault" not in text
    assert report.stat().st_size < 4_000_000


def test_animation_follows_the_fused_backbone(report):
    block = report.read_text().split('id="backbone-data">')[1].split("</script>")[0]
    frames = json.loads(block)["frames"]
    t = np.array([frame["t"] for frame in frames])
    assert 150 < len(t) <= 900
    assert np.diff(t).max() < 0.05
    truth = np.load(BAGS / "truth" / "clean_release.npz")
    tip = np.array([frame["points"][-1] for frame in frames])
    wanted = 1e3 * np.stack([np.interp(t, truth["t"], truth["p"][:, i]) for i in range(3)], axis=1)
    assert np.sqrt(np.mean(np.sum((tip - wanted) ** 2, axis=1))) < 1.5  # the drawn registration is in it
    assert all(frame["tracker"] for frame in frames)


def test_report_opens_offline(report, browser):
    shown = browser.show(report, size=(1100, 1200))
    head = shown.document.split("<body")[0]
    assert 'data-animation="ready"' in head
    assert 'data-frame="0"' in head
    assert shown.console == ""
    picture = np.asarray(Image.open(shown.screenshot).convert("RGB")).astype(int)
    red = (np.abs(picture - [0xCF, 0x22, 0x2E]).sum(axis=2) < 60).sum()
    blue = (np.abs(picture - [0x09, 0x69, 0xDA]).sum(axis=2) < 60).sum()
    assert red > 500  # backbone and fused trace
    assert blue > 100  # model alone


def test_slider_moves_the_animation(report, browser, tmp_path):
    """The page's own script reacts to the controls; a second script presses them, with the policy taken off."""
    text = report.read_text()
    text = text.replace("Content-Security-Policy", "X-None", 1)
    press = (
        "<script>const s=document.getElementById('backbone-time');s.value=+s.max;s.oninput();"
        "document.getElementById('backbone-play').onclick();</script>"
    )
    file = tmp_path / "pressed.html"
    file.write_text(text.replace("</body>", press + "</body>"))
    head = browser.show(file).document.split("<body")[0]
    frames = int(head.split('data-frames="')[1].split('"')[0])
    assert int(head.split('data-frame="')[1].split('"')[0]) > 0
    assert frames > 150


def test_report_of_a_bag_with_faults_says_them(tmp_path):
    bag = tmp_path / "faults.mcap"
    with write_bag(bag, {}) as writer:
        for message in open_bag(BAGS / "clean_release.mcap").messages():
            if message.log_ns > 1_700_000_002_000_000_000:
                break
            data = message.data
            if message.topic == topics.TRACKER_TIP and message.log_ns % 1_000_000_000 < 200_000_000:
                data = encode_pose_stamped(message.log_ns, "ctr_base", (float("nan"), 0, 0), (0, 0, 0, 1))
            if (
                message.topic == topics.JOINT_STATES
                and 0 < message.log_ns - 1_700_000_001_200_000_000 < 500_000_000
            ):
                continue
            writer.write(message.topic, message.log_ns, data)
    out = tmp_path / "r.html"
    assert cli.main(["replay", str(bag), "--report", str(out)]) in (0, 1)
    text = out.read_text()
    assert "Invalid from 1." in text
    assert re.search(r"rejected, late, dropped</th><td>\d+, \d+, [1-3]\d</td>", text)


def test_report_must_not_be_the_bag(tmp_path, capsys):
    bag = tmp_path / "b.mcap"
    data = (BAGS / "clean_release.mcap").read_bytes()
    bag.write_bytes(data)
    assert cli.main(["replay", str(bag), "--report", str(bag)]) == 2
    assert "report is the bag that is read" in capsys.readouterr().err
    assert (
        cli.main(["replay", str(bag), "--summary", str(tmp_path / "x"), "--report", str(tmp_path / "x")]) == 2
    )
    assert bag.read_bytes() == data
