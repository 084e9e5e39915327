"""Who publishes the inputs (nobody, several, with another type, or under another name), and who else the outputs.

Told from the graph of topics, for the diagnostics.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

from ctr_dynamics.estimation.step_output import ERROR, OK, WARN, Status
from ctr_dynamics.io.messages.input_types import TYPES, accepts_type, rank
from ctr_dynamics.io.messages.topics import BACKBONE_STATE, JOINT_STATES, OUTPUTS, TIP_LOAD, TRANSFORMS

MOST_NAMED = 4
_OUTPUT_NAMES = frozenset(topic.name.rpartition("/")[2] for topic in OUTPUTS)
_MARK = BACKBONE_STATE.rpartition("/")[2]  # who publishes that is an estimator of this package


class Endpoint(NamedTuple):
    """A publisher: its node with namespace, and the type of its messages."""

    node: str
    ros_type: str


def wanted_type(topic: str, publishers: Sequence[Endpoint]) -> str:
    """The type to subscribe to the input ``topic`` with: of those published and readable the one that comes first, else its own."""
    usable = [p.ros_type for p in publishers if accepts_type(topic, p.ros_type)]
    return min(usable, key=lambda kind: rank(topic, kind), default=TYPES[topic][0])


def publishers_status(
    publishers: Mapping[str, Sequence[Endpoint]],
    names: Mapping[str, str],
    others: Mapping[str, Sequence[str]],
    outputs: Mapping[str, Sequence[Endpoint]] = MappingProxyType({}),
) -> Status:
    """What the graph says about the inputs and outputs, the worst first.

    Args:
        publishers: of each input.
        names: of the inputs in the graph, which are others where the node was remapped.
        others: types of all topics of the graph by name.
        outputs: publishers of the node's own outputs by their names in the graph, where there are others than the node itself.
    """
    errors: list[str] = []
    warnings = [text] if (text := shared_outputs(outputs)) else []
    values: dict[str, str] = {}
    for topic, found in publishers.items():
        name = names[topic]
        values[name] = ", ".join(f"{p.node} ({p.ros_type})" for p in found) or "nobody"
        expected = " or ".join(TYPES[topic])
        wrong = [p for p in found if not accepts_type(topic, p.ros_type)]
        if wrong:
            errors.append(
                f"{name} is published as {wrong[0].ros_type} by {wrong[0].node}, expected {expected}"
            )
        if len(found) > 1:
            warnings.append(
                f"{name} has {len(found)} publishers, {_listed(f'{p.node} ({p.ros_type})' for p in found)}: stop all but one"
            )
        if not found and topic != TIP_LOAD:
            text = f"nobody publishes {name} ({expected}){_elsewhere(topic, name, names, others)}"
            warnings.insert(0, text) if topic == JOINT_STATES else warnings.append(text)
    if errors or warnings:
        return Status("publishers", ERROR if errors else WARN, "; ".join((*errors, *warnings)), values)
    return Status("publishers", OK, "every input has one publisher", values)


def shared_outputs(outputs: Mapping[str, Sequence[Endpoint]]) -> str:
    """That others publish what the node publishes, with what to do; empty where ``outputs`` is. See :func:`publishers_status`."""
    if not outputs:
        return ""
    name, found = next(iter(outputs.items()))
    more = f" (and {len(outputs) - 1} further outputs)" if len(outputs) > 1 else ""
    return (
        f"{name}{more} has {len(found)} publishers, {_listed(p.node for p in found)}, limit 1: another estimator of that name runs? "
        "Stop one, or start it under another name (-r __node:=NAME) or in another namespace (-r __ns:=/NAME)"
    )


def _is_output(name: str, others: Mapping[str, Sequence[str]]) -> bool:
    """Whether an estimator of this package, of whatever name, publishes that topic."""
    node, _, last = name.rpartition("/")
    return last in _OUTPUT_NAMES and f"{node}/{_MARK}" in others


def _elsewhere(topic: str, name: str, names: Mapping[str, str], others: Mapping[str, Sequence[str]]) -> str:
    """Topics that may be the one that nobody publishes, with what to do."""
    taken = {*names.values(), *TRANSFORMS}
    fitting = [
        (other, kind)
        for other, kinds in sorted(others.items())
        for kind in kinds
        if other not in taken and not _is_output(other, others) and accepts_type(topic, kind)
    ]
    if not fitting:
        return ""
    # the same last name in another namespace is the likeliest
    fitting.sort(key=lambda item: item[0].rsplit("/", 1)[-1] != name.rsplit("/", 1)[-1])
    shown = _listed(f"{other} ({kind})" for other, kind in fitting)
    return f"; it may be {shown}: start with --ros-args -r {name}:={fitting[0][0]}"


def _listed(texts: Iterable[str]) -> str:
    return ", ".join([*texts][:MOST_NAMED])
