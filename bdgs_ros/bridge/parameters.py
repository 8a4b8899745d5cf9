"""Config dataclass to declared ROS parameters and back, with every value checked."""

from __future__ import annotations

import difflib
import sys
from collections.abc import Callable, Collection, Iterable
from typing import TypeVar

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.node import Node
from rclpy.parameter import Parameter

from bdgs_ros.bridge.node_config import GraphConfig, known_names
from bdgs_ros.core.config import ParamSpec, specs, with_values
from bdgs_ros.core.errors import ConfigError

Config = TypeVar('Config', bound=GraphConfig)

_ROS_OWN = ('use_sim_time', 'start_type_description_service')
_ROS_OWN_PREFIX = 'qos_overrides.'


def declare(node: Node, config: Config, *, runtime: Collection[str] = ()) -> Config:
    """
    Declare every leaf of a config as a parameter of a node.

    Parameters
    ----------
    node : Node
        Its overrides (command line, yaml, constructor) replace the defaults.
    config : GraphConfig
        The defaults.
    runtime : collection of str
        Names that may be changed while the node runs; the node reads these from ROS when it
        needs them.

    Returns
    -------
    config : GraphConfig
        The values that hold.

    Raises
    ------
    ConfigError
        If an override is unknown to every node of this package, of the wrong type, or out of
        range.

    """
    given = {name: p.value for name, p in node._parameter_overrides.items()}
    refuse_unknown(given)
    own = {spec.name for spec in specs(config)}
    config = with_values(config, {name: v for name, v in given.items() if name in own})
    for spec in specs(config):
        node.declare_parameter(spec.name, spec.value, _descriptor(spec), ignore_override=True)
    node.add_on_set_parameters_callback(_make_guard(config, runtime))
    return config


def refuse_unknown(names: Iterable[str]) -> None:
    """Raise `ConfigError` that lists every name no node has, with the nearest known one."""
    known = known_names()
    unknown = [
        name
        for name in names
        if name not in known and name not in _ROS_OWN and not name.startswith(_ROS_OWN_PREFIX)
    ]
    if unknown:
        raise ConfigError('; '.join(_describe_unknown(name, known) for name in sorted(unknown)))


def _describe_unknown(name: str, known: list[str]) -> str:
    close = difflib.get_close_matches(name, known, n=1, cutoff=0.5)
    hint = f"did you mean '{close[0]}'?" if close else 'config/bdgs.yaml lists all of them'
    return f"unknown parameter '{name}'; {hint}"


def _descriptor(spec: ParamSpec) -> ParameterDescriptor:
    text = f'{spec.doc} [{spec.unit}]' if spec.unit else spec.doc
    descriptor = ParameterDescriptor(
        name=spec.name, description=text, additional_constraints=spec.describe_range()
    )
    if isinstance(spec.value, bool | str) or (spec.low is None and spec.high is None):
        return descriptor
    if isinstance(spec.value, int):
        low = -sys.maxsize if spec.low is None else int(spec.low)
        high = sys.maxsize if spec.high is None else int(spec.high)
        descriptor.integer_range = [IntegerRange(from_value=low, to_value=high, step=0)]
    else:
        lowest = -sys.float_info.max if spec.low is None else float(spec.low)
        highest = sys.float_info.max if spec.high is None else float(spec.high)
        descriptor.floating_point_range = [
            FloatingPointRange(from_value=lowest, to_value=highest, step=0.0)
        ]
    return descriptor


def _make_guard(
    config: GraphConfig, runtime: Collection[str]
) -> Callable[[list[Parameter]], SetParametersResult]:
    own = {spec.name for spec in specs(config)}

    def guard(parameters: list[Parameter]) -> SetParametersResult:
        for parameter in parameters:
            reason = _why_not(parameter) if parameter.name in own else ''
            if reason:
                return SetParametersResult(successful=False, reason=reason)
        return SetParametersResult(successful=True)

    def _why_not(parameter: Parameter) -> str:
        if parameter.name not in runtime:
            return (
                f"'{parameter.name}' is read at the start only; restart the node with "
                f'-p {parameter.name}:={parameter.value}'
            )
        try:
            with_values(config, {parameter.name: parameter.value})
        except ConfigError as error:
            return str(error)
        return ''

    return guard
