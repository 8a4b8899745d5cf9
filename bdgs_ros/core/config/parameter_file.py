"""ROS 2 parameter files, read without ROS."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from bdgs_ros.core.errors import ConfigError


def read_yaml(path: Path) -> dict[str, Any]:
    """
    Read a ROS 2 parameter file, or plain nested names, as dotted name to value.

    Sections of several nodes are joined. ROS's own names (`use_sim_time`, `qos_overrides`) are
    passed over; other names are left for `with_values` to judge.

    Raises
    ------
    ConfigError
        If the file is missing or is not a mapping in yaml.

    """
    import yaml

    try:
        document = yaml.safe_load(path.read_text(encoding='utf-8'))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        problem = ' '.join(str(error).split())
        raise ConfigError(f"cannot read parameters from '{path}': {problem}") from error
    if document is None:
        return {}
    if not isinstance(document, Mapping):
        raise ConfigError(f"'{path}' is not a parameter file: expected names and values")
    values: dict[str, Any] = {}
    for section in _sections(document):
        values.update(_flatten(section))
    return values


def _sections(document: Mapping[str, Any]) -> Iterator[Mapping[str, Any]]:
    nodes = [v for v in document.values() if isinstance(v, Mapping) and 'ros__parameters' in v]
    if not nodes:
        yield document
    for node in nodes:
        yield node['ros__parameters'] or {}


def _flatten(section: Mapping[str, Any], prefix: str = '') -> dict[str, Any]:
    values: dict[str, Any] = {}
    for key, value in section.items():
        name = f'{prefix}{key}'
        if name in ('use_sim_time', 'qos_overrides'):
            continue
        if isinstance(value, Mapping):
            values.update(_flatten(value, f'{name}.'))
        else:
            values[name] = value
    return values
