"""
The machinery behind the config dataclasses: the only place where defaults live.

A field made with `param` knows its meaning, unit and range. ROS parameters, yaml files and the
command line are derived from the fields: the name of a parameter is its dotted path, for example
`tracking.motion.acceleration_sigma`.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
from typing import Any, TypeVar

from bdgs_ros.core.errors import ConfigError

Value = bool | int | float | str
Config = TypeVar('Config')


@dataclass(frozen=True)
class ParamSpec:
    """One leaf of a config: its dotted name, value, meaning and allowed range."""

    name: str
    value: Value
    doc: str
    unit: str
    low: float | None
    high: float | None
    choices: tuple[str, ...]

    def describe_range(self) -> str:
        """Say in words which values are allowed."""
        if self.choices:
            return 'one of ' + ', '.join(repr(c) for c in self.choices)
        if isinstance(self.value, bool):
            return 'true or false'
        if isinstance(self.value, str):
            return 'any text'
        low = '-inf' if self.low is None else f'{self.low:g}'
        high = 'inf' if self.high is None else f'{self.high:g}'
        return f'{low} to {high}' + (f' {self.unit}' if self.unit else '')


def param(
    default: Value,
    doc: str,
    *,
    unit: str = '',
    low: float | None = None,
    high: float | None = None,
    choices: tuple[str, ...] = (),
) -> Any:
    """Declare one parameter of a config dataclass with its meaning, unit and range."""
    meta = {'doc': doc, 'unit': unit, 'low': low, 'high': high, 'choices': choices}
    return field(default=default, metadata=meta)


def specs(config: Any, prefix: str = '') -> Iterator[ParamSpec]:
    """Yield every leaf of a config dataclass, depth first, with its dotted name."""
    for item in fields(config):
        value = getattr(config, item.name)
        name = f'{prefix}{item.name}'
        if is_dataclass(value):
            yield from specs(value, f'{name}.')
        else:
            yield ParamSpec(name=name, value=value, **item.metadata)


def validate(config: Any) -> None:
    """Raise `ConfigError` for the first value that is outside its allowed range."""
    for spec in specs(config):
        _check(spec, spec.value)


def with_values(config: Config, values: Mapping[str, Any]) -> Config:
    """
    Return a copy of a config with some leaves replaced.

    Parameters
    ----------
    config : dataclass
        Any config of this package.
    values : mapping of str to value
        Keys are dotted names; numbers given as text are converted.

    Raises
    ------
    ConfigError
        For an unknown name (the nearest known one is suggested), a value of the wrong type, or
        one out of range.

    """
    known = {spec.name: spec for spec in specs(config)}
    for name, value in values.items():
        if name not in known:
            raise ConfigError(_unknown(name, list(known)))
        config = _replace_leaf(config, name.split('.'), _convert(known[name], value))
    return config


def _unknown(name: str, known: list[str]) -> str:
    close = difflib.get_close_matches(name, known, n=1, cutoff=0.5)
    hint = f"did you mean '{close[0]}'?" if close else f'known are: {", ".join(known)}'
    return f"unknown parameter '{name}'; {hint}"


def _replace_leaf(config: Any, path: list[str], value: Value) -> Any:
    if len(path) > 1:
        value = _replace_leaf(getattr(config, path[0]), path[1:], value)
    return replace(config, **{path[0]: value})


def _convert(spec: ParamSpec, value: Any) -> Value:
    kind = type(spec.value)
    try:
        converted = _to_bool(value) if kind is bool else kind(value)
    except (TypeError, ValueError) as error:
        raise ConfigError(_refused(spec, value)) from error
    if kind is int and float(value) != converted:
        raise ConfigError(_refused(spec, value))
    _check(spec, converted)
    return converted


def _to_bool(value: Any) -> bool:
    words = {'true': True, 'false': False, '1': True, '0': False}
    text = str(value).lower()
    if text not in words:
        raise ValueError(text)
    return words[text]


def _check(spec: ParamSpec, value: Value) -> None:
    if spec.choices:
        good = value in spec.choices
    elif isinstance(value, bool | str):
        good = True
    else:
        good = (spec.low is None or value >= spec.low) and (
            spec.high is None or value <= spec.high
        )
    if not good:
        raise ConfigError(_refused(spec, value))


def _refused(spec: ParamSpec, value: Any) -> str:
    return (
        f"parameter '{spec.name}' = {value!r} is refused: allowed is {spec.describe_range()}; "
        f'it is: {spec.doc}'
    )
