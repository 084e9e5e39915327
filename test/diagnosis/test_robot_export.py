"""The exported robot is the fitted one: its plant is that of the forward model at the fit, whatever the file had before."""

import numpy as np
import pytest
import yaml

from ctr_dynamics.diagnosis.forward_model import values_at
from ctr_dynamics.diagnosis.inference.map_fit import Fit
from ctr_dynamics.diagnosis.inference.recalibration import nuisances_of
from ctr_dynamics.diagnosis.output.robot_export import robot_with_fit
from ctr_dynamics.effects import EFFECTS, effect_quantities, make_plant
from ctr_dynamics.robot_files import load_robot, robot_from_dict, robot_to_dict, robot_to_yaml

TISSUE = load_robot("till2020_tissue")


def own_shear(robot):
    """``robot`` with a shear modulus of its own, known to 5 %, for every tube."""
    data = robot_to_dict(robot)
    for tube, known in zip(data["tubes"], robot.tubes, strict=True):
        shear = known.shear.value
        tube["shear_modulus"] = {"value": shear, "unit": "Pa", "tolerance": 0.05 * shear}
    return robot_from_dict(data)


ROBOTS = [TISSUE, load_robot("three_tube"), load_robot("till2020_snap"), own_shear(TISSUE)]
OF_A_RECORDING = {"load_time"}  # stays with the recording, in no robot file
BEFORE = {
    "exposed_length": {"tube1.beta_offset_m": 1e-3},
    "encoder_offset": {"tube1.offset_rad": 0.10},
    "encoder_gain": {"tube2.gain": 1.02},
    "backlash": {"tube1.width_rad": 0.02},
    "drivetrain_compliance": {"tube1.stiffness_Nm_per_rad": 0.4},
    "actuator_latency": {"delay_s": 0.01},
    "insertion_velocity": {"scale": 0.5},
    "clearance": {"play_rad": 0.01},
    "play_kinematics": {"share": 0.2},
    "base_coulomb": {"mu_base": 0.6},
    "base_viscous": {"nu_base": 1e-3},
    "tube_coulomb": {"mu": 0.2},
    "tube_viscous": {"nu": 1e-3},
    "stribeck": {"static_ratio": 1.5},
    "distributed_friction": {"torque_Nm_per_m": 0.02},
    "air_drag": {"linear_Ns_per_m2": 0.1},
    "youngs_modulus": {"tube1.scale": 1.05, "all.scale": 0.98},
    "shear_modulus": {"tube2.scale": 1.1},
    "precurvature": {"tube2.scale": 1.04},
    "density": {"all.scale": 1.07},
    "payload_mass": {"added_kg": 2e-4},
    "payload_inertia": {"scale": 1.2},
    "bending_damping": {"tube2.B_Nm2s": 1e-5},
    "torsion_damping": {"tube1.B_Nm2s": 2e-5},
    "ovality": {"tube1.ratio": 1.2},
    "oval_mean": {"mean": 0.3},
    "softening": {"tube1.curvature_1_per_m": 60.0},
    "gravity_direction": {"rx_rad": 0.03},
    "tip_force": {"Fx_N": 0.02},
    "tip_spring": {"stiffness_N_per_m": 2.0},
    "contact": {"stiffness_N_per_m": 100.0, "offset_m": -0.1},
    "registration_rotation": {"ry_rad": 0.02},
    "registration_translation": {"tz_m": 2e-3},
    "tracker_lever_arm": {"x_m": 1e-3},
    "tracker_latency": {"delay_s": 0.005},
    "tracker_averaging": {"window_s": 0.02},
    "clock_skew": {"rate": 1e-3},
    "tracker_scale": {"scale": 1.005},
    "drift": {"y_m_per_s": 1e-4},
}


def robot_before(extensions, robot=TISSUE):
    """``robot`` with ``extensions`` in its file."""
    return robot_from_dict({**robot_to_dict(robot), "extensions": extensions})


def fit_of(values, causes=()):
    """A fit that stands at ``values`` by quantity."""
    active, count = tuple(values), len(values)
    nothing = np.zeros(0)
    return Fit(
        tuple(causes), active, np.array([values[q] for q in active]), 1e-12 * np.eye(count), 0.0, 0.0, nothing, nothing,
        np.zeros((0, count)), 0.0, 1.0,
    )  # fmt: skip


def away(q, part=0.4):
    """A coordinate inside the bounds of ``q``, off the robot file."""
    return float(np.clip(q.off + part * min(q.scale, q.tolerance or q.scale), q.low, q.high))


def numbers_of(plant):
    """All numbers of a plant by name; precurvature as it is in 1/m."""
    robot, block = plant.robot, plant.block.copy()
    rows = plant.layout["precurvature"]
    curved = [
        f * tube.curvature_at(0.8 * tube.length) for f, tube in zip(block[rows], robot.tubes, strict=True)
    ]
    block[rows] = 0.0
    tracker, drives = plant.tracker, plant.actuators
    out = {
        "block": block,
        "curvature": np.array(curved),
        "force": plant.tip_force,
        "extended": plant.extended,
    }
    for part, names in (
        (tracker, ("rotation", "translation", "lever", "delay", "averaging", "skew", "scale", "drift")),
        (drives, ("gain", "offset", "beta_offset", "backlash", "delay")),
    ):
        out.update({f"{type(part).__name__}.{name}": getattr(part, name) for name in names})
    return out


def assert_same_plant(exported, robot, point):
    there, here = numbers_of(make_plant(exported)), numbers_of(make_plant(robot, values_at(point)))
    for name, wanted in here.items():
        np.testing.assert_allclose(there[name], wanted, rtol=1e-9, atol=1e-15, err_msg=name)


@pytest.mark.parametrize("before", [False, True], ids=["plain file", "file with extensions"])
@pytest.mark.parametrize("name", sorted(set(BEFORE) - {"play_kinematics", "oval_mean"}))
def test_the_plant_of_an_exported_cause_is_the_fitted_one(name, before):
    robot = robot_before(BEFORE if before else {})
    every = effect_quantities(robot)
    causes = [q for q in every if q.effect == name and np.isfinite(q.off)]
    form = [q for q in every if q.effect in EFFECTS[name].form]
    nuisances = [q for q in nuisances_of(robot) if q.effect not in (name, *OF_A_RECORDING)]
    found = fit_of({q: away(q) for q in (*nuisances, *form, *causes)}, causes)
    exported = robot_with_fit(robot, found, "new", "")
    assert exported == robot_from_dict(yaml.safe_load(robot_to_yaml(exported)))
    assert_same_plant(exported, robot, found.point)


@pytest.mark.parametrize("which", range(len(ROBOTS)))
@pytest.mark.parametrize(
    "before", [{}, {"encoder_offset": {"tube2.offset_rad": 0.1}, "shear_modulus": {"tube1.scale": 1.1}}]
)
def test_what_a_calibration_finds_is_in_the_file(which, before):
    """Each quantity with a tolerance by itself, apart from those of a recording."""
    robot = robot_before(before, ROBOTS[which])
    nuisances = nuisances_of(robot)
    assert len(nuisances) > 5
    for q in nuisances:
        found = fit_of({other: away(q) if other is q else other.off for other in nuisances})
        exported = robot_with_fit(robot, found, "new", "")
        moved = {key: value for key, value in found.point.items() if key[0] not in OF_A_RECORDING}
        assert_same_plant(exported, robot, moved)


def test_a_nuisance_of_the_form_goes_with_its_cause_only():
    robot = TISSUE
    known = {q.key: q for q in effect_quantities(robot)}
    play, share = known["clearance", "play_rad"], known["play_kinematics", "share"]
    with_cause = robot_with_fit(robot, fit_of({share: 0.3, play: 0.01}, [play]), "new", "")
    assert with_cause.extensions == {"play_kinematics": {"share": 0.3}, "clearance": {"play_rad": 0.01}}
    assert robot_with_fit(robot, fit_of({share: 0.3}), "new", "").extensions == {}


@pytest.mark.parametrize("tolerance", [0.0, 0.02])
def test_offsets_of_the_file_are_neither_lost_nor_doubled(tolerance):
    data = robot_to_dict(robot_before({"encoder_offset": {"tube1.offset_rad": 0.10}}))
    data["encoders"]["offset"]["tolerance"] = tolerance
    robot = robot_from_dict(data)
    offsets = [q for q in nuisances_of(robot) if q.effect == "encoder_offset"]
    exported = robot_with_fit(
        robot, fit_of({q: 0.02 if q.name == "tube1.offset_rad" else 0.0 for q in offsets}), "new", ""
    )
    assert exported.extensions["encoder_offset"]["tube1.offset_rad"] == pytest.approx(
        0.12 if offsets else 0.10
    )


def test_a_value_that_is_put_starts_from_that_of_the_extension():
    robot = robot_before({"base_coulomb": {"mu_base": 0.6}, "backlash": {"tube1.width_rad": 0.02}})
    known = {q.key: q for q in effect_quantities(robot)}
    assert known["base_coulomb", "mu_base"].off == 0.6
    width = known["backlash", "tube1.width_rad"]
    assert (width.off, width.low, width.one_sided) == (0.0, -0.02, False)
    nominal = {q.key: q.off for q in nuisances_of(robot)}
    assert np.array_equal(make_plant(robot, values_at(nominal)).block, make_plant(robot).block)


def test_a_point_means_the_same_in_any_order():
    point = {("registration_translation", "tx_m"): 1e-2, ("registration_rotation", "rz_rad"): 0.3}
    one, other = (
        make_plant(TISSUE, values_at(dict(items))).tracker.translation
        for items in (point.items(), reversed(point.items()))
    )
    assert np.array_equal(one, other)
    assert one[0] == 1e-2  # the shift is along the tracker's axes
