"""`ctr-dynamics statics`: columns, statuses, exit codes and refusals."""

import csv
from pathlib import Path

import numpy as np
import pytest

from ctr_dynamics.cli.main import main
from ctr_dynamics.robot_files import load_robot, robot_from_dict, robot_to_dict, robot_to_yaml

DATA = Path(__file__).parents[1] / "data" / "static"


def weightless(name: str, folder: Path) -> Path:
    """A robot file without weight and bodies."""
    data = robot_to_dict(load_robot(name))
    data["gravity"]["value"] = [0.0, 0.0, 0.0]
    for tube in data["tubes"]:
        tube.pop("end_body", None)
    path = folder / f"{name}.yaml"
    path.write_text(robot_to_yaml(robot_from_dict(data)))
    return path


def solve(folder: Path, text: str, robot="till2020_tissue", *options: str):
    """(exit code, rows of the result or None)."""
    poses, out = folder / "poses.csv", folder / "out.csv"
    poses.write_text(text)
    code = main(
        [
            "statics",
            "--robot",
            str(robot),
            "--poses",
            str(poses),
            "--output",
            str(out),
            "--nodes",
            "40",
            *options,
        ]
    )
    if not out.exists():
        return code, None
    with out.open() as stream:
        return code, list(csv.DictReader(stream))


@pytest.mark.parametrize(
    ("name", "robot", "n"), [("A2_tissueTableIII", "till2020_tissue", 2), ("B3_TIMC", "three_tube", 3)]
)
@pytest.mark.parametrize("kind", ["unloaded", "loaded"])
def test_reference_tables_through_the_command(tmp_path, name, robot, n, kind):
    """The reference files as they are.

    Extra columns are noted, tips agree, the branch is chosen by the unloaded end angles.
    """
    with (DATA / f"{name}.{kind}.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    with (DATA / f"{name}.unloaded.csv").open() as stream:
        psi = {
            round(float(r["alpha1"]), 9): [r[f"psiL{i + 1}"] for i in range(n)]
            for r in csv.DictReader(stream)
        }
    header = [f"{c}{i + 1}" for c in ("beta", "alpha") for i in range(n)] + (
        ["Fx", "Fy", "Fz"] if kind == "loaded" else []
    )
    lines = [",".join(header + [f"psiL{i + 1}" for i in range(n)])]
    lines += [",".join([r[c] for c in header] + psi[round(float(r["alpha1"]), 9)]) for r in rows]
    code, found = solve(tmp_path, "\n".join(lines), weightless(robot, tmp_path))
    assert code == 0
    assert list(found[0]) == [
        "tip_x", "tip_y", "tip_z", "qw", "qx", "qy", "qz",
        *(f"tau{i + 1}" for i in range(n)), "stability", "status",
    ]  # fmt: skip
    limit = 2e-6 if kind == "unloaded" else 1e-4
    for row, expected in zip(found, rows, strict=True):
        assert row["status"] == "ok"
        assert float(row["stability"]) > 0
        tip = np.array([float(row[f"tip_{k}"]) - float(expected[f"tip_{k}"]) for k in "xyz"])
        assert np.linalg.norm(tip) < limit


def test_rows_without_end_angles_end_on_stable_shapes(tmp_path):
    """Sixteen of these rows have two stable shapes.

    Without psiL one of them is taken, never the unstable one between.
    """
    code, found = solve(
        tmp_path, (DATA / "A2_tissueTableIII.loaded.csv").read_text(), weightless("till2020_tissue", tmp_path)
    )
    assert code == 0
    assert {row["status"] for row in found} == {"ok"}


def test_an_unstable_shape_is_called_unstable(tmp_path):
    """End angles of the unstable equilibrium between two stable ones."""
    robot = load_robot("till2020_tissue")
    data = robot_to_dict(robot)
    # long straight lengths behind the plate and strong curvature: a snapping robot
    for tube, k in zip(data["tubes"], (30.0, 30.0), strict=True):
        tube["precurvature"][1]["curvature"]["value"] = [k, 0.0, 0.0]
        tube.pop("end_body", None)
    data["gravity"]["value"] = [0.0, 0.0, 0.0]
    path = tmp_path / "snapping.yaml"
    path.write_text(robot_to_yaml(robot_from_dict(data)))
    text = f"beta1,beta2,alpha1,alpha2,psiL1,psiL2\n-0.2521,-0.1977,{np.pi},0,{np.pi},0\n"
    code, found = solve(tmp_path, text, path)
    assert code == 0
    assert found[0]["status"] == "unstable"
    assert float(found[0]["stability"]) < 0


def test_gravity_and_bodies_of_the_file_act(tmp_path):
    text = "beta1,beta2,alpha1,alpha2\n-0.2521,-0.1977,1.5708,1.5708\n"
    _, heavy = solve(tmp_path, text)
    _, light = solve(tmp_path, text, weightless("till2020_tissue", tmp_path))
    assert float(heavy[0]["tip_y"]) < float(light[0]["tip_y"]) - 1e-3


def test_rows_that_cannot_be_used_are_named_and_the_rest_is_solved(tmp_path, capsys):
    text = (
        "alpha1,alpha2,beta1,beta2\n"  # order does not matter
        "0,0,-0.2521,-0.1977\n"
        "nan,0,-0.2521,-0.1977\n"
        "0,x,-0.2521,-0.1977\n"
        "0,0,-252.1,-197.7\n"  # millimetres
        "0,0,-0.19,-0.2\n"  # order
        "90,0,-0.2521,-0.1977\n"  # degrees
        "0,0,-0.2521\n"
        "0.5,0,-0.2521,-0.1977\n"
    )
    code, found = solve(tmp_path, text)
    assert code == 1
    assert [row["status"] for row in found] == ["ok", *["invalid"] * 6, "ok"]
    assert all(row["tip_x"] == "" and row["stability"] == "" for row in found[1:7])
    errors = capsys.readouterr().err
    for line in range(3, 9):
        assert f"line {line}: invalid" in errors
    assert "rad" in errors
    assert "divided by 1000" in errors or "metres" in errors


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("", "empty"),
        ("beta1,beta2,alpha1,alpha2\n", "no row"),
        ("beta1,alpha1,alpha2\n-0.2,0,0\n", "beta2"),
        ("beta1,beta2,beta3,alpha1,alpha2\n-0.2,-0.1,0,0,0\n", "beta3"),
        ("beta1,beta2,alpha1,alpha2,fx\n-0.2,-0.1,0,0,1\n", "'fx'"),
        ("beta1,beta2,alpha1,alpha2,Fx,Fy\n-0.2,-0.1,0,0,1,1\n", "Fz"),
        ("beta1,beta2,alpha1,alpha2,psiL1\n-0.2,-0.1,0,0,1\n", "psiL2"),
        ("beta1,beta1,beta2,alpha1,alpha2\n-0.2,-0.2,-0.1,0,0\n", "twice"),
    ],
)
def test_tables_that_cannot_be_read_end_with_one_line(tmp_path, capsys, text, match):
    code, found = solve(tmp_path, text)
    assert code == 2
    assert found is None
    errors = capsys.readouterr().err
    assert errors.count("\n") == 1
    assert match in errors


def test_missing_file_and_bad_nodes(tmp_path, capsys):
    assert (
        main(
            [
                "statics",
                "--robot",
                "three_tube",
                "--poses",
                str(tmp_path / "no.csv"),
                "--output",
                str(tmp_path / "o.csv"),
            ]
        )
        == 2
    )
    assert "no.csv" in capsys.readouterr().err
    code, _ = solve(
        tmp_path, "beta1,beta2,alpha1,alpha2\n-0.2521,-0.1977,0,0\n", "till2020_tissue", "--nodes", "3"
    )
    assert code == 2
