"""The catalogue against its contract, and what it must not do: change anything at its off-values."""

import copy
import json
import math
import re
from pathlib import Path

import numpy as np
import pytest

from ctr_dynamics.effects import EFFECTS, Plant, apply_effects, effect_quantities, make_plant
from ctr_dynamics.effects.plant import same
from ctr_dynamics.errors import InputError
from ctr_dynamics.model.model import Model
from ctr_dynamics.model.simulator import Inputs, Simulator
from ctr_dynamics.model.time_scheme import make_scheme
from ctr_dynamics.robot_files import load_robot, robot_from_dict, robot_to_dict

CONTRACT = json.loads((Path(__file__).parents[1] / "data/effects/parameters.json").read_text())["effects"]
COMPUTATION = {
    "time_discretisation",
    "space_discretisation",
    "config_mistake",
}  # no physics, not in the catalogue
ROBOT = load_robot("till2020_tissue")


def extended_robot(extensions):
    """The tissue robot with ``extensions`` in its file."""
    data = copy.deepcopy(robot_to_dict(ROBOT))
    data["extensions"] = extensions
    return robot_from_dict(data)


def off_values(effect):
    """Off-values of an effect by name, as a robot file can hold them: those that are not finite are left out."""
    found = {}
    for p in effect.parameters:
        for tube in range(ROBOT.n_tubes) if p.name.startswith("tubeN") else [0]:
            value = p.off(ROBOT, tube) if callable(p.off) else p.off
            if math.isfinite(value):
                found[p.name.replace("tubeN", f"tube{tube + 1}")] = float(value)
    return found


def same_plants(a: Plant, b: Plant) -> bool:
    """Whether two plants hold the same bits."""
    return (
        same(a.block, b.block)
        and same(a.tracker, b.tracker)
        and a.has_inputs_of(b)
        and a.extended == b.extended
    )


def test_ids_and_parameter_names_are_those_of_the_contract():
    catalogue = {name for name, effect in EFFECTS.items() if not effect.nuisance}
    assert catalogue >= set(CONTRACT) - COMPUTATION
    for name in set(CONTRACT) - COMPUTATION:
        assert {p.name for p in EFFECTS[name].parameters} == set(CONTRACT[name]["params"]), name


@pytest.mark.parametrize("name", sorted(set(CONTRACT) - COMPUTATION))
def test_units_and_off_values_are_those_of_the_contract(name):
    entry, effect = CONTRACT[name], EFFECTS[name]
    units = [re.sub(r"\s*(\(absolute\)|, base axes|, tip frame|unit normal)", "", entry["unit"])]
    units = [re.sub(r"^unit normal$", "", u).strip() for u in units[0].split(",")]
    offs = entry["off"] if isinstance(entry["off"], list) else [entry["off"]]
    by_name = {p.name: p for p in effect.parameters}
    for i, param in enumerate(entry["params"]):
        p = by_name[param]
        if param in ("nx", "ny", "nz"):
            assert p.unit == "1"
        elif param == "offset_m":
            assert p.unit == "m"
        else:
            assert p.unit == units[min(i, len(units) - 1)], param
        off = offs[min(i, len(offs) - 1)]
        if off == "any":
            assert p.shape
        elif off == "robot file":
            assert callable(p.off)
        elif off == "infinite":
            assert p.off == math.inf
            assert p.power < 0
        else:
            assert p.off == off, param


@pytest.mark.parametrize("name", sorted(EFFECTS))
def test_off_values_leave_every_bit_of_the_plant(name):
    plain, changed = make_plant(ROBOT), make_plant(ROBOT)
    for values in ({}, off_values(EFFECTS[name])):
        apply_effects(changed, {name: values})
        assert same_plants(changed, plain)
    assert not changed.extended


@pytest.mark.parametrize("name", sorted(EFFECTS))
def test_bounds_priors_and_descriptions_are_sane(name):
    effect = EFFECTS[name]
    assert effect.text.endswith(".")
    assert effect.source
    for p in effect.parameters:
        assert p.text
        off = p.coordinate(float(p.off(ROBOT, 0) if callable(p.off) else p.off))
        assert p.low <= off <= p.high or (p.shape and not math.isfinite(off)), p.name
        scale = float(p.scale(ROBOT, 0) if callable(p.scale) else p.scale)
        assert 0.0 < scale < math.inf, p.name
        for coordinate in (max(off, p.low) + 0.7 * scale, max(off, p.low) + 2.0 * scale):
            if math.isfinite(coordinate):
                assert p.coordinate(p.value(coordinate)) == pytest.approx(coordinate, rel=1e-12)
    for preset in effect.presets:
        for parameter in preset:
            shapes = [p for p in effect.parameters if p.shape]
            forms = [p for form in effect.form for p in EFFECTS[form].parameters]
            assert any(p.name.replace("tubeN.", "") == parameter for p in shapes + forms)
    assert not effect.finite_sizes or sum(not p.shape for p in effect.parameters) == 1  # a size of one number


@pytest.mark.parametrize("name", sorted(EFFECTS))
def test_one_scale_away_from_off_every_parameter_acts(name):
    """A parameter that changes nothing would be found nowhere. Shapes act when their effect is on, and what is uncertain in its form likewise."""
    effect = EFFECTS[name]
    host = next((e.name for e in EFFECTS.values() if name in e.form), "")
    data = copy.deepcopy(robot_to_dict(ROBOT))
    data["gravity"]["value"] = [2.0, -9.0, 3.0]  # a turn about gravity's own axis does nothing
    robot = robot_from_dict(data)
    strengths = [q for q in effect_quantities(ROBOT) if q.effect == name and not q.parameter.shape]
    assert strengths

    def away(chosen):
        return {chosen.effect: {chosen.name: chosen.parameter.value(chosen.off + chosen.scale)}}

    on = next((away(q) for q in effect_quantities(ROBOT) if q.effect == host), {})
    for q in strengths:
        plant, without = make_plant(robot), make_plant(robot)
        apply_effects(without, on)
        apply_effects(plant, {**on, **away(q)})
        assert not same_plants(plant, without), q.name
        assert plant.extended == (bool(on) or (effect.extended and not effect.nuisance)), q.name


SIGNS = {
    "exposed_length": ("tube2.beta_offset_m", 2e-3, lambda s: s.actuators.beta_offset[1] == 2e-3),
    "encoder_offset": (
        "tube1.offset_rad",
        0.03,
        lambda s: s.actuators.offset[0] == ROBOT.encoders.offset.value + 0.03,
    ),
    "encoder_gain": ("tube1.gain", 1.02, lambda s: s.actuators.gain[0] == 1.02),
    "backlash": ("tube2.width_rad", 0.04, lambda s: s.actuators.backlash[1] == 0.04),
    "actuator_latency": ("delay_s", 0.02, lambda s: s.actuators.delay == 0.02),
    "tracker_latency": ("delay_s", 0.02, lambda s: s.tracker.delay == ROBOT.tracker.delay.value + 0.02),
    "tracker_scale": ("scale", 1.01, lambda s: s.tracker.scale == 1.01),
    "clock_skew": ("rate", 1e-4, lambda s: s.tracker.skew == 1e-4),
    "payload_mass": (
        "added_kg",
        2e-3,
        lambda s: np.isclose(s.block[s.layout["body_mass"]][0], ROBOT.tubes[0].end_body.mass.value + 2e-3),
    ),
    "tip_force": ("Fy_N", -0.1, lambda s: s.tip_force[1] == -0.1),
    "drivetrain_compliance": (
        "tube1.stiffness_Nm_per_rad",
        4.0,
        lambda s: s.block[s.layout["drive_compliance"]][0] == 0.25,
    ),
    "stribeck": ("static_ratio", 1.5, lambda s: s.block[s.layout["stribeck_excess"]][0] == 0.5),
    "base_coulomb": ("mu_base", 0.3, lambda s: s.block[s.layout["base_coulomb"]][0] == 0.3),
    # a turn by +90 degrees about base x takes gravity from -y to -z, and a point on +y to +z
    "gravity_direction": (
        "rx_rad",
        math.pi / 2,
        lambda s: np.allclose(s.block[s.layout["gravity"]], [0.0, 0.0, -9.81], atol=0.01),
    ),
    "registration_rotation": (
        "rx_rad",
        math.pi / 2,
        lambda s: np.allclose(s.tracker.rotation, [math.sqrt(0.5), math.sqrt(0.5), 0, 0]),
    ),
    "registration_translation": ("tz_m", 1e-3, lambda s: s.tracker.translation[2] == 1e-3),
    "tracker_lever_arm": (
        "x_m",
        1e-3,
        lambda s: s.tracker.lever[0] == ROBOT.tracker.lever_arm.value[0] + 1e-3,
    ),
}


@pytest.mark.parametrize("name", sorted(SIGNS))
def test_signs(name):
    parameter, value, holds = SIGNS[name]
    assert holds(Model(extended_robot({name: {parameter: value}}), nodes=12).plant)


def test_only_physics_asks_for_the_extended_kernels():
    assert Model(extended_robot({"clearance": {"play_rad": 0.01}}), nodes=12).extended
    assert not Model(
        extended_robot({"clearance": {"play_rad": 0.0}, "encoder_gain": {"tube1.gain": 1.1}}), nodes=12
    ).extended


def test_a_robot_file_with_every_effect_at_its_off_value_simulates_bit_for_bit_as_without():
    values = {name: off_values(effect) for name, effect in EFFECTS.items()}
    tips = []
    for robot in (ROBOT, extended_robot(values)):
        model = Model(robot, nodes=12)
        assert not model.extended
        simulator = Simulator(model, make_scheme("sdirk3", 0.003))
        beta, still = np.array(robot.rest.beta.value), np.zeros(2)

        def inputs(t, beta=beta, still=still):
            return Inputs(np.array([1.5 + 2.0 * t, 1.5]), np.array([2.0, 0.0]), beta, still)

        state = simulator.rest(inputs(0.0))
        for k in range(20):
            assert simulator.step(state, k * 0.003, inputs).ok
        tips.append(state.nodes.copy())
    assert np.array_equal(tips[0], tips[1])


@pytest.mark.parametrize("name", ["till2020_tissue", "three_tube"])
def test_no_robot_carries_less_than_nothing(name):
    """A negative mass would push where it is pulled, and no solver follows that."""
    robot = load_robot(name)
    body = robot.tubes[0].end_body
    carried = body.mass.value if body else 0.0
    quantity = next(q for q in effect_quantities(robot) if q.key == ("payload_mass", "added_kg"))
    assert quantity.low == -carried
    assert quantity.one_sided == (carried == 0.0)
    with pytest.raises(InputError, match=r"must lie between"):
        robot_from_dict(
            {**robot_to_dict(robot), "extensions": {"payload_mass": {"added_kg": -carried - 1e-4}}}
        )


@pytest.mark.parametrize(
    ("effect", "field", "names"),
    [
        ("registration_rotation", "registration_rotation", ("rx_rad", "ry_rad", "rz_rad")),
        ("registration_translation", "registration_translation", ("tx_m", "ty_m", "tz_m")),
        ("tracker_lever_arm", "lever_arm", ("x_m", "y_m", "z_m")),
    ],
)
def test_axes_of_the_tracker_have_tolerances_of_their_own(effect, field, names):
    data = copy.deepcopy(robot_to_dict(ROBOT))
    stated = [1e-3, 0.0, 3e-3]
    data["tracker"][field]["tolerance"] = stated
    tolerances = {q.key: q.tolerance for q in effect_quantities(robot_from_dict(data))}
    assert [tolerances[effect, name] for name in names] == stated
