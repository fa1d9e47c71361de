"""ROS parameters from the configuration schema: declared once, with description, bounds, and when they can change."""

from __future__ import annotations

import difflib
import sys
from collections.abc import Callable
from typing import Any

from pydantic.fields import FieldInfo
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.node import Node
from rclpy.parameter import Parameter

from fus3dmaps_core.config.schema import Config, fields
from fus3dmaps_core.config.section import Changes, bounds, choices, when_it_changes
from fus3dmaps_core.errors import ConfigError

_TYPES = {
    bool: Parameter.Type.BOOL,
    int: Parameter.Type.INTEGER,
    float: Parameter.Type.DOUBLE,
    str: Parameter.Type.STRING,
    list: Parameter.Type.DOUBLE_ARRAY,
}
_ARRAYS = (Parameter.Type.DOUBLE_ARRAY,)
_INT64_MAX = 2**63 - 1


def declare_parameters(node: Node) -> Config:
    """Declare every key of the schema on a node and read the values that it was started with.

    Raises:
        ConfigError: A value is of the wrong type or out of range; the message names the parameter.
    """
    values: dict[str, Any] = {}
    for key, field in fields().items():
        try:
            value = node.declare_parameter(key, field.default, _descriptor(field)).value
        except InvalidParameterTypeException:
            given = node._parameter_overrides[key]
            raise ConfigError(
                f"parameter '{key}': expects {_TYPES[type(field.default)].name.lower()}, "
                f"got {given.type_.name.lower()} {given.value!r}"
            ) from None
        except InvalidParameterValueException as error:
            raise ConfigError(f"parameter '{key}': {error}") from None
        values[key] = list(value) if isinstance(field.default, list) else value
    return Config.from_flat(values)


def unknown_overrides(node: Node) -> list[str]:
    """Return a sentence for every given parameter that is in one of the schema's sections but not in the schema."""
    known = list(fields())
    sections = {key.partition(".")[0] for key in known}
    sentences = []
    for key in sorted(node._parameter_overrides):
        if key not in fields() and key.partition(".")[0] in sections:
            close = difflib.get_close_matches(key, known, n=1)
            sentences.append(
                f"parameter '{key}' is unknown and ignored" + (f"; did you mean '{close[0]}'?" if close else "")
            )
    return sentences


def follow_changes(
    node: Node,
    read: Callable[[], Config],
    apply: Callable[[Config], None],
    is_configured: Callable[[], bool] = lambda: True,
) -> None:
    """Check parameters that are set at run time against the schema and apply the new configuration.

    Args:
        node: Has the parameters.
        read: Returns the current configuration.
        apply: Takes the new one.
        is_configured: Returns whether the node has models and a map; then only ``Changeable`` parameters can change.
    """
    known = fields()

    def changed(parameters: list[Parameter]) -> Config:
        values = {item.name: list(item.value) if item.type_ in _ARRAYS else item.value for item in parameters}
        return read().with_values({key: value for key, value in values.items() if key in known})

    def check(parameters: list[Parameter]) -> SetParametersResult:
        try:
            new, present = changed(parameters).flat(), read().flat()
        except ConfigError as error:
            return SetParametersResult(successful=False, reason=str(error))
        for key, field in known.items():
            if new[key] != present[key] and when_it_changes(field) != Changes.ANY_TIME and is_configured():
                return SetParametersResult(
                    successful=False,
                    reason=f"parameter '{key}' can be changed only while the node is unconfigured: deactivate and clean up"
                    " first, or start the node with it",
                )
        return SetParametersResult(successful=True)

    node.add_on_set_parameters_callback(check)
    node.add_post_set_parameters_callback(lambda parameters: apply(changed(parameters)))


def _descriptor(field: FieldInfo) -> ParameterDescriptor:
    changes, limits, allowed = when_it_changes(field), bounds(field), choices(field)
    descriptor = ParameterDescriptor(description=field.description or "", read_only=changes == Changes.NEVER)
    # ROS ranges are closed; the schema refuses the open end itself.
    constraints = [f"{sign} {limit}" for sign, limit in limits.items() if sign in "><"]
    if allowed:
        constraints.insert(0, f"one of {', '.join(allowed)}")
    if changes == Changes.UNCONFIGURED:
        constraints.append("changes only while the node is unconfigured")
    descriptor.additional_constraints = ", ".join(constraints)
    lower, upper = limits.get(">=", limits.get(">")), limits.get("<=", limits.get("<"))
    if limits and isinstance(field.default, int):
        descriptor.integer_range = [_closed(IntegerRange, int, lower, upper, _INT64_MAX)]
    elif limits and isinstance(field.default, float):
        descriptor.floating_point_range = [_closed(FloatingPointRange, float, lower, upper, sys.float_info.max)]
    return descriptor


def _closed(kind: Any, number: Callable[[Any], Any], lower: Any, upper: Any, largest: Any) -> Any:
    """Make a ROS range; a bound that is None is as far away as the type allows."""
    return kind(
        from_value=-largest if lower is None else number(lower), to_value=largest if upper is None else number(upper)
    )
