"""What the rows of bench `belief` boil down to: the figures asked for, medians and worst."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from bdgs_ros.bench.columns import Row, is_synth, median, without_empty, worst
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


def summarise(rows: Sequence[Row]) -> dict[str, Any]:
    """Return medians over scenarios and seeds of the full configuration, the worst, and cost."""
    full = [r for r in rows if r['configuration'] == FULL and is_synth(r)]
    asked: dict[str, Any] = {
        'recall': median(full, 'recall'),
        'precision': median(full, 'precision'),
        'false_removal': _share(median(full, 'false_removal_percent')),
        'restored': _share(median(full, 'restored_percent')),
        'unknown_recall': median(full, 'unknown_recall'),
    }
    summary: dict[str, Any] = {}
    for column in (*_OVERVIEW[3:], 'inference_ms'):
        summary[f'{column}_median'] = median(full, column)
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
        inference_50k_ms=median(rows, 'inference_50k_ms'),
    )
    return {**asked, **{name: value for name, value in summary.items() if value is not None}}


def overviews(rows: Sequence[Row]) -> dict[str, list[dict[str, Any]]]:
    """Return median and worst of each recording and configuration over its seeds."""
    found = []
    for name in dict.fromkeys((row['sequence'], row['configuration']) for row in rows):
        own = [row for row in rows if (row['sequence'], row['configuration']) == name]
        line: dict[str, Any] = {'sequence': name[0], 'configuration': name[1], 'runs': len(own)}
        for column in _OVERVIEW:
            line[column] = median(own, column)
            line[f'{column}, worst'] = _worst(own, column)
        if any(line[column] is not None for column in _OVERVIEW):
            found.append(line)
    return {'Median and worst over seeds': without_empty(found)}


def _worst(rows: Sequence[Row], column: str) -> float | None:
    return worst(rows, column, is_most=column in _WORST_IS_MOST)


def _share(percent: float | None) -> float | None:
    return None if percent is None else percent / 100
