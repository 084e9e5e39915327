"""Robot files from data sheets: the shipped robot again from its sheet, prompts, deviations, and what is refused."""

from __future__ import annotations

import io
import math

import pytest
import yaml

from ctr_dynamics.cli import main as cli
from ctr_dynamics.errors import InputError
from ctr_dynamics.robot_files import load_robot
from ctr_dynamics.robot_files.datasheet import Measured, measured, tube_from_text

INNER = "name=inner, od=1.244mm, id=1.028mm, straight=301mm, curved=97.1mm, radius=109.0037mm+-0.3%, E=52GPa+-0.4%, density=6493kg/m^3"
OUTER = "name=outer, od=2.06mm, id=1.6mm, straight=20cm, curved=84.5 mm, radius=99.25558mm, E=75 GPa, density=6.493 g/cm^3"
REST = ["--beta", "-252.1mm,-197.7mm", "--alpha", "90deg, 90 deg"]


def new(path, *arguments):
    return cli.main(["robot", "new", str(path), *arguments])


def test_the_shipped_robot_from_its_data_sheet(tmp_path, capsys):
    path = tmp_path / "mine.yaml"
    tip = ["--tip-mass", "8 g +- 20 mg", "--tip-diameter", "49.4 mm"]
    assert new(path, "--tube", INNER, "--tube", OUTER, *REST, *tip) == 0
    made, shipped = load_robot(path), load_robot("till2020_tissue")
    assert made.name == "mine"
    assert made.rest.beta.value == shipped.rest.beta.value
    assert made.rest.alpha.value == pytest.approx(shipped.rest.alpha.value, abs=1e-10)
    for a, b in zip(made.tubes, shipped.tubes, strict=True):
        assert (a.name, a.outer_radius.value, a.inner_radius.value) == (
            b.name,
            b.outer_radius.value,
            b.inner_radius.value,
        )
        assert a.bending_stiffness == pytest.approx(b.bending_stiffness, rel=1e-12)
        assert a.length == pytest.approx(b.length, abs=1e-10)
        assert a.curvature_at(a.length) == pytest.approx(b.curvature_at(b.length), rel=1e-5)
    assert made.tubes[0].youngs_modulus.relative == pytest.approx(0.004)
    assert made.tubes[0].precurvature_tolerance == pytest.approx(0.003)
    assert made.tubes[0].end_body.mass.tolerance == pytest.approx(2e-5)
    assert made.tubes[0].end_body.inertia.value[0] == pytest.approx(
        shipped.tubes[0].end_body.inertia.value[0], rel=1e-6
    )
    assert path.read_text().startswith("# SI units")
    assert "youngs_modulus of tube 2" in capsys.readouterr().err  # no deviation was given
    assert cli.main(["robot", "check", str(path)]) == 0
    assert "tip at rest" in capsys.readouterr().out


def test_deviations_of_diameters_go_into_modulus_and_density(tmp_path):
    path = tmp_path / "r.yaml"
    assert new(path, "--tube", "od=2mm+-0.02mm, id=1mm, straight=100mm, E=60GPa+-3%, density=6.5g/cm^3") == 0
    tube = load_robot(path).tubes[0]
    ro, ri, sigma = 1e-3, 0.5e-3, 1e-5
    step = 1e-9
    bending = ((ro + step) ** 4 - ri**4) / (ro**4 - ri**4) - 1
    area = ((ro + step) ** 2 - ri**2) / (ro**2 - ri**2) - 1
    assert tube.youngs_modulus.relative == pytest.approx(math.hypot(0.03, bending / step * sigma), rel=1e-4)
    assert tube.density.relative == pytest.approx(area / step * sigma, rel=1e-4)
    given = "od=2mm+-0.02mm, id=1mm, straight=100mm, E=60GPa+-3%, G=20GPa+-4%, density=6.5g/cm^3"
    assert new(path, "--force", "--tube", given) == 0
    shear = load_robot(path).tubes[0].shear_modulus
    assert shear.relative == pytest.approx(math.hypot(0.04, bending / step * sigma), rel=1e-4)


def test_prompts_ask_for_everything(tmp_path, monkeypatch, capsys):
    answers = [
        "inner", "1.2 mm", "1.0 mm", "200 mm", "50 mm", "80 mm", "60", "60 GPa +- 5 %", "", "", "", "",  # E once without a unit
        "2 g", "10 mm", "-10mm", "0deg", "", "", "5 ms +- 1 ms", "",
    ]  # fmt: skip
    monkeypatch.setattr("sys.stdin", io.StringIO("\n".join(answers) + "\n"))
    path = tmp_path / "asked.yaml"
    assert new(path) == 0, capsys.readouterr().err
    robot = load_robot(path)
    assert robot.n_tubes == 1
    assert robot.tubes[0].youngs_modulus.value == 60e9
    assert robot.tubes[0].density.value == 6450.0
    assert robot.tubes[0].length == pytest.approx(0.25)
    assert robot.tracker.delay.value == 0.005
    assert robot.rest.beta.value == (-0.01,)
    assert "'60' has no unit" in capsys.readouterr().err


def test_no_answer_is_one_line(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("sys.stdin", io.StringIO(""))
    assert new(tmp_path / "r.yaml") == 2
    assert "give --tube for each tube" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("tubes", "message"),
    [
        (["od=1mm"], "id, straight, E, density are missing"),
        ([INNER.replace("od=1.244mm", "od=1.244")], "'1.244' has no unit"),
        ([INNER.replace("od=", "diameter=")], "unknown key 'diameter'"),
        ([INNER.replace("id=1.028mm", "id=1.3mm")], "id 1.3 mm is not below od 1.244 mm"),
        ([INNER.replace("radius=109.0037mm+-0.3%, ", "")], "curved is given and radius is not"),
        ([INNER, OUTER.replace("id=1.6mm", "id=1.2mm")], "does not fit around"),
        ([INNER.replace("E=52GPa", "E=52kPa")], "is outside"),
        ([INNER.replace("E=52GPa+-0.4%", "E=52GPa+--1%")], "is not 0 or more"),
        ([INNER + ", EI=0.003N m^2"], "both EI and E are given"),
        ([INNER + ", od=1.2mm"], "od is given twice"),
        ([INNER.replace("radius=109.0037mm+-0.3%", "radius=0mm")], "radius 0 mm is none"),
    ],
)
def test_sheets_that_cannot_be_are_rejected(tmp_path, capsys, tubes, message):
    path = tmp_path / "r.yaml"
    assert new(path, *(part for text in tubes for part in ("--tube", text))) == 2
    err = capsys.readouterr().err
    assert message in err
    assert err.count("\n") == 1
    assert not path.exists()


def test_a_diameter_of_the_tip_without_its_mass_is_rejected(tmp_path, capsys):
    path = tmp_path / "r.yaml"
    assert new(path, "--tube", INNER, "--tip-diameter", "3mm") == 2
    assert "a diameter is given and no mass" in capsys.readouterr().err


@pytest.mark.parametrize("given", [[], REST])
def test_a_rest_position_that_nobody_gave_is_said(tmp_path, capsys, given):
    path = tmp_path / "r.yaml"
    assert new(path, "--tube", INNER, "--tube", OUTER, *given) == 0
    assert ("Rest position: bases 10 mm apart" in capsys.readouterr().err) == (not given)
    assert ("Rest position" in path.read_text()) == (not given)


def test_stiffnesses_and_curvature_as_they_are_published(tmp_path):
    """The same robot in EI, GJ and curvature; their deviations are their own, whatever the diameters'."""
    path = tmp_path / "r.yaml"
    text = (
        "name=a, od=1.2mm+-0.02mm, id=0.9mm, straight=250mm, curved=60mm, curvature=0.0125 1/mm+-2%, "
        "EI=4000N mm^2+-5%, GJ=0.003N m^2, density=6.45g/cm^3"
    )
    assert new(path, "--tube", text) == 0
    tube = load_robot(path).tubes[0]
    assert tube.bending_stiffness == pytest.approx(4e-3)
    assert tube.torsion_stiffness == pytest.approx(3e-3)
    assert tube.youngs_modulus.relative == pytest.approx(0.05)
    assert tube.shear.relative == 0.0
    assert tube.precurvature[1].curvature.value == pytest.approx((12.5, 0.0, 0.0))
    assert tube.precurvature[1].relative_tolerance == pytest.approx(0.02)


def test_an_existing_file_is_kept(tmp_path, capsys):
    path = tmp_path / "r.yaml"
    path.write_text("mine")
    assert new(path, "--tube", INNER) == 2
    assert path.read_text() == "mine"
    assert new(path, "--tube", INNER, "--force") == 0
    assert load_robot(path).n_tubes == 1


def test_doubtful_numbers_are_said(tmp_path, capsys):
    path = tmp_path / "r.yaml"
    tight = OUTER.replace("id=1.6mm", "id=1.245mm")
    bent = INNER.replace("radius=109.0037mm+-0.3%", "radius=5mm")
    assert new(path, "--tube", bent, "--tube", tight, *REST) == 0
    err = capsys.readouterr().err
    assert "clearance between tube 1 and 2 is 0.0005 mm" in err
    assert "tube 1 is strained by 12.4 %" in err


def test_moduli_and_angles_in_other_units_are_said(tmp_path, capsys):
    path = tmp_path / "r.yaml"
    assert new(path, "--tube", INNER.replace("E=52GPa", "E=686GPa"), "--tube", OUTER, *REST) == 0
    data = yaml.safe_load(path.read_text())
    data["rest"]["alpha"]["value"] = [90.0, 0.0]
    path.write_text(yaml.safe_dump(data))
    capsys.readouterr()
    assert cli.main(["robot", "check", str(path), "--no-rest"]) == 0
    err = capsys.readouterr().err
    assert "Young's modulus of tube 1 is 686 GPa" in err
    assert "write 1.5708" in err


def test_shipped_robots_pass_the_check(capsys):
    assert cli.main(["robot", "check", "till2020_tissue", "--no-rest"]) == 0
    captured = capsys.readouterr()
    assert "1.244 x 1.028" in captured.out
    assert captured.err == ""


def test_measured_values():
    assert measured("1 mm ± 10 %", "m", "x") == Measured(0.001, 0.0001)
    assert measured("0 ms +- 1ms", "s", "x") == Measured(0.0, 0.001)
    with pytest.raises(InputError):
        measured("1 mm +- x", "m", "x")
    assert tube_from_text(INNER, 1)[0] == "inner"


def test_tracker_options(tmp_path):
    path = tmp_path / "r.yaml"
    options = [
        "--registration",
        "0 -1 0 0.1; 1 0 0 0.2; 0 0 1 0.3; 0 0 0 1",
        "--mount",
        "0deg, 90deg, 0deg",
        "--axes",
        "xyzrp",
    ]
    assert new(path, "--tube", INNER, "--tube", OUTER, *REST, *options) == 0
    tracker = load_robot(path).tracker
    assert tracker.axes == "xyzrp"
    assert tracker.mount_rotation.value == pytest.approx((0.0, math.pi / 2, 0.0))
    assert tracker.registration_rotation.value == pytest.approx((0.0, 0.0, math.pi / 2), abs=1e-12)
    assert tracker.registration_translation.value == (0.1, 0.2, 0.3)
    assert tracker.registration_rotation.tolerance[0] == pytest.approx(math.radians(0.3))


def test_a_registration_of_other_than_16_numbers_is_refused(tmp_path, capsys):
    assert new(tmp_path / "r.yaml", "--tube", INNER, "--registration", "1 0 0 0") == 2
    assert "4 numbers, expected 16" in capsys.readouterr().err
