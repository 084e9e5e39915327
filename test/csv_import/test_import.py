"""CSV logs become the bag that they came from, whatever their units; what does not fit is said by name."""

from __future__ import annotations

import csv
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ctr_dynamics.cli import main as cli
from ctr_dynamics.csv_import.column_layout import Layout
from ctr_dynamics.csv_import.convert import read_log
from ctr_dynamics.errors import InputError
from ctr_dynamics.io.bag_reader import open_bag
from ctr_dynamics.io.messages import topics
from ctr_dynamics.io.messages.cdr import JointStateIn, PoseIn
from ctr_dynamics.kernels.rotations import from_vector, matrix, multiply
from ctr_dynamics.units import measure

BAG = Path(__file__).parents[1] / "data" / "bags" / "exact_release.mcap"
ROBOT = "till2020_tissue"


@pytest.fixture(scope="module")
def inputs():
    """Joints, poses and loads of the first 1.5 s of a bag."""
    found = {topic: [] for topic in (topics.JOINT_STATES, topics.TRACKER_TIP, topics.TIP_LOAD)}
    for item in open_bag(BAG).inputs():
        if item.message.stamp_ns < 1_700_000_001_500_000_000:
            found[item.topic].append(item.message)
    return found


def write(path: Path, header: list[str], rows) -> Path:
    with path.open("w", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(header)
        writer.writerows(rows)
    return path


@pytest.fixture
def logs(tmp_path, inputs):
    """The bag's inputs as CSV files in degrees, millimetres and milliseconds."""

    def joint_row(m: JointStateIn):
        at = dict(zip(m.names, m.positions, strict=True))
        return [
            f"{m.stamp_ns / 1e6:.3f}",
            *(repr(math.degrees(at[f"tube{n}_rotation"])) for n in (1, 2)),
            *(repr(1e3 * at[f"tube{n}_translation"]) for n in (1, 2)),
        ]

    joints = write(
        tmp_path / "joints.csv",
        [
            "time [ms]",
            "tube1_rotation [deg]",
            "tube2_rotation_deg",
            "tube1_translation (mm)",
            "tube2_translation_mm",
        ],
        map(joint_row, inputs[topics.JOINT_STATES]),
    )
    tracker = write(
        tmp_path / "tracker.csv",
        ["Tx [mm]", "Ty [mm]", "Tz [mm]", "Q0", "Qx", "Qy", "Qz", "quality", "t_s"],
        (
            [
                *(repr(1e3 * p) for p in m.position),
                *map(repr, np.roll(m.quaternion_xyzw, 1).tolist()),
                "ok",
                f"{m.stamp_ns / 1e9:.6f}",
            ]
            for m in inputs[topics.TRACKER_TIP]
        ),
    )
    load = write(
        tmp_path / "load.csv",
        ["stamp [ns]", "fx_N", "fy_mN", "fz [N]", "mx [N mm]", "my [N m]", "mz [N m]"],
        (
            [m.stamp_ns, m.force[0], 1e3 * m.force[1], m.force[2], 1e3 * m.torque[0], *m.torque[1:]]
            for m in inputs[topics.TIP_LOAD]
        ),
    )
    return {"--joints": joints, "--tracker": tracker, "--load": load}


def run(logs, out, *more, frame="ctr_base"):
    arguments = [str(x) for pair in logs.items() for x in pair]
    return cli.main(
        ["import", *arguments, "--output", str(out), *(["--frame", frame] if frame else []), *more]
    )


def test_import_gives_back_the_bag(logs, inputs, tmp_path, capsys):
    assert run(logs, tmp_path / "out.mcap", "--robot", ROBOT) == 0
    captured = capsys.readouterr()
    assert "poses are 0." in captured.out or "poses are 1." in captured.out  # mm from the static tip
    assert captured.err == ""
    bag = open_bag(tmp_path / "out.mcap")
    bag.check_inputs((topics.JOINT_STATES, topics.TRACKER_TIP))
    counts = dict.fromkeys(inputs, 0)
    for item in bag.inputs():
        wanted = inputs[item.topic][counts[item.topic]]
        counts[item.topic] += 1
        assert item.log_ns == item.message.stamp_ns
        assert abs(item.message.stamp_ns - wanted.stamp_ns) <= 1000
        if isinstance(wanted, JointStateIn):
            at = dict(zip(item.message.names, item.message.positions, strict=True))
            np.testing.assert_allclose([at[name] for name in wanted.names], wanted.positions, atol=1e-12)
        elif isinstance(wanted, PoseIn):
            assert item.message.frame_id == "ctr_base"
            np.testing.assert_allclose(item.message.position, wanted.position, atol=1e-12)
            np.testing.assert_allclose(item.message.quaternion_xyzw, wanted.quaternion_xyzw, atol=1e-6)
        else:
            np.testing.assert_allclose(item.message.force, wanted.force, atol=1e-12)
            np.testing.assert_allclose(item.message.torque, wanted.torque, atol=1e-12)
    assert counts == {topic: len(found) for topic, found in inputs.items()}


def test_same_logs_same_bytes(logs, tmp_path):
    assert run(logs, tmp_path / "a.mcap") == run(logs, tmp_path / "b.mcap") == 0
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()


def test_frame_must_be_stated(logs, tmp_path, capsys):
    assert run(logs, tmp_path / "out.mcap", frame="") == 2
    assert "frame of the poses is not stated" in capsys.readouterr().err
    assert not (tmp_path / "out.mcap").exists()


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("time [ms]", "time [s]", "outside 0 to 2147483647 s"),
        ("time [ms]", "time", "holds numbers of no stated unit"),
        ("tube1_rotation [deg]", "tube1_rotation [mm]", "unit 'mm' is none of rad"),
        ("tube1_rotation [deg]", "tube1_rotation", "has no unit; write one of rad"),
        ("tube2_rotation_deg", "tube1_rotation [deg]", "column 'tube1_rotation [deg]' is there 2 times"),
        ("tube1_translation (mm)", "tube1_translation (m)", "millimetres? Give metres"),
        ("tube1_translation (mm)", "carriage", "no column for tube1_translation"),
        (
            "tube2_rotation_deg",
            "tube1_rotation [rad]",
            "columns 'tube1_rotation [deg]' and 'tube1_rotation [rad]' are both tube1_rotation",
        ),
        ("tube2_rotation_deg", "t [s]", "columns 'time [ms]' and 't [s]' are both the time; leave one"),
        ("tube2_rotation_deg", "tube3_rotation [rad]", "no column for tube2_rotation"),
    ],
)
def test_units_and_columns_are_checked(logs, tmp_path, capsys, old, new, message):
    path = logs["--joints"]
    path.write_text(path.read_text().replace(old, new, 1))
    assert run(logs, tmp_path / "out.mcap") == 2
    err = capsys.readouterr().err
    assert message in err
    assert not (tmp_path / "out.mcap").exists()


def test_rotations_in_degrees_called_radians_are_found(tmp_path, capsys):
    rows = [[0.01 * k, 90.0 + k, -0.25] for k in range(50)]
    joints = write(tmp_path / "j.csv", ["t_s", "tube1_rotation_rad", "tube1_translation_m"], rows)
    assert run({"--joints": joints}, tmp_path / "out.mcap") == 2
    assert "degrees? Give radians" in capsys.readouterr().err
    assert run({"--joints": joints}, tmp_path / "out.mcap", "--force") == 0
    assert "1000000000 s are added to every stamp" in capsys.readouterr().err


def test_joints_out_of_the_robots_range_are_found(logs, tmp_path, capsys):
    text = logs["--joints"].read_text().splitlines()
    text[0] = text[0].replace("tube1_translation", "swap").replace("tube2_translation", "tube1_translation")
    logs["--joints"].write_text("\n".join([text[0].replace("swap", "tube2_translation"), *text[1:]]))
    assert run(logs, tmp_path / "out.mcap", "--robot", ROBOT) == 2
    assert "an inner tube's base lies behind the next outer one's" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("change", "hint"),
    [
        (
            lambda h: h.replace("Tx", "swap").replace("Ty", "Tx").replace("swap", "Ty"),
            "positions read as (y, x, z)",
        ),
        (
            lambda h: h.replace("Q0,Qx,Qy,Qz", "Qx,Qy,Qz,Qw"),
            "quaternion columns in the order x, y, z, w",
        ),
    ],
)
def test_swapped_axes_are_named(logs, tmp_path, capsys, change, hint):
    path = logs["--tracker"]
    header, rest = path.read_text().split("\n", 1)
    path.write_text(change(header) + "\n" + rest)
    assert run(logs, tmp_path / "out.mcap", "--robot", ROBOT) == 0
    err = capsys.readouterr().err
    assert "from the robot's static tip" in err
    assert hint in err or "order w, x, y, z" in err


def test_bad_rows_are_left_out_and_named(logs, tmp_path, capsys):
    path = logs["--joints"]
    lines = path.read_text().splitlines()
    lines[5] = lines[5].replace(",", ",nan,", 1).rsplit(",", 1)[0]
    lines[7] = lines[6]
    lines[9] = "broken"
    lines[11] = "x" + lines[11]
    path.write_text("\n".join(lines))
    assert run(logs, tmp_path / "out.mcap") == 1
    err = capsys.readouterr().err
    assert "4 rows left out" in err
    for line, why in ((6, "NaN"), (8, "not later"), (10, "1 cells for 5"), (12, "is not a number")):
        assert f"line {line}: " in err
        assert why in err


def test_layout_file_maps_signs_offsets_and_frames(tmp_path, inputs):
    turn, shift = np.array([0.0, 0.3, -1.2]), np.array([0.5, -0.2, 1.1])
    h = from_vector(turn)
    rows = []
    for m in inputs[topics.TRACKER_TIP]:
        q = multiply(h, np.roll(m.quaternion_xyzw, 1))
        rows.append([m.stamp_ns / 1e9, *(1e3 * (matrix(h) @ m.position + shift)), *q])
    tracker = write(tmp_path / "ndi.csv", ["when", "a", "b", "c", "s", "i", "j", "k"], rows)
    joints = write(
        tmp_path / "motors.csv",
        ["when", "m1", "c1"],
        [
            [m.stamp_ns / 1e9, 90 - math.degrees(m.positions[0]), -1e3 * m.positions[1]]
            for m in inputs[topics.JOINT_STATES]
        ],
    )
    layout = tmp_path / "layout.yaml"
    layout.write_text(
        "joints:\n"
        "  time: {column: when, unit: s}\n"
        "  values:\n"
        "    tube1_rotation: {column: m1, unit: deg, scale: -1, offset: 90}\n"
        "    tube1_translation: {column: c1, unit: mm, scale: -1}\n"
        "tracker:\n"
        "  time: {column: when, unit: s}\n"
        "  frame: camera\n"
        f"  registration_rotation_rad: {turn.tolist()}\n"
        f"  registration_translation_m: {shift.tolist()}\n"
        "  values:\n"
        "    x: {column: a, unit: mm}\n    y: {column: b, unit: mm}\n    z: {column: c, unit: mm}\n"
        "    qw: {column: s}\n    qx: {column: i}\n    qy: {column: j}\n    qz: {column: k}\n"
    )
    out = tmp_path / "out.mcap"
    assert run({"--joints": joints, "--tracker": tracker}, out, "--layout", str(layout), frame="") == 0
    taken = {topic: [] for topic in inputs}
    for item in open_bag(out).inputs():
        taken[item.topic].append(item.message)
    for got, wanted in zip(taken[topics.JOINT_STATES], inputs[topics.JOINT_STATES], strict=True):
        assert got.names == ("tube1_rotation", "tube1_translation")
        np.testing.assert_allclose(got.positions, [wanted.positions[0], wanted.positions[1]], atol=1e-12)
    for got, wanted in zip(taken[topics.TRACKER_TIP], inputs[topics.TRACKER_TIP], strict=True):
        np.testing.assert_allclose(got.position, wanted.position, atol=1e-9)
        angle = 2 * np.arccos(min(1.0, abs(np.dot(got.quaternion_xyzw, wanted.quaternion_xyzw))))
        assert angle < 1e-6


def test_a_frame_without_registration_is_rejected(logs, tmp_path, capsys):
    assert run(logs, tmp_path / "out.mcap", frame="camera") == 2
    assert "poses are in frame 'camera', not in ctr_base" in capsys.readouterr().err


def test_one_file_may_hold_both_logs_and_no_orientation(tmp_path, capsys):
    rows = [[0.01 * k, 0.1, -20, *(["1", "2", "100"] if k % 3 == 0 else ["", "", ""])] for k in range(100)]
    log = write(
        tmp_path / "log.csv",
        ["t_s", "tube1_rotation_rad", "tube1_translation_mm", "x_mm", "y_mm", "z_mm"],
        rows,
    )
    assert run({"--joints": log, "--tracker": log}, tmp_path / "out.mcap") == 0
    assert "tracker.axes=xyz" in capsys.readouterr().err
    topics_there = open_bag(tmp_path / "out.mcap").topics
    assert topics_there[topics.JOINT_STATES].messages == 100
    assert topics_there[topics.TRACKER_TIP].messages == 34


@pytest.mark.parametrize("head", ["# lab log\n\nt_s;x_mm;y_mm;z_mm\n", "# lab log\n# t_s;x_mm;y_mm;z_mm\n"])
def test_header_may_follow_comments_or_be_one(tmp_path, head):
    path = tmp_path / "t.csv"
    path.write_text(head + "".join(f"{k / 40};1;2;{k}\n" for k in range(9)))
    log = read_log("tracker", path, Layout(), "ctr_base")
    np.testing.assert_allclose(log.column("z"), 1e-3 * np.arange(9))


def test_logs_on_different_clocks_are_rejected(tmp_path, capsys):
    joints = write(
        tmp_path / "j.csv",
        ["t_s", "tube1_rotation_rad", "tube1_translation_m"],
        [[k / 100, 0, -0.1] for k in range(99)],
    )
    tracker = write(
        tmp_path / "t.csv", ["t_s", "x_m", "y_m", "z_m"], [[5000 + k / 40, 0, 0, 0.1] for k in range(40)]
    )
    assert run({"--joints": joints, "--tracker": tracker}, tmp_path / "out.mcap") == 2
    assert "both logs need one clock" in capsys.readouterr().err


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.one_of(
        st.binary(max_size=400),
        st.text(alphabet='t_sxmyz,;0123456789.eE+-#\n"[] \0', max_size=300).map(str.encode),
    )
)
def test_any_bytes_are_read_or_rejected_in_one_line(tmp_path, data):
    path = tmp_path / "any.csv"
    path.write_bytes(b"t_s,x_m,y_m,z_m\n" + data if len(data) % 2 else data)
    try:
        log = read_log("tracker", path, Layout(), "ctr_base")
    except InputError as error:
        assert "\n" not in str(error)
    else:
        assert np.isfinite(log.values).all()
        assert len(log.stamp_ns) == len(log.values) > 0
        assert all(b > a for a, b in zip(log.stamp_ns, log.stamp_ns[1:], strict=False))


@pytest.mark.parametrize(
    ("text", "si", "value"),
    [("1.5mm", "m", 1.5e-3), ("-2 deg", "rad", math.radians(-2)), ("52 GPa", "Pa", 52e9), (".3", "1", 0.3)],
)
def test_measures(text, si, value):
    assert measure(text, si, "x") == pytest.approx(value)


@pytest.mark.parametrize(("text", "si"), [("1.5", "m"), ("1.5 kg", "m"), ("mm", "m"), ("", "1")])
def test_measures_without_a_fitting_unit_are_rejected(text, si):
    with pytest.raises(InputError):
        measure(text, si, "x")


def test_faults_that_a_replay_would_mend_are_said(logs, tmp_path, capsys):
    """A tracker that was polled faster than it measures repeats its poses; angles may wrap."""
    header, *rows = csv.reader(logs["--tracker"].read_text().splitlines())
    time = header.index("t_s")
    for row in rows[10:25]:
        row[:] = [cell if i == time else rows[9][i] for i, cell in enumerate(row)]
    write(logs["--tracker"], header, rows)
    assert run(logs, tmp_path / "out.mcap", "--robot", ROBOT) == 0
    lines = [line for line in capsys.readouterr().err.splitlines() if "/ctr/tracker/tip" in line]
    assert any("equal" in line or "repeat" in line or "frozen" in line for line in lines), lines


@pytest.mark.parametrize(("digits", "rows"), [(0, 0), (1, 0), (2, 40)])
def test_times_with_too_few_digits_are_rejected(tmp_path, capsys, digits, rows):
    """Joints at 50 Hz, stamped in s since 1970."""
    data = [[f"{1.7e9 + 0.02 * k:.{digits}f}", 0.1 * k, -100.0] for k in range(40)]
    joints = write(tmp_path / "j.csv", ["time [s]", "tube1_rotation [deg]", "tube1_translation [mm]"], data)
    assert run({"--joints": joints}, tmp_path / "out.mcap") == (0 if rows else 2)
    error = capsys.readouterr().err
    assert rows or "of 40 rows have the time of the row before" in error


def test_cells_without_a_column_are_named(tmp_path, capsys):
    """Decimal commas between commas make two cells of one; an empty cell at the end is that of a separator there."""
    rows = [[0.02 * k, 0.5, "-100"] for k in range(40)]
    header = ["time [s]", "tube1_rotation [deg]", "tube1_translation [mm]"]
    joints = write(tmp_path / "j.csv", header, [[*row, ""] for row in rows])
    assert run({"--joints": joints}, tmp_path / "out.mcap") == 0
    joints = write(tmp_path / "k.csv", header, [*rows, [0.8, 0.5, "-100", "5"]])
    assert run({"--joints": joints}, tmp_path / "out.mcap") == 1
    assert "line 42: 4 cells for 3 columns (decimal commas" in capsys.readouterr().err


def test_rows_that_are_left_out_are_all_counted(tmp_path, capsys):
    rows = [[0.02 * k, "?" if k % 4 == 3 else 0.5, -100] for k in range(40)]
    joints = write(tmp_path / "j.csv", ["time [s]", "tube1_rotation [deg]", "tube1_translation [mm]"], rows)
    assert run({"--joints": joints}, tmp_path / "out.mcap") == 1
    error = capsys.readouterr().err
    assert "10 rows left out" in error
    assert error.rstrip().endswith("and 5 more")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("column: b", "column: a", "column 'a' is that of tube1_rotation and of tube1_translation"),
        ("unit: mm", "unit: mm, scale: 0", "0 makes every value the offset"),
        ("time:", "tiem:", "unknown key 'tiem'; did you mean 'time'?"),
        ("unit: s", "rate_hz: 40", "holds 0.02, and frames have whole numbers"),
        ("joints:", "tracker: {frame: x}\njoints:", "key 'time' is missing"),
    ],
)
def test_layouts_that_cannot_be_are_rejected(tmp_path, capsys, old, new, message):
    joints = write(tmp_path / "j.csv", ["t", "a", "b"], [[0.02 * k, 0.5, -100] for k in range(40)])
    layout = tmp_path / "layout.yaml"
    text = (
        "joints:\n  time: {column: t, unit: s}\n  values:\n"
        "    tube1_rotation: {column: a, unit: deg}\n    tube1_translation: {column: b, unit: mm}\n"
    )
    layout.write_text(text)
    assert run({"--joints": joints}, tmp_path / "out.mcap", "--layout", str(layout)) == 0
    layout.write_text(text.replace(old, new, 1))
    assert run({"--joints": joints}, tmp_path / "out.mcap", "--layout", str(layout)) == 2
    assert message in capsys.readouterr().err


def test_a_frame_that_the_layout_contradicts_is_rejected(logs, tmp_path, capsys):
    layout = tmp_path / "layout.yaml"
    layout.write_text(
        "tracker:\n  time: {column: t, unit: s}\n  frame: ctr_base\n  values:\n"
        "    x: {column: x, unit: m}\n    y: {column: y, unit: m}\n    z: {column: z, unit: m}\n"
    )
    poses = write(tmp_path / "p.csv", ["t", "x", "y", "z"], [[0.02 * k, 0.0, 0.0, 0.1] for k in range(40)])
    given = {"--joints": logs["--joints"], "--tracker": poses}
    assert run(given, tmp_path / "out.mcap", "--layout", str(layout), frame="ndi") == 2
    assert "--frame says 'ndi' and the layout 'ctr_base'" in capsys.readouterr().err
