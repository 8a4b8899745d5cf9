"""One measured number with its name and unit, and how lists of them are written down."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Metric:
    """A result such as `Metric('ate_rmse', 2.31, 'cm')`; NaN means that nothing was measured."""

    name: str
    value: float
    unit: str = ''

    def __str__(self) -> str:
        """Write name, value and unit on one line."""
        return f'{self.name} {format_value(self.value)} {self.unit}'.rstrip()


def ratio(part: float, whole: float) -> float:
    """Return part over whole, NaN where there is nothing."""
    return part / whole if whole else float('nan')


def format_value(value: Any) -> str:
    """Write a number with four significant digits; '-' where there is none."""
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return '-'
    if not isinstance(value, float | np.floating):
        return str(value)
    value = float(value)
    if value == 0.0 or 1e-3 <= abs(value) < 1e4:
        return f'{value:.4g}'
    return f'{value:.2e}' if abs(value) < 1e-3 else f'{value:.0f}'


def as_dict(metrics: Iterable[Metric]) -> dict[str, dict[str, Any]]:
    """Return `{name: {'value': ..., 'unit': ...}}`, the form of `metrics.json`."""
    return {m.name: {'value': m.value, 'unit': m.unit} for m in metrics}


def markdown_table(rows: Sequence[Mapping[str, Any]], columns: Sequence[str] = ()) -> str:
    """
    Write rows as a Markdown table, numbers to the right.

    Parameters
    ----------
    rows : sequence of mapping
        A cell that a row lacks is written as '-'.
    columns : sequence of str
        Which keys, in which order; by default all, in order of first appearance.

    Returns
    -------
    table : str
        Ends with a newline; empty for no rows.

    """
    if not rows:
        return ''
    names = list(columns) or list(dict.fromkeys(key for row in rows for key in row))
    right = [all(_is_number(row.get(name)) for row in rows) for name in names]
    lines = [
        '| ' + ' | '.join(names) + ' |',
        '|' + '|'.join('---:' if r else '---' for r in right) + '|',
    ]
    for row in rows:
        cells = (format_value(row.get(name)).replace('|', '\\|') for name in names)
        lines.append('| ' + ' | '.join(cells) + ' |')
    return '\n'.join(lines) + '\n'


def _is_number(value: Any) -> bool:
    return value is None or isinstance(value, int | float | np.number)


def jsonable(value: Any) -> Any:
    """Turn arrays, numpy scalars, paths and tuples to JSON types; NaN and infinity to null."""
    if isinstance(value, Mapping):
        return {str(key): jsonable(item) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        return jsonable(value.tolist())
    if isinstance(value, list | tuple):
        return [jsonable(item) for item in value]
    if isinstance(value, np.generic):
        return jsonable(value.item())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return str(value) if isinstance(value, Path) else value


def dump_json(value: Any) -> str:
    """Write a value as indented strict JSON."""
    return json.dumps(jsonable(value), indent=2, allow_nan=False)
