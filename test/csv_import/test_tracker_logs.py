"""Logs as tracker programs write them: the same poses, whatever the headers, times and orientations."""

from __future__ import annotations

from datetime import datetime, timedelta, timezone

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ctr_dynamics.csv_import.column_layout import Layout
from ctr_dynamics.csv_import.convert import read_log
from ctr_dynamics.errors import InputError

COUNT = 30
TIMES = 5.0 + 0.025 * np.arange(COUNT)
RNG = np.random.default_rng(3)
POSITIONS = 0.1 * RNG.normal(size=(COUNT, 3))
ROTATIONS = Rotation.from_rotvec(0.7 * RNG.normal(size=(COUNT, 3)))
NAMES = ("x", "y", "z")
METRES = {name: {"column": name, "unit": "m"} for name in NAMES}
QUATERNIONS = {name: {"column": name} for name in ("qx", "qy", "qz", "qw")}


def table(times=TIMES, orientations=None):
    """Rows of text: time, position and orientation."""
    orientations = ROTATIONS.as_quat() if orientations is None else orientations
    return [
        [str(t), *(repr(float(v)) for v in (*p, *q))]
        for t, p, q in zip(times, POSITIONS, orientations, strict=True)
    ]


def read(tmp_path, lines, source):
    path = tmp_path / "log.csv"
    path.write_text("\n".join(lines) + "\n")
    layout = Layout.model_validate({"tracker": {"frame": "ctr_base", **source}})
    return read_log("tracker", path, layout, "")


def same(log, kept=slice(None)):
    np.testing.assert_allclose(log.columns(NAMES), POSITIONS[kept], atol=1e-12)
    found = Rotation.from_quat(log.columns(("qx", "qy", "qz", "qw")))
    assert np.max((found * ROTATIONS[kept].inv()).magnitude()) < 1e-9


def steps(log):
    return np.diff(log.stamp_ns) * 1e-9


HEAD = "t,x,y,z,qx,qy,qz,qw"


def test_several_lines_of_headers_and_names_twice(tmp_path):
    lines = [
        "Take,1,,,,,,",
        ",Position,,,Rotation,,,",
        "t,X,Y,Z,X,Y,Z,W",
        *(",".join(row) for row in table()),
    ]
    values = {name: {"column": name.upper(), "unit": "m"} for name in NAMES}
    values |= {f"q{name}": {"column": f"{name.upper()}#2"} for name in NAMES} | {"qw": {"column": "W"}}
    same(read(tmp_path, lines, {"header_line": 3, "time": {"column": "t", "unit": "s"}, "values": values}))


def test_white_space_without_a_header(tmp_path):
    names = (*NAMES, "qx", "qy", "qz", "qw")
    values = {name: {"column": str(i + 2), "unit": "m" if i < 3 else ""} for i, name in enumerate(names)}
    source = {"header_line": 0, "time": {"column": "1", "unit": "s"}, "values": values}
    same(read(tmp_path, ["  ".join(row) for row in table()], source))


def test_decimal_commas(tmp_path):
    lines = [HEAD.replace(",", ";"), *(";".join(cell.replace(".", ",") for cell in row) for row in table())]
    same(read(tmp_path, lines, {"time": {"column": "t", "unit": "s"}, "values": METRES | QUATERNIONS}))


def test_status_and_frame_numbers(tmp_path):
    rows = [[*row, "MISSING" if i % 5 == 2 else "OK"] for i, row in enumerate(table(range(700, 700 + COUNT)))]
    source = {
        "time": {"column": "t", "rate_hz": 40},
        "status": {"column": "state"},
        "values": METRES | QUATERNIONS,
    }
    log = read(tmp_path, [HEAD + ",state", *map(",".join, rows)], source)
    kept = [i for i in range(COUNT) if i % 5 != 2]
    same(log, kept)
    assert log.faults.count == COUNT - len(kept)
    assert "state is 'MISSING'" in log.faults.examples[0]
    np.testing.assert_allclose(steps(log), 0.025 * np.diff(kept), atol=2e-9)


def scattered(late, frames=None):
    """Rows whose host stamps come ``late`` by seconds, with frame numbers behind."""
    frames = range(41, 41 + COUNT) if frames is None else frames
    rows = table(1700000000.0 + TIMES + late)
    return [HEAD + ",Frame", *(",".join([*row, str(f)]) for row, f in zip(rows, frames, strict=True))]


BY_FRAMES = {"time": {"column": "t", "unit": "s", "frames": "Frame"}, "values": METRES | QUATERNIONS}


def test_stamps_that_scatter_about_frame_numbers(tmp_path):
    """Frames are even; what the host adds on average stays, two frames that it stamps alike are both there."""
    late = np.abs(7e-3 * np.random.default_rng(8).normal(size=COUNT))
    late[11] = late[10] - 0.025
    log = read(tmp_path, scattered(late), BY_FRAMES)
    same(log)
    assert np.ptp(steps(log)) < 1e-6
    assert steps(log).mean() == pytest.approx(0.025, abs=0.001)
    assert np.mean(log.stamp_ns) * 1e-9 == pytest.approx(1700000000.0 + np.mean(TIMES + late), abs=1e-6)
    assert any("scatter by" in note for note in log.notes)


def test_lost_frames_stay_gaps(tmp_path):
    kept = [i for i in range(COUNT) if not 8 <= i < 14]
    lines = scattered(np.zeros(COUNT))
    log = read(tmp_path, [lines[0], *(lines[1 + i] for i in kept)], BY_FRAMES)
    np.testing.assert_allclose(steps(log), 0.025 * np.diff(kept), atol=1e-6)


@pytest.mark.parametrize(
    ("frames", "says"),
    [
        ([*range(COUNT // 2), *range(COUNT // 2)], "is not later"),
        ([3 * i + 60 * (i > 5) for i in range(COUNT)], "scatter"),
    ],
)
def test_frame_numbers_that_count_no_frames(tmp_path, frames, says):
    if says == "scatter":
        with pytest.raises(InputError, match="scatter by"):
            read(tmp_path, scattered(np.zeros(COUNT), frames), BY_FRAMES)
    else:
        log = read(tmp_path, scattered(np.zeros(COUNT), frames), BY_FRAMES)
        assert log.faults.count == COUNT // 2
        assert says in log.faults.examples[0]


def test_a_log_with_frame_numbers_alone_names_the_cure(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("frame,x [m],y [m],z [m]\n1,0,0,0\n")
    with pytest.raises(InputError, match="column: frame, rate_hz"):
        read_log("tracker", path, Layout(), "ctr_base")


@pytest.mark.parametrize("form", ["date", "offset", "clock"])
def test_dates_and_times_of_day_over_midnight(tmp_path, form):
    begin = datetime(2023, 11, 14, 23, 59, 59, 700000, tzinfo=timezone.utc)
    moments = [begin + timedelta(milliseconds=25 * i) for i in range(COUNT)]
    text = {
        "date": [m.strftime("%Y-%m-%dT%H:%M:%S.%f") for m in moments],
        "offset": [(m + timedelta(hours=2)).strftime("%Y-%m-%d %H:%M:%S.%f+02:00") for m in moments],
        "clock": [m.strftime("%H:%M:%S.%f") for m in moments],
    }[form]
    log = read(
        tmp_path,
        [HEAD, *map(",".join, table(text))],
        {"time": {"column": "t"}, "values": METRES | QUATERNIONS},
    )
    same(log)
    np.testing.assert_allclose(steps(log), 0.025, atol=2e-9)
    if form != "clock":
        assert log.stamp_ns[0] == int(begin.timestamp()) * 10**9 + 700_000_000


def test_matrices(tmp_path):
    entries = [f"m{i}{k}" for i in range(3) for k in range(3)]
    lines = [
        ",".join(["t", *NAMES, *entries]),
        *map(",".join, table(orientations=ROTATIONS.as_matrix().reshape(-1, 9))),
    ]
    lines[4] = ",".join([*lines[4].split(",")[:4], *["0.0"] * 9])  # a row without an orientation
    values = METRES | {name: {"column": name} for name in entries}
    log = read(tmp_path, lines, {"time": {"column": "t", "unit": "s"}, "values": values})
    same(log, [i for i in range(COUNT) if i != 3])
    assert log.faults.count == 1


def test_euler_angles(tmp_path):
    angles = ROTATIONS.as_euler("ZYX", degrees=True)
    values = METRES | {name: {"column": name, "unit": "deg"} for name in ("yaw", "pitch", "roll")}
    lines = ["t,x,y,z,yaw,pitch,roll", *map(",".join, table(orientations=angles))]
    same(read(tmp_path, lines, {"time": {"column": "t", "unit": "s"}, "values": values}))


@pytest.mark.parametrize(
    ("source", "text"),
    [
        ({"time": {"column": "t"}}, "give unit or rate_hz"),
        ({"time": {"column": "t", "unit": "s"}, "header_line": 99}, "has no line 99"),
        ({"time": {"column": "t", "unit": "s"}, "status": {"column": "State"}}, "no column 'State'"),
    ],
)
def test_what_is_missing_is_said(tmp_path, source, text):
    with pytest.raises(InputError, match=text):
        read(tmp_path, [HEAD, *map(",".join, table())], {"values": METRES | QUATERNIONS, **source})
