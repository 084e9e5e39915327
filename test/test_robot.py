"""Robots: the shipped files against the paper's tables, and every refusal with its one clear line."""

import copy
import math
from importlib import resources

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from ctr_dynamics.errors import InputError
from ctr_dynamics.parameters import Settings
from ctr_dynamics.robot_files import (
    load_robot,
    robot_from_dict,
    robot_names,
    robot_quantities,
    robot_to_dict,
    robot_to_yaml,
    robot_with,
)
from ctr_dynamics.sensing.checks.actuator_motion import ActuatorMotion
from ctr_dynamics.sensing.checks.check_limits import CheckLimits
from ctr_dynamics.sensing.tracker_parameters import with_robot_file

DEG = math.pi / 180


@pytest.fixture
def tissue():
    """Contents of the tissue robot's file, to be spoiled."""
    return copy.deepcopy(robot_to_dict(load_robot("till2020_tissue")))


def refusal(data) -> str:
    with pytest.raises(InputError) as caught:
        robot_from_dict(data, "robot.yaml")
    message = str(caught.value)
    assert "\n" not in message
    assert message.startswith("robot.yaml: ")
    return message


# --- the shipped robots -------------------------------------------------------------------------------------


def test_four_robots_are_shipped():
    assert robot_names() == ("three_tube", "till2020_snap", "till2020_snap_example", "till2020_tissue")
    for name in robot_names():
        robot = load_robot(name)
        assert robot.name == name
        assert robot.source == name
        assert len(robot.sha256) == 64


def test_tissue_robot_has_the_values_of_table_iii():
    robot = load_robot("till2020_tissue")
    inner, outer = robot.tubes
    assert (inner.inner_radius.value, inner.outer_radius.value) == (0.514e-3, 0.622e-3)
    assert (outer.inner_radius.value, outer.outer_radius.value) == (0.800e-3, 1.03e-3)
    assert (inner.youngs_modulus.value, outer.youngs_modulus.value) == (52e9, 75e9)
    assert (inner.density.value, outer.density.value) == (6493.0, 6493.0)
    np.testing.assert_allclose(inner.breakpoints, [0, 0.301, 0.3981])
    np.testing.assert_allclose(outer.breakpoints, [0, 0.2, 0.2845])
    np.testing.assert_array_equal(inner.curvature_at(0.35), [9.174, 0, 0])
    np.testing.assert_array_equal(outer.curvature_at(0.25), [10.075, 0, 0])
    np.testing.assert_array_equal(outer.curvature_at(0.1), [0, 0, 0])
    assert robot.rest.beta.value == (-0.2521, -0.1977)
    assert robot.rest.alpha.value == (math.pi / 2, math.pi / 2)
    friction = robot.friction
    assert (friction.tubes.coulomb.value, friction.tubes.viscous.value) == (0.00323, 1.16e-7)
    assert (friction.base.coulomb.value, friction.base.viscous.value) == (1.09, 73.9e-7)
    assert friction.epsilon.value == 15.0
    assert robot.gravity.value == (0.0, -9.81, 0.0)


def test_tissue_robot_carries_its_tolerances():
    robot = load_robot("till2020_tissue")
    for tube in robot.tubes:
        assert tube.youngs_modulus.relative == pytest.approx(0.004)
        assert tube.shear.relative == pytest.approx(0.004)
        assert tube.density.relative == pytest.approx(0.005)
        assert tube.precurvature_tolerance == pytest.approx(0.003)
    assert robot.tubes[0].end_body.mass.tolerance == pytest.approx(20e-6)
    assert robot.friction.base.coulomb.relative == pytest.approx(0.10)
    assert robot.friction.base.viscous.relative == pytest.approx(0.20)
    assert robot.friction.tubes.coulomb.relative == pytest.approx(0.20)
    assert robot.friction.tubes.viscous.relative == pytest.approx(0.20)
    assert robot.encoders.offset.tolerance == pytest.approx(0.1 * DEG)
    tracker = robot.tracker
    assert tracker.registration_rotation.tolerance == pytest.approx((0.11 * DEG,) * 3)
    assert tracker.registration_translation.tolerance == pytest.approx((0.2e-3,) * 3)
    assert tracker.lever_arm.tolerance == pytest.approx((0.2e-3,) * 3)
    assert tracker.delay.tolerance == pytest.approx(1e-3)
    assert robot.gravity.direction_tolerance == pytest.approx(0.2 * DEG)
    noise = tracker.noise
    assert (noise.position.value, noise.drift.value, noise.drift_time.value) == (0.35e-3, 0.08e-3, 2.0)
    assert noise.rotation.value == pytest.approx(0.3 * DEG)
    assert robot.encoders.noise.value == pytest.approx(0.02 * DEG / math.sqrt(3))


def test_payload_is_the_printed_sphere_and_its_doubt_is_named():
    body = load_robot("till2020_tissue").tubes[0].end_body
    assert body.mass.value == 8e-3
    assert body.inertia.value == pytest.approx((0.4 * 8e-3 * 24.7e-3**2,) * 3, rel=1e-6)
    text = (resources.files("ctr_dynamics") / "config/robots/till2020_tissue.yaml").read_text()
    assert "24.7 mm is plausibly the diameter" in text


def test_snap_robot_has_the_values_of_table_ii():
    robot = load_robot("till2020_snap")
    inner, outer = robot.tubes
    np.testing.assert_allclose(inner.breakpoints, [0, 0.1211, 0.1551, 0.1671])
    np.testing.assert_allclose(outer.breakpoints, [0, 0.0081, 0.0531])
    np.testing.assert_array_equal(inner.curvature_at(0.13), [38.8, 0, 0])
    np.testing.assert_array_equal(inner.curvature_at(0.16), [0, 0, 0])
    assert outer.curvature_at(0.02)[0] == 8.7
    assert (inner.youngs_modulus.value, outer.youngs_modulus.value) == (81.97e9, 210e9)
    assert robot.rest.beta.value == (-0.112, 0.0)
    assert robot.friction.epsilon.value == 250.0
    assert robot.friction.tubes.coulomb.value == 0.00323
    assert robot.friction.base.coulomb.value == robot.friction.base.viscous.value == 0.0


@pytest.mark.parametrize("name", ["till2020_snap", "till2020_snap_example"])
def test_snap_markers_are_discs_with_glue(name):
    robot = load_robot(name)
    sizes = [(0.0278e-3, 2.73e-3, 1.13e-3), (0.0714e-3, 4.46e-3, 1.09e-3)]
    for tube, (mass, radius, thickness) in zip(robot.tubes, sizes, strict=True):
        m, ro = mass + 0.02e-3, tube.outer_radius.value
        across = m * (3 * (radius**2 + ro**2) + thickness**2) / 12
        assert tube.end_body.mass.value == pytest.approx(m, rel=1e-9)
        along = m * (radius**2 + ro**2) / 2
        assert tube.end_body.inertia.value == pytest.approx((across, across, along), rel=1e-6)


def test_snap_example_breakpoints_are_as_published():
    robot = load_robot("till2020_snap_example")
    inner, outer = robot.tubes
    # Base-plate coordinates: beta is taken off the inner tube's own arc length.
    np.testing.assert_allclose(inner.breakpoints[1:] - 0.112, [7.97e-3, 43.6e-3, 55.1e-3], atol=1e-12)
    np.testing.assert_allclose(outer.breakpoints, [0, 13.2e-3, 53.1e-3])
    assert inner.curvature_at(0.13)[0] == 37.12
    assert outer.curvature_at(0.02)[0] == 8.72
    assert robot.friction.tubes.coulomb.value == 0.008
    assert robot.friction.epsilon.value == 300.0
    assert all(tube.youngs_modulus.tolerance == 0 for tube in robot.tubes)


def test_three_tube_robot():
    robot = load_robot("three_tube")
    np.testing.assert_allclose(robot.lengths, [0.463, 0.3305, 0.199])
    assert [tube.curvature_at(tube.length - 0.01)[0] for tube in robot.tubes] == [10.0, 5.0, 7.0]


# --- derived numbers ----------------------------------------------------------------------------------------


def test_section_properties_of_a_tube():
    tube = load_robot("till2020_tissue").tubes[0]
    ro, ri = 0.622e-3, 0.514e-3
    assert tube.area == pytest.approx(math.pi * (ro**2 - ri**2))
    assert tube.second_moment == pytest.approx(math.pi * (ro**4 - ri**4) / 4)
    assert tube.bending_stiffness == pytest.approx(52e9 * tube.second_moment)
    assert tube.torsion_stiffness == pytest.approx(2 * tube.second_moment * 52e9 / 2.6)


def test_polynomial_precurvature_is_in_arc_length_from_the_segments_start(tissue):
    poly = {"value": [[1.0, 20.0, 300.0], [0.0, 0.0, 0.0], [0.5, 0.0, 0.0]], "unit": "1/m"}
    segments = tissue["tubes"][1]["precurvature"]
    segments[1] = {"length": segments[1]["length"], "curvature_polynomial": poly}
    tube = robot_from_dict(tissue).tubes[1]
    s = 0.05
    np.testing.assert_allclose(tube.curvature_at(0.2 + s), [1 + 20 * s + 300 * s**2, 0, 0.5])
    assert tube.precurvature[1].coefficients.shape == (3, 3)
    assert tube.precurvature[0].coefficients.shape == (3, 1)


def test_shear_modulus_follows_youngs_unless_given(tissue):
    robot = robot_from_dict(tissue)
    softer = robot_with(robot, {"tubes[0].youngs_modulus": 26e9})
    assert softer.tubes[0].shear.value == pytest.approx(10e9)
    tissue["tubes"][0]["shear_modulus"] = {"value": 18e9, "unit": "Pa", "tolerance_percent": 2}
    given = robot_with(robot_from_dict(tissue), {"tubes[0].youngs_modulus": 26e9}).tubes[0]
    assert given.shear.value == 18e9
    assert given.shear.tolerance == pytest.approx(0.36e9)
    assert not given.shear_follows_youngs


def test_yaml_text_of_a_robot_loads_as_an_equal_robot(tmp_path):
    for name in robot_names():
        robot = load_robot(name)
        file = tmp_path / f"{name}.yaml"
        file.write_text(robot_to_yaml(robot))
        assert load_robot(file) == robot


def test_robot_with_changes_only_what_is_named():
    robot = load_robot("three_tube")
    changed = robot_with(robot, {"friction.base.coulomb": 0.7, "tracker.lever_arm": [0, 0, 0.0025]})
    before, after = robot_quantities(robot), robot_quantities(changed)
    assert before.keys() == after.keys()
    differ = {path for path in before if before[path] != after[path]}
    assert differ == {"friction.base.coulomb", "tracker.lever_arm"}
    with pytest.raises(InputError, match="names no quantity"):
        robot_with(robot, {"tubes[7].density": 1.0})


# --- refusals -----------------------------------------------------------------------------------------------


def test_unknown_robot_names_the_shipped_ones():
    with pytest.raises(InputError, match=r"till2020_tisue.*did you mean 'till2020_tissue'"):
        load_robot("till2020_tisue")


def test_a_tube_of_300_m_is_rejected_as_a_unit_error(tissue):
    tissue["tubes"][0]["precurvature"][0]["length"]["value"] = 301
    message = refusal(tissue)
    assert "tubes[0].precurvature[0].length" in message
    assert "301 m is outside (0, 2] m" in message
    assert "divided by 1000" in message


def set_path(data, path, value):
    *way, last = path
    for key in way:
        data = data[key]
    if value is None:
        del data[last]
    else:
        data[last] = value


@pytest.mark.parametrize(
    ("path", "value", "parts"),
    [
        (
            ("tubes", 0, "precurvature", 0, "length", "unit"),
            "mm",
            ["unit 'mm' must be 'm'", "value: 0.000301"],
        ),
        (("tubes", 0, "youngs_modulus", "unit"), "GPa", ["unit 'GPa' must be 'Pa'"]),
        (("tubes", 0, "youngs_modulus", "value"), 52.0, ["52 Pa is outside", "GPa is multiplied by 1e9"]),
        (("tubes", 0, "density"), 6493.0, ["tubes[0].density", "carries no unit", "kg/m^3"]),
        (("tubes", 0, "density", "value"), 6.493, ["6.493 kg/m^3 is outside"]),
        (("tubes", 0, "density", "value"), "heavy", ["'heavy' is not a number"]),
        (("tubes", 0, "density", "value"), True, ["True is not a number"]),
        (("tubes", 0, "density", "value"), math.nan, ["nan is not finite"]),
        (("tubes", 0, "density", "value"), math.inf, ["inf is not finite"]),
        (("tubes", 0, "density", "value"), 10**400, ["tubes[0].density", "larger than"]),
        (("tubes", 0, "density", "tolerance"), -1.0, ["tolerance -1 is negative"]),
        (("tubes", 0, "density", "tolerance_percent"), 5, ["both tolerance and tolerance_percent"]),
        (("tubes", 0, "density"), None, ["tubes[0]", "key 'density' is missing"]),
        (("tubes", 0, "densty"), 1.0, ["unknown key 'densty'", "did you mean 'density'"]),
        (
            ("tubes", 0, "inner_radius", "value"),
            0.000622,
            ["inner_radius 0.000622 m is not below outer_radius"],
        ),
        (
            ("tubes", 1, "inner_radius", "value"),
            0.0005,
            ["tubes[1].inner_radius 0.0005 m does not fit around"],
        ),
        (("tubes", 1, "name"), "inner", ["not all different"]),
        (("tubes",), [], ["tubes"]),
        (("tubes", 0, "precurvature"), [], ["tubes[0].precurvature"]),
        (("tubes", 0, "precurvature", 1, "curvature", "value"), [9.0, 0.0], ["three components"]),
        (("tubes", 0, "precurvature", 1, "curvature", "value"), [9174.0, 0, 0], ["9174 1/m is outside"]),
        (
            ("tubes", 1, "precurvature", 1, "curvature", "value"),
            [980.0, 0, 0],
            ["tighter than the outer radius"],
        ),
        (("tubes", 0, "precurvature", 1, "curvature"), None, ["either curvature or curvature_polynomial"]),
        (("tubes", 0, "end_body", "mass", "value"), 8.0, ["8 kg is outside [0, 1] kg"]),
        (
            ("tubes", 0, "end_body", "inertia", "value"),
            [1e-6, -1e-6, 1e-6],
            ["-1e-06 kg m^2 is outside", "must not be negative"],
        ),
        (
            ("tubes", 0, "outer_radius", "value"),
            -6.22e-4,
            ["-0.000622 m is outside (0, 0.05] m; it must be positive"],
        ),
        (("friction", "epsilon", "value"), 0.0, ["0 rad/s is outside (0, 100000] rad/s"]),
        (("friction", "base", "coulomb", "unit"), "N", ["unit 'N' must be '1'"]),
        (("gravity", "value"), [0, -9810.0, 0], ["gravity is 9810 m/s^2"]),
        (("gravity", "unit"), "g", ["gravity: unit 'g' must be 'm/s^2'"]),
        (("gravity", "direction_tolerance"), 11.0, ["direction_tolerance 11 rad"]),
        (("encoders", "offset", "unit"), "deg", ["unit 'deg' must be 'rad'"]),
        (("tracker", "delay", "value"), 20.0, ["20 s is outside [-1, 1] s"]),
        (("rest", "beta", "value"), [-0.19, -0.2], ["beta[0] = -0.19 m lies before beta[1] = -0.2 m"]),
        (("rest", "beta", "value"), [-0.2521, 0.01], ["beta[1] = 0.01 m is above 0 m"]),
        (("rest", "beta", "value"), [-252.1, -197.7], ["wholly behind the base plate", "give metres"]),
        (("rest", "beta", "value"), [-0.25, -0.1], ["beyond tube 1's"]),
        (("rest", "beta", "value"), [-0.2521], ["rest.beta has 1 numbers for 2 tubes"]),
        (("rest", "beta", "unit"), "mm", ["beta unit 'mm' must be 'm'"]),
        (("extensions",), {"wormhole": {"x": 1.0}}, ["unknown extension 'wormhole'"]),
        (("friction",), 3, ["friction: 3 is not a mapping"]),
    ],
)
def test_rejections_say_where_what_and_what_to_do(tissue, path, value, parts):
    set_path(tissue, path, value)
    message = refusal(tissue)
    for part in parts:
        assert part in message


def test_number_of_further_errors_is_told(tissue):
    tissue["tubes"][0]["density"]["value"] = 1.0
    tissue["friction"]["epsilon"]["value"] = -1.0
    assert refusal(tissue).endswith("(and 1 more)")


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("", "is empty"),
        ("- 1\n", "is a list"),
        ("name: [\n", "not valid YAML in line 2"),
        ("name: a\nname: b\n", "key 'name' is given twice"),
        ("name: {{ robot }}\n", "a key must be a word"),
        ("? [a, b]\n: 1\n", "a key must be a word"),
        ("name: !!python/object:os.system x\n", "not valid YAML"),
        ("name: 2001-99-99\n", "not valid YAML"),
    ],
)
def test_broken_files_are_one_line(tmp_path, text, part):
    file = tmp_path / "robot.yaml"
    file.write_text(text)
    with pytest.raises(InputError, match=part) as caught:
        load_robot(file)
    assert "\n" not in str(caught.value)
    assert str(file) in str(caught.value)


def test_binary_file_is_rejected(tmp_path):
    file = tmp_path / "robot.yaml"
    file.write_bytes(b"\x89MCAP0\r\n\xff")
    with pytest.raises(InputError, match="not UTF-8"):
        load_robot(file)
    with pytest.raises(InputError, match="is a folder"):
        load_robot(tmp_path)


def test_numbers_of_yaml_1_1_and_1_2_are_read(tmp_path):
    text = (resources.files("ctr_dynamics") / "config/robots/till2020_tissue.yaml").read_text()
    file = tmp_path / "robot.yaml"
    file.write_text(text.replace("52.0e+9", "52e9").replace("2.0e-05", "2E-5"))
    assert "52e9" in file.read_text()
    assert load_robot(file) == load_robot("till2020_tissue")


@pytest.mark.parametrize("name", robot_names())
def test_shipped_files_read_the_same_with_any_yaml_reader(name):
    # YAML 1.1 readers take 52e9 for text: the shipped files write every number so that all agree.
    text = (resources.files("ctr_dynamics") / f"config/robots/{name}.yaml").read_text()
    assert robot_from_dict(yaml.safe_load(text)) == load_robot(name)


# --- actuators ----------------------------------------------------------------------------------------------


def test_actuator_problem():
    robot = load_robot("till2020_tissue")
    assert robot.actuator_problem([-0.2521, -0.1977], [0.0, 7.0]) is None
    assert "not finite" in robot.actuator_problem([-0.2521, math.nan])
    assert "not finite" in robot.actuator_problem([-0.2521, -0.1977], [0.0, math.inf])
    assert "one per tube" in robot.actuator_problem([-0.1])
    # Flush tube ends are allowed in spite of rounding.
    assert robot.actuator_problem([-0.3981 + 0.1, -0.2845 + 0.1]) is None


# --- extensions ---------------------------------------------------------------------------------------------


def test_extensions_of_the_catalogue_are_taken_and_checked(tissue):
    tissue["extensions"] = {"youngs_modulus": {"tube2.scale": 1.05}, "clearance": {"play_rad": 0.003}}
    assert robot_from_dict(tissue).extensions["youngs_modulus"]["tube2.scale"] == 1.05
    for values, words in (
        ({"clearence": {"play_rad": 0.003}}, ["unknown extension 'clearence'", "did you mean 'clearance'?"]),
        ({"wormhole": {}}, ["unknown extension 'wormhole'", "known extensions: ", "tip_spring"]),
        ({"youngs_modulus": {"tubeN.scale": 1.0}}, ["no parameter 'tubeN.scale'", "tubeN.scale, all.scale"]),
        ({"youngs_modulus": {"tube3.scale": 1.0}}, ["'tube3.scale'", "2 tubes"]),
        ({"youngs_modulus": {"all.scale": "1.1"}}, ["'1.1' is not a number"]),
        ({"clearance": {"play_rad": math.nan}}, ["not finite"]),
        ({"clearance": {"play_rad": -0.003}}, ["'play_rad' is -0.003 rad", "between 0 and inf"]),
        ({"ovality": {"tube1.ratio": 0.2}}, ["'tube1.ratio' is 0.2 1", "between 1 and inf"]),
        ({"softening": {"tube1.curvature_1_per_m": 0.0}}, ["must be above 0", "leave it out"]),
        ({"drivetrain_compliance": {"tube1.stiffness_Nm_per_rad": math.inf}}, ["not finite"]),
    ):
        tissue["extensions"] = values
        message = refusal(tissue)
        for word in words:
            assert word in message


# --- tracker and actuators of a lab ---------------------------------------------------------------------------


def matrix_of(vector, translation):
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = Rotation.from_rotvec(vector).as_matrix(), translation
    return motion.tolist()


def test_a_registration_may_be_a_matrix(tissue):
    vector, translation = [0.1, -0.7, 2.0], [0.08, -0.12, 0.25]
    tracker = tissue["tracker"]
    for part in ("rotation", "translation"):
        del tracker[f"registration_{part}"]
    matrix = matrix_of(vector, translation)
    tracker["registration"] = {"value": matrix, "unit": "m", "tolerance": 5e-4, "rotation_tolerance": 0.01}
    found = robot_from_dict(tissue).tracker
    np.testing.assert_allclose(found.registration_rotation.value, vector, atol=1e-12)
    np.testing.assert_allclose(found.registration_translation.value, translation)
    assert found.registration_rotation.tolerance == (0.01,) * 3
    assert found.registration_translation.tolerance == (5e-4,) * 3
    again = robot_from_dict(yaml.safe_load(robot_to_yaml(robot_from_dict(tissue))))
    assert again.tracker == found


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda m: m.pop(), "four rows of four numbers"),
        (lambda m: m[0].append(0.0), "four rows of four numbers"),
        (lambda m: m[1].__setitem__(1, 2.0), "no rigid motion"),
        (lambda m: m[0].__setitem__(slice(0, 3), [-v for v in m[0][:3]]), "no rigid motion"),  # a reflection
        (lambda m: m[3].__setitem__(0, 1.0), "no rigid motion"),
        (lambda m: m[2].__setitem__(3, "far"), "is not a number"),
    ],
)
def test_a_matrix_that_is_no_registration_is_refused(tissue, spoil, words):
    matrix = matrix_of([0.1, 0.2, 0.3], [0.0, 0.0, 0.1])
    spoil(matrix)
    tracker = tissue["tracker"]
    for part in ("rotation", "translation"):
        del tracker[f"registration_{part}"]
    tracker["registration"] = {"value": matrix, "unit": "m"}
    assert words in refusal(tissue)


def test_a_registration_is_given_once_and_in_metres(tissue):
    tissue["tracker"]["registration"] = {"value": np.eye(4).tolist(), "unit": "m"}
    assert "both registration and registration_rotation are given" in refusal(tissue)
    for part in ("rotation", "translation"):
        del tissue["tracker"][f"registration_{part}"]
    tissue["tracker"]["registration"]["unit"] = "mm"
    assert "unit 'mm' must be 'm'" in refusal(tissue)


def test_axes_mount_and_speeds(tissue):
    tissue["tracker"]["axes"] = "xyzrp"
    tissue["tracker"]["mount_rotation"] = {"value": [0.0, 1.5, 0.0], "unit": "rad"}
    tissue["actuators"] = {"rotation_speed": {"value": 6.0, "unit": "rad/s"}}
    robot = robot_from_dict(tissue)
    assert robot_from_dict(yaml.safe_load(robot_to_yaml(robot))) == robot
    settings = with_robot_file(Settings(), robot)
    assert settings["tracker.axes"] == "xyzrp"
    assert settings["tracker.mount_rotation_rad"] == (0.0, 1.5, 0.0)
    assert with_robot_file(settings, robot) == settings
    assert with_robot_file(Settings({"tracker.axes": "xyz"}), robot)["tracker.axes"] == "xyz"
    told = {"tracker.axes": "xyzrpy", "tracker.mount_rotation_rad": (0.0, 0.0, 0.0)}
    assert with_robot_file(Settings(told), robot) == Settings(), "the defaults, but set"
    motion = ActuatorMotion(2, CheckLimits(), robot)
    assert motion.speeds == (6.0, 6.0, CheckLimits().translation_speed, CheckLimits().translation_speed)
    tissue["tracker"]["axes"] = "zyx"
    assert "'zyx' is not a subset of 'xyzrpy'" in refusal(tissue)
