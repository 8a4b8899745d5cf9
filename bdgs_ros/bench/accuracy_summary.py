"""What the rows of bench `accuracy` boil down to: per recording, and per part left out."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from bdgs_ros.bench import sequences
from bdgs_ros.bench.columns import Row, is_synth, median, without_empty, worst
from bdgs_ros.eval.honesty import WITHIN

FULL = 'weights'
"""The configuration that is the whole method."""

_WORST_IS_LEAST = ('coverage_percent',)
_OVERVIEW = (
    'online_cm', 'final_cm', 'online_max_cm', 'final_max_cm', 'coverage_percent', 'lost',
    'rpe_frame_cm', 'rpe_second_cm', 'tracking_ms',
)  # fmt: skip
_SHOWN = ('online_cm', 'final_cm')


def summarise(rows: Sequence[Row]) -> dict[str, Any]:
    """Return the errors of the whole method: real recordings, then the synthetic ones."""
    full = [row for row in rows if row['configuration'] == FULL]
    summary: dict[str, Any] = {}
    for sequence in sequences.REAL:
        own = [row for row in full if row['sequence'] == sequence.name]
        for column in (*_SHOWN, 'online_max_cm', 'coverage_percent'):
            summary[f'{sequence.name}_{column}'] = median(own, column)
    synth = [row for row in full if is_synth(row)]
    for column in (*_SHOWN, 'online_max_cm', 'coverage_percent'):
        summary[f'synth_{column}_median'] = median(synth, column)
        summary[f'synth_{column}_worst'] = _worst(synth, column)
    walking = [row for row in synth if 'walking' in row['sequence']]
    summary['synth_walking_online_cm_worst'] = _worst(walking, 'online_cm')
    summary['tracking_ms_median'] = median(full, 'tracking_ms')
    return {name: value for name, value in summary.items() if value is not None}


def overviews(rows: Sequence[Row]) -> dict[str, list[dict[str, Any]]]:
    """Return a table of the whole method by recording, and one of what each part is worth."""
    tables = {
        'The whole method: median and worst over seeds': _by_recording(rows),
        'Parts left out: online / final in cm, medians over the same seeds': _by_switch(rows),
    }
    return {title: lines for title, lines in tables.items() if lines}


def draw_reliability(rows: Sequence[Row], folder: Path) -> None:
    """Draw how many poses of the whole method are as near as they say, medians over seeds."""
    from bdgs_ros.eval import plots

    found = {}
    for name in dict.fromkeys(row['sequence'] for row in rows):
        own = [r for r in rows if r['sequence'] == name and r['configuration'] == FULL]
        shares = {share: median(own, f'within_{share}_pct') for share in WITHIN}
        found[name] = {share: value for share, value in shares.items() if value is not None}
    found = {name: shares for name, shares in found.items() if shares}
    if found:
        plots.plot_reliability(folder / 'reliability.png', found)


def _by_recording(rows: Sequence[Row]) -> list[dict[str, Any]]:
    lines = []
    for name in dict.fromkeys(row['sequence'] for row in rows):
        own = [r for r in rows if r['sequence'] == name and r['configuration'] == FULL]
        if not own:
            continue
        line: dict[str, Any] = {'sequence': name, 'runs': len(own)}
        for column in _OVERVIEW:
            line[column] = median(own, column)
            line[f'{column}, worst'] = _worst(own, column)
        lines.append(line)
    return without_empty(lines)


def _by_switch(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Return a line for each recording; whole method and switches over the seeds they share."""
    configurations = list(dict.fromkeys(row['configuration'] for row in rows))
    lines = []
    for name in dict.fromkeys(row['sequence'] for row in rows):
        own = [row for row in rows if row['sequence'] == name]
        seeds = [{r['seed'] for r in own if r['configuration'] == c} for c in configurations]
        shared = set.intersection(*(s for s in seeds if s)) if any(seeds) else set()
        line: dict[str, Any] = {'sequence': name, 'runs': len(shared)}
        for configuration in configurations:
            chosen = [
                r for r in own if r['configuration'] == configuration and r['seed'] in shared
            ]
            line[configuration] = _pair(chosen)
        lines.append(line)
    return lines if len(configurations) > 1 else []


def _pair(rows: Sequence[Row]) -> str | None:
    values = [median(rows, column) for column in _SHOWN]
    return None if None in values else ' / '.join(f'{value:.2f}' for value in values)


def _worst(rows: Sequence[Row], column: str) -> float | None:
    return worst(rows, column, is_most=column not in _WORST_IS_LEAST)
