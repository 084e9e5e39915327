"""Reading and writing robot files: YAML, every failure as one line."""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Mapping
from difflib import get_close_matches
from importlib import resources
from pathlib import Path
from typing import Any

import yaml
from pydantic import BaseModel, ValidationError

from ctr_dynamics.effects.extension_check import check_extensions
from ctr_dynamics.errors import InputError
from ctr_dynamics.io.text_files import decode_text, read_bytes
from ctr_dynamics.io.yaml_files import read_yaml
from ctr_dynamics.robot.quantity import Quantity, VectorQuantity, problem_line
from ctr_dynamics.robot.schema import Robot


def robot_names() -> tuple[str, ...]:
    """Names of the robots shipped with the package."""
    folder = resources.files("ctr_dynamics") / "config" / "robots"
    return tuple(sorted(p.name[:-5] for p in folder.iterdir() if p.name.endswith(".yaml")))


def load_robot(name_or_path: str | Path) -> Robot:
    """Load a robot by its shipped name or from a YAML file.

    Args:
        name_or_path: for example "till2020_tissue" or "my_robot.yaml".

    Returns:
        The robot: tubes (innermost first), payloads, friction, encoders, tracker, gravity and rest position, each value with its tolerance.

    Raises:
        InputError: no such robot, not readable, or not a valid robot file.

    Example:
        >>> from ctr_dynamics import load_robot
        >>> robot = load_robot("till2020_tissue")
        >>> robot.n_tubes
        2
        >>> robot.rest.beta.value  # translations of the tubes' bases behind the plate, m
        (-0.2521, -0.1977)
    """
    name = str(name_or_path)
    if name in robot_names():
        data = (resources.files("ctr_dynamics") / "config" / "robots" / f"{name}.yaml").read_bytes()
        return _from_bytes(data, f"robot {name}", name)
    path = Path(name_or_path)
    if not path.exists():
        shipped = robot_names()
        near = get_close_matches(name, shipped, 1)
        hint = f"did you mean '{near[0]}'?" if near else "give a shipped name or the path of a YAML file"
        known = ", ".join(shipped)
        raise InputError(f"robot '{name}' is neither a shipped robot ({known}) nor a file", do=hint)
    return _from_bytes(read_bytes(path), name, name)


def _from_bytes(data: bytes, where: str, source: str) -> Robot:
    robot = robot_from_dict(read_yaml(decode_text(data, where), where), where)
    robot._source = source
    robot._sha256 = hashlib.sha256(data).hexdigest()
    return robot


def robot_from_dict(data: Any, where: str = "robot") -> Robot:
    """Validate the contents of a robot file.

    Raises:
        InputError: the first problem, with its key path; how many more there are is added.
    """
    if not isinstance(data, dict):
        kind = "empty" if data is None else f"a {type(data).__name__}"
        raise InputError(
            f"robot file is {kind}, not a mapping", do="see config/robots for examples", where=where
        )
    try:
        robot = Robot.model_validate(data)
    except ValidationError as error:
        raise InputError(problem_line(error), where=where) from None
    try:
        check_extensions(robot.extensions, robot)
    except InputError as error:
        raise InputError(str(error), where=where) from None
    return robot


def robot_quantities(robot: Robot) -> dict[str, Quantity | VectorQuantity]:
    """Every quantity of the robot by its key path, e.g. "tubes[0].youngs_modulus"."""
    found: dict[str, Quantity | VectorQuantity] = {}

    def visit(item: Any, path: str) -> None:
        if isinstance(item, (Quantity, VectorQuantity)):
            found[path] = item
        elif isinstance(item, BaseModel):
            for key in type(item).model_fields:
                visit(getattr(item, key), f"{path}.{key}" if path else key)
        elif isinstance(item, tuple):
            for i, part in enumerate(item):
                visit(part, f"{path}[{i}]")

    visit(robot, "")
    return found


def robot_with(robot: Robot, values: Mapping[str, Any]) -> Robot:
    """The robot with some values replaced, validated again; absolute tolerances are kept.

    Args:
        robot: where to start.
        values: key path of a quantity (as in `robot_quantities`, or "rest.beta") to its new value in the same unit.

    Raises:
        InputError: unknown path or a value that does not fit.
    """
    data = robot_to_dict(robot)
    for path, value in values.items():
        node: Any = data
        for key in re.findall(r"[^.\[\]]+", path):
            try:
                node = node[int(key) if isinstance(node, list) else key]
            except (KeyError, IndexError, TypeError, ValueError):
                node = None
        if not isinstance(node, dict) or "value" not in node:
            raise InputError(f"'{path}' names no quantity of robot '{robot.name}'", do="see its file")
        node["value"] = list(value) if hasattr(value, "__len__") else float(value)
    return robot_from_dict(data, f"robot {robot.name}")


def robot_to_dict(robot: Robot) -> dict[str, Any]:
    """Contents of the robot's file as plain lists, dicts and numbers."""
    return _plain(robot.model_dump(exclude_none=True))


def robot_to_yaml(robot: Robot) -> str:
    """The robot as the text of a robot file; loading it gives an equal robot."""
    return yaml.dump(robot_to_dict(robot), sort_keys=False, allow_unicode=True, Dumper=_Dumper)


class _Dumper(yaml.SafeDumper):
    """Quantities on one line each, as people write them."""

    def ignore_aliases(self, data: Any) -> bool:
        return True

    def represent_mapping(self, tag: str, mapping: Any, flow_style: bool | None = None) -> yaml.MappingNode:
        short = isinstance(mapping, dict) and {"value", "unit"} <= set(mapping)
        return super().represent_mapping(tag, mapping, flow_style=True if short else flow_style)


def _plain(item: Any) -> Any:
    if isinstance(item, dict):
        return {key: _plain(value) for key, value in item.items()}
    if isinstance(item, (list, tuple)):
        return [_plain(value) for value in item]
    if isinstance(item, float) and not math.isfinite(item):
        raise ValueError("a robot holds a number that is not finite")
    return item
