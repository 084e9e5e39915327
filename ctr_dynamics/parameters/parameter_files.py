"""Parameter files: YAML of ROS 2, or the parameters themselves, nested or dotted."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from ctr_dynamics.errors import InputError
from ctr_dynamics.io.text_files import decode_text, read_bytes
from ctr_dynamics.io.yaml_files import read_yaml
from ctr_dynamics.parameters.parameter_table import parameter
from ctr_dynamics.parameters.parameter_types import Value

# In every node's parameter file, and none of this table's business.
_ROS_NAMES = re.compile(r"use_sim_time|start_type_description_service|qos_overrides\..*")


def read_parameter_file(file: Path) -> dict[str, Value]:
    """Values in a YAML parameter file by dotted name, checked.

    Raises:
        InputError: unreadable, no block for the estimator, unknown name, wrong type or out of range.
    """
    where = str(file)
    data = read_yaml(decode_text(read_bytes(Path(file)), where), where)
    if data is None:
        return {}
    if not isinstance(data, dict):
        raise InputError("holds no parameters", do="see config/estimator.yaml", where=where)
    blocks = list(_ros_blocks(data, ""))
    if blocks:
        data = {}
        mine = [b for node, b in blocks if node.rsplit("/", 1)[-1] in ("estimator", "*", "**")]
        if not mine:
            nodes = ", ".join(node for node, _ in blocks)
            raise InputError(
                f"holds parameters of {nodes}, none of the estimator",
                do="name it /ctr/estimator",
                where=where,
            )
        for block in mine:
            data.update(_flat(block, ""))
    values: dict[str, Value] = {}
    for name, value in _flat(data, "").items():
        if _ROS_NAMES.fullmatch(name):
            continue
        try:
            values[name] = parameter(name).check(value)
        except InputError as error:
            raise InputError(str(error), where=where) from None
    return values


def _ros_blocks(data: Mapping[Any, Any], node: str) -> Iterator[tuple[str, Mapping[Any, Any]]]:
    for key, value in data.items():
        if key == "ros__parameters" and isinstance(value, Mapping):
            yield node, value
        elif isinstance(value, Mapping):
            yield from _ros_blocks(value, f"{node}/{str(key).strip('/')}")


def _flat(data: Mapping[Any, Any], prefix: str) -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in data.items():
        name = f"{prefix}{key}"
        if isinstance(value, Mapping):
            flat.update(_flat(value, f"{name}."))
        else:
            flat[name] = value
    return flat
