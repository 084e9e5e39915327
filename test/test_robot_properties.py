"""Properties of the robot loader: any valid robot survives a round trip, anything else ends in one line."""

import copy
import math
from typing import Any

import numpy as np
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ctr_dynamics.errors import InputError
from ctr_dynamics.robot_files import (
    load_robot,
    robot_from_dict,
    robot_quantities,
    robot_to_dict,
    robot_to_yaml,
    robot_with,
)

BASE = robot_to_dict(load_robot("three_tube"))
FAST = settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.too_slow])


def numbers(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(low, high, allow_nan=False, allow_subnormal=False)


def quantity(unit: str, value: st.SearchStrategy[Any]) -> st.SearchStrategy[dict[str, Any]]:
    return st.fixed_dictionaries({"value": value, "unit": st.just(unit)})


@st.composite
def robots(draw: st.DrawFn) -> dict[str, Any]:
    """Contents of a valid robot file with one to four tubes that fit, sorted as the rules want them."""
    count = draw(st.integers(1, 4))
    radii = np.cumsum([draw(numbers(1e-4, 1e-3)) for _ in range(2 * count)])
    tips = sorted((draw(numbers(0.02, 0.3)) for _ in range(count)), reverse=True)
    betas = sorted(draw(numbers(-0.3, 0.0)) for _ in range(count))
    tubes = []
    for i in range(count):
        length = tips[i] - betas[i]
        share = draw(numbers(0.1, 0.9))
        tubes.append(
            {
                "name": f"tube {i}",
                "inner_radius": {"value": float(radii[2 * i]), "unit": "m"},
                "outer_radius": {"value": float(radii[2 * i + 1]), "unit": "m"},
                "youngs_modulus": draw(quantity("Pa", numbers(1e6, 1e12))) | {"tolerance_percent": 1},
                "density": draw(quantity("kg/m^3", numbers(200, 2e4))),
                "bending_damping": {"value": 0, "unit": "N m^2 s"},
                "torsion_damping": {"value": 0.0, "unit": "N m^2 s"},
                "precurvature": [
                    {
                        "length": {"value": share * length, "unit": "m"},
                        "curvature": draw(
                            quantity("1/m", st.lists(numbers(-60, 60), min_size=3, max_size=3))
                        ),
                    },
                    {
                        "length": {"value": (1 - share) * length, "unit": "m"},
                        "curvature_polynomial": {
                            "value": [[1.0, 2.0], [0.0, 1.0], [0.0, 0.0]],
                            "unit": "1/m",
                        },
                    },
                ],
            }
        )
    rest = {
        "beta": {"value": betas, "unit": "m"},
        "alpha": {"value": [draw(numbers(-100, 100)) for _ in range(count)], "unit": "rad"},
    }
    return {**copy.deepcopy(BASE), "tubes": tubes, "rest": rest}


@FAST
@given(robots())
def test_valid_robots_load_and_survive_a_round_trip(data):
    robot = robot_from_dict(data)
    again = robot_from_dict(yaml.safe_load(robot_to_yaml(robot)))
    assert again == robot
    assert robot.actuator_problem(robot.rest.beta.value, robot.rest.alpha.value) is None
    for tube in robot.tubes:
        assert tube.bending_stiffness > 0
        assert tube.breakpoints[-1] == np.float64(tube.length) or math.isclose(
            tube.breakpoints[-1], tube.length
        )
        assert np.isfinite(tube.curvature_at(tube.length)).all()


@FAST
@given(robots(), st.data())
def test_curvature_is_that_of_the_segment(data, draw):
    robot = robot_from_dict(data)
    tube = draw.draw(st.sampled_from(robot.tubes))
    i = draw.draw(st.integers(0, 1))
    inside = draw.draw(numbers(0.01, 0.99))
    segment = tube.precurvature[i]
    s = segment.length.value * inside
    np.testing.assert_allclose(tube.curvature_at(tube.breakpoints[i] + s), segment.curvature_at(s), atol=1e-9)


JUNK = st.one_of(
    st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=8),
    st.lists(st.floats(), max_size=4), st.dictionaries(st.text(max_size=8), st.floats(), max_size=3),
)  # fmt: skip


def places(node: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    keys = node.keys() if isinstance(node, dict) else range(len(node)) if isinstance(node, list) else ()
    found = [(*path, key) for key in keys]
    return found + [p for key in keys for p in places(node[key], (*path, key))]


PLACES = places(BASE)


@settings(max_examples=300, deadline=None)
@given(st.sampled_from(PLACES), JUNK)
def test_junk_anywhere_loads_or_is_rejected_in_one_line(path, junk):
    data = copy.deepcopy(BASE)
    node = data
    for key in path[:-1]:
        node = node[key]
    node[path[-1]] = junk
    try:
        robot = robot_from_dict(data, "robot.yaml")
    except InputError as error:
        assert "\n" not in str(error)
        assert str(error).startswith("robot.yaml: ")
        return
    # What is taken holds finite numbers only.
    for path_, q in robot_quantities(robot).items():
        assert np.isfinite(q.value).all(), path_
        assert np.isfinite(q.tolerance).all(), path_
        assert np.min(q.tolerance) >= 0, path_


@settings(max_examples=200, deadline=None)
@given(st.text(max_size=60))
def test_any_text_is_rejected_in_one_line(tmp_path_factory, text):
    file = tmp_path_factory.mktemp("robot") / "robot.yaml"
    file.write_bytes(text.encode("utf-8", "surrogatepass"))
    try:
        load_robot(file)
    except InputError as error:
        assert "\n" not in str(error)
    else:
        raise AssertionError("a random text is no robot")


@settings(max_examples=60, deadline=None)
@given(
    st.sampled_from(["tubes[0].youngs_modulus", "friction.base.coulomb", "tubes[2].density"]), numbers(0.5, 2)
)
def test_scaling_a_quantity_scales_it_alone(path, factor):
    robot = load_robot("three_tube")
    old = robot_quantities(robot)
    new = robot_quantities(robot_with(robot, {path: factor * old[path].value}))
    assert new[path].value == factor * old[path].value
    assert {p for p in old if new[p] != old[p]} <= {path}
