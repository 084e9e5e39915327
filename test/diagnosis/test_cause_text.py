"""Sentences of causes: part, value, what the file has, change, interval and its level."""

import pytest

from ctr_dynamics.diagnosis.output.cause_text import cause_text
from ctr_dynamics.effects import effect_quantities
from ctr_dynamics.robot_files import load_robot, robot_from_dict, robot_to_dict

TISSUE = load_robot("till2020_tissue")


def entry(value, low, high, unit, nominal):
    return {"value": value, "ci90": [low, high], "unit": unit, "nominal": nominal}


@pytest.mark.parametrize(
    ("effect", "parameters", "text"),
    [
        (
            "youngs_modulus",
            {"tube2.scale": entry(0.92, 0.9, 0.94, "1", 1.0)},
            "outer tube: E = 69 GPa instead of 75 (-8 %), 90 % interval 67.5 to 70.5",
        ),
        (
            "youngs_modulus",
            {"all.scale": entry(1.05, 1.0, 1.1, "1", 1.0)},
            "all tubes: factor on the youngs modulus = 1.05 instead of 1 (+5 %), 90 % interval 1 to 1.1",
        ),
        (
            "payload_mass",
            {"added_kg": entry(4e-4, 3e-4, 5e-4, "kg", 0.0)},
            "payload mass, added = 0.4 g instead of 0, 90 % interval 0.3 to 0.5",
        ),
        (
            "tracker_latency",
            {"delay_s": entry(0.0202, 0.02, 0.0204, "s", 0.0)},
            "tracker latency, delay = 20.2 ms instead of 0, 90 % interval 20 to 20.4",
        ),
        (
            "encoder_offset",
            {"tube1.offset_rad": entry(0.0174533, 0.0, 0.0349066, "rad", 0.0)},
            "inner tube: encoder offset = 1 deg instead of 0, 90 % interval 0 to 2",
        ),
        (
            "base_coulomb",
            {"mu_base": entry(0.763, 0.7, 0.8, "1", 1.09)},
            "base coulomb, mu = 0.763 instead of 1.09 (-30 %), 90 % interval 0.7 to 0.8",
        ),
        (
            "drivetrain_compliance",
            {"tube1.stiffness_Nm_per_rad": entry(0.5, 0.4, None, "N m/rad", None)},
            "inner tube: drivetrain compliance, stiffness = 0.5 N m/rad instead of no limit, 90 % interval 0.4 to no limit",
        ),
        (
            "tip_force",
            {"Fx_N": entry(0.01, 0.0, 0.02, "N", 0.0), "Fz_N": entry(-0.01, -0.02, 0.0, "N", 0.0)},
            "tip force, Fx = 10 mN instead of 0, 90 % interval 0 to 20; tip force, Fz = -10 mN instead of 0, 90 % interval -20 to 0",
        ),
        ("config_mistake", {"which": entry("degrees", None, None, "name", "none")}, "configuration: degrees"),
        ("unknown", {}, "outside the catalogue"),
    ],
)
def test_sentence(effect, parameters, text):
    assert cause_text(TISSUE, effect, parameters) == text


@pytest.mark.parametrize(
    ("extensions", "effect", "parameters", "text"),
    [
        (
            {"youngs_modulus": {"tube2.scale": 0.8}},
            "youngs_modulus",
            {"tube2.scale": entry(0.92, 0.9, 0.94, "1", 1.0)},
            "outer tube: E = 55.2 GPa instead of 60 (-8 %), 90 % interval 54 to 56.4",
        ),
        (
            {"youngs_modulus": {"all.scale": 0.8}},
            "youngs_modulus",
            {"tube2.scale": entry(0.92, 0.9, 0.94, "1", 1.0)},
            "outer tube: E = 55.2 GPa instead of 60 (-8 %), 90 % interval 54 to 56.4",
        ),
        (
            {"youngs_modulus": {"tube2.scale": 0.8}},
            "shear_modulus",
            {"tube2.scale": entry(0.5, 0.4, 0.6, "1", 1.0)},
            "outer tube: G = 11.54 GPa instead of 23.08 (-50 %), 90 % interval 9.231 to 13.85",
        ),
        (
            {"tracker_averaging": {"window_s": 0.03}},
            "tracker_averaging",
            {"window_s": entry(0.01, 0.008, 0.012, "s", 0.0)},
            "tracker averaging, window = 40 ms instead of 30 (+33.3 %), 90 % interval 38 to 42",
        ),
        (
            {"tracker_scale": {"scale": 1.02}},
            "tracker_scale",
            {"scale": entry(1.01, 1.0, 1.02, "1", 1.0)},
            "factor on the tracker scale = 1.03 instead of 1.02 (+1 %), 90 % interval 1.02 to 1.04",
        ),
        (
            {"stribeck": {"static_ratio": 2.0}},
            "stribeck",
            {"static_ratio": entry(2.5, 2.0, 3.0, "1", 2.0)},
            "stribeck, static ratio = 2.5 instead of 2 (+25 %), 90 % interval 2 to 3",
        ),
    ],
)
def test_what_the_robot_file_has_as_an_extension_is_what_it_has(extensions, effect, parameters, text):
    robot = robot_from_dict({**robot_to_dict(TISSUE), "extensions": extensions})
    assert cause_text(robot, effect, parameters) == text


@pytest.mark.parametrize("name", ["till2020_tissue", "three_tube"])
def test_every_parameter_of_the_catalogue_has_a_sentence_of_its_own(name):
    """Two parameters of one cause are told apart, and no name of a unit is left in a sentence."""
    robot, said = load_robot(name), {}
    for q in effect_quantities(robot):
        value = entry(1.0, 0.5, 2.0, q.parameter.unit, 1.0)
        text = cause_text(robot, q.effect, {q.name: value}).split(" = ")[0]
        assert text not in said, (q.name, said[text])
        assert "_" not in text
        said[text] = q.name
