"""What the rows of bench `belief` boil down to: the figures asked for, medians and worst."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from bdgs_ros.bench import sequences
from bdgs_ros.eval.belief_score import BeliefScore

FULL = 'weights'
"""The configuration that is the whole method."""
SCORED = (
    'precision', 'recall', 'unknown_recall', 'false_removal_percent', 'restored_percent',
    'settled_percent', 'hidden_static_percent',
)  # fmt: skip
_OVERVIEW = (
    *SCORED, 'ate_cm', 'label_precision', 'label_recall', 'psnr_db', 'hidden_minus_rest_db',
)  # fmt: skip
_WORST_IS_MOST = ('false_removal_percent', 'hidden_static_percent', 'ate_cm')


def summarise(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return medians over scenarios and seeds of the full configuration, the worst, and cost."""
    full = [r for r in rows if r['configuration'] == FULL and _is_synth(r)]
    asked: dict[str, Any] = {
        'recall': _median(full, 'recall'),
        'precision': _median(full, 'precision'),
        'false_removal': _share(_median(full, 'false_removal_percent')),
        'restored': _share(_median(full, 'restored_percent')),
        'unknown_recall': _median(full, 'unknown_recall'),
    }
    summary: dict[str, Any] = {}
    for column in (*_OVERVIEW[3:], 'inference_ms'):
        summary[f'{column}_median'] = _median(full, column)
    for column in _OVERVIEW:
        summary[f'{column}_worst'] = _worst(full, column)
    pooled = BeliefScore()
    for row in full:
        pooled += BeliefScore.of(row.get('counts') or {})
    summary.update(
        pooled_recall=pooled.recall,
        pooled_precision=pooled.precision,
        pooled_false_removal=pooled.false_removal,
        pooled_restored=pooled.restored_share,
        inference_50k_ms=_median(rows, 'inference_50k_ms'),
    )
    return {**asked, **{name: value for name, value in summary.items() if value is not None}}


def overviews(rows: Sequence[Mapping[str, Any]]) -> dict[str, list[dict[str, Any]]]:
    """Return median and worst of each recording and configuration over its seeds."""
    found = []
    for name in dict.fromkeys((row['sequence'], row['configuration']) for row in rows):
        own = [row for row in rows if (row['sequence'], row['configuration']) == name]
        line: dict[str, Any] = {'sequence': name[0], 'configuration': name[1], 'runs': len(own)}
        for column in _OVERVIEW:
            line[column] = _median(own, column)
            line[f'{column}, worst'] = _worst(own, column)
        if any(line[column] is not None for column in _OVERVIEW):
            found.append(line)
    empty = {c for c in _OVERVIEW if all(line[c] is None for line in found)}
    empty |= {f'{column}, worst' for column in empty}
    return {
        'Median and worst over seeds': [
            {k: v for k, v in line.items() if k not in empty} for line in found
        ]
    }


def _is_synth(row: Mapping[str, Any]) -> bool:
    return str(row['sequence']).startswith(sequences.synth_name(''))


def _known(rows: Iterable[Mapping[str, Any]], column: str) -> list[float]:
    values = (row.get(column) for row in rows)
    return [value for value in values if value is not None]


def _median(rows: Sequence[Mapping[str, Any]], column: str) -> float | None:
    values = _known(rows, column)
    return float(np.median(values)) if values else None


def _worst(rows: Sequence[Mapping[str, Any]], column: str) -> float | None:
    values = _known(rows, column)
    return (max if column in _WORST_IS_MOST else min)(values) if values else None


def _share(percent: float | None) -> float | None:
    return None if percent is None else percent / 100
