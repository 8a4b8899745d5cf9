"""Figures over a column of the rows of a bench."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from bdgs_ros.bench.sequences import synth_name

Row = Mapping[str, Any]


def known(rows: Iterable[Row], column: str) -> list[float]:
    """Return the values of the rows that have the column."""
    values = (row.get(column) for row in rows)
    return [value for value in values if value is not None]


def median(rows: Sequence[Row], column: str) -> float | None:
    """Return the median of a column, None where no row has it."""
    values = known(rows, column)
    return float(np.median(values)) if values else None


def worst(rows: Sequence[Row], column: str, *, is_most: bool) -> float | None:
    """Return the worst value of a column: the largest if `is_most`, else the smallest."""
    values = known(rows, column)
    return (max if is_most else min)(values) if values else None


def is_synth(row: Row) -> bool:
    """Return whether a row is of a synthetic recording."""
    return str(row['sequence']).startswith(synth_name(''))


def without_empty(lines: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Leave out the columns in which no line has a value."""
    columns = {column for line in lines for column in line}
    empty = {column for column in columns if all(line.get(column) is None for line in lines)}
    return [{k: v for k, v in line.items() if k not in empty} for line in lines]
