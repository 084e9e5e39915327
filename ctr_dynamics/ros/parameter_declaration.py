"""Declares the parameters of the table on a node, checks what it was started with and what is set later."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, TypeVar

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.context import Context
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter

from ctr_dynamics.errors import InputError
from ctr_dynamics.parameters import PARAMETERS, Parameter, Settings, without_defaults

# Every rclpy node has these besides its own.
_ROS_NAMES = ("use_sim_time", "start_type_description_service")
_ROS_PREFIXES = ("qos_overrides.",)
Checked = TypeVar("Checked", bound=Mapping[str, Any])
_TABLE = {parameter.name: parameter for parameter in PARAMETERS}


class TableNode(Node):
    """A node whose parameters are those of a table.

    ROS declares at once what the node was started with, so that a name that no parameter has is seen at all; otherwise it passes over it in silence.

    Attributes:
        without_value: names of parameters that were given an empty list, which has no type in ROS and cannot be declared.
    """

    def __init__(self, name: str, namespace: str, context: Context | None = None) -> None:
        self.without_value: list[str] = []
        super().__init__(
            name, context=context, namespace=namespace, automatically_declare_parameters_from_overrides=True
        )

    def declare_parameters(
        self, namespace: str, parameters: Sequence[Any], *args: Any, **options: Any
    ) -> Any:
        """Declare what has a value or a type; what has none is remembered."""
        empty = [p[0] for p in parameters if len(p) > 1 and p[1] is None]
        self.without_value += empty
        usable = [p for p in parameters if p[0] not in empty]
        return super().declare_parameters(namespace, usable, *args, **options)


def declare(node: TableNode) -> Settings:
    """Declare every parameter of the estimator with type, text, range and read-only mark.

    Raises:
        InputError: as :func:`declare_table`.
    """
    # ROS does not tell a parameter file, which may hold every default, from a single value
    return _declare(node, PARAMETERS, lambda given: Settings(without_defaults(given)))


def declared(node: Node) -> Settings:
    """The values that the declared parameters have now.

    Raises:
        InputError: one that was set since cannot be used.
    """
    values = {p.name: _plain(node.get_parameter(p.name).value) for p in PARAMETERS}
    return Settings(without_defaults(values))


def declare_table(node: TableNode, table: Sequence[Parameter]) -> dict[str, Any]:
    """Declare the parameters of a ``table``, fixed from then on; returns their values by name.

    Raises:
        InputError: an unknown name, or a value of the wrong type or out of its range.
    """
    return _declare(
        node,
        [replace(p, read_only=True) for p in table],
        lambda given: {p.name: p.check(given.get(p.name, p.default)) for p in table},
    )


def _declare(
    node: TableNode, table: Sequence[Parameter], check: Callable[[dict[str, Any]], Checked]
) -> Checked:
    names = [p.name for p in table]
    given: dict[str, Any] = {}
    started_with = {name: _plain(p.value) for name, p in node.get_parameters_by_prefix("").items()}
    for name, value in {**started_with, **{name: [] for name in node.without_value}}.items():
        if name in names:
            given[name] = value
        elif name not in _ROS_NAMES and not name.startswith(_ROS_PREFIXES):
            raise InputError(f"parameter {name} is unknown", do=_advice(name, names))
    values = check(given)
    for entry in table:
        value = _ros_value(values[entry.name])
        if entry.name in started_with:
            node.undeclare_parameter(entry.name)
        # The value has been checked: a whole number given for a float is a float by now.
        node.declare_parameter(entry.name, value, _descriptor(entry, value), ignore_override=True)
    return values


def watch(
    node: Node,
    current: Callable[[], Settings],
    prepare: Callable[[Settings, set[str]], None],
    apply: Callable[[], None],
) -> Callable[[], None]:
    """Check parameters that are set while the node runs, then apply them. The function that is returned ends that.

    `use_sim_time` stays as it is: steps, stamps and deadlines go by the clock of the start.

    Args:
        current: the settings in use.
        prepare: called with the new settings and the names that change; raises InputError to reject them.
        apply: called once the change is accepted.
    """

    simulated = bool(node.get_parameter("use_sim_time").value)

    def check(parameters: Sequence[RosParameter]) -> SetParametersResult:
        if any(p.name == "use_sim_time" and p.value != simulated for p in parameters):
            reason = "use_sim_time: the clock of a running estimator is that of its start; start it again with the other one"
            return SetParametersResult(successful=False, reason=reason)
        changes = {p.name: _plain(p.value) for p in parameters if p.name in _TABLE}
        if not changes:
            return SetParametersResult(successful=True)
        try:
            settings = current().replace(changes)
            prepare(settings, {name for name in changes if settings[name] != current()[name]})
        except InputError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def changed(parameters: Sequence[RosParameter]) -> None:
        if any(p.name in _TABLE for p in parameters):
            apply()

    node.add_on_set_parameters_callback(check)
    node.add_post_set_parameters_callback(changed)

    def unwatch() -> None:
        node.remove_on_set_parameters_callback(check)
        node.remove_post_set_parameters_callback(changed)

    return unwatch


def _plain(value: Any) -> Any:
    """Arrays of ROS parameters come as array.array."""
    return list(value) if hasattr(value, "typecode") else value


def _ros_value(value: Any) -> Any:
    if value == ():
        return [""]  # an empty array has no type in ROS
    return list(value) if isinstance(value, tuple) else value


def _descriptor(entry: Parameter, value: Any) -> ParameterDescriptor:
    text = f"{entry.text} [{entry.unit}]" if entry.unit else entry.text
    descriptor = ParameterDescriptor(
        name=entry.name,
        type=RosParameter.Type.from_parameter_value(value).value,
        description=text,
        read_only=entry.read_only,
        additional_constraints=entry.range if entry.type in ("str", "floats", "texts") else "",
    )
    if entry.low is not None and entry.high is not None:
        if entry.type == "float":
            descriptor.floating_point_range = [FloatingPointRange(from_value=entry.low, to_value=entry.high)]
        elif entry.type == "int":
            descriptor.integer_range = [IntegerRange(from_value=int(entry.low), to_value=int(entry.high))]
    return descriptor


def _advice(name: str, names: Sequence[str]) -> str:
    near = difflib.get_close_matches(name, names, 1)
    return f"did you mean {near[0]}?" if near else f"the node has {', '.join(names)}"
