"""What `bdgs fit-likelihood` leaves: report, reliability plot, and the defaults as a module."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bdgs_ros.belief import likelihood
from bdgs_ros.belief.likelihood import FEATURES
from bdgs_ros.bench.likelihood_fit import Learned, scored
from bdgs_ros.core.config import BeliefConfig
from bdgs_ros.core.files import write_text
from bdgs_ros.eval.calibration import (
    Calibration,
    calibration,
    plot_reliability,
    reliability_table,
)
from bdgs_ros.eval.metric import dump_json, markdown_table, ratio

Mask = NDArray[np.bool_]

_DECIMALS = 3  # of a weight; the spread between seeds is larger
_LONG = 80  # characters, beyond which a text in the module goes over several lines
_PLOT = 'reliability.png'
_PROTOCOL = """
Every run is the whole pipeline on a synthetic recording. Examples are Gaussians at the keyframes
that saw them: those of a shadow map, random pixels that no mask kept out, and every eighth of the
map itself. They are dynamic if nothing of the static world of that time is where they are; what is
too near to a surface to tell is left out. Predictions are what the filter says after all evidence
up to then; `fitted` predicts each seed with the weights that the other seeds give. `recall` and
`precision` are those of the rendering mask of Eq. 11, without hysteresis and smoothing.
"""


class Scorer:
    """Scores of variants of the weights on parts of the examples."""

    def __init__(self, learned: Learned, config: BeliefConfig) -> None:
        self._learned = learned
        self._config = config

    def calibration(self, variant: str, rows: Mask) -> Calibration:
        """Return the scores of a variant of `Learned.log_odds` on some examples."""
        log_odds = self._learned.log_odds[variant]
        return scored(self._learned.pool, log_odds, rows)

    def row(self, variant: str, rows: Mask) -> dict[str, Any]:
        """Return the same as a row of a table, with what the mask of Eq. 11 would do."""
        threshold = self._config.mask_threshold
        hidden = self._learned.log_odds[variant][rows] > np.log(threshold / (1 - threshold))
        truth = self._learned.pool.examples.truth[rows]
        both = int(np.count_nonzero(hidden & truth))
        return {
            **self.calibration(variant, rows).row(),
            'recall': ratio(both, int(np.count_nonzero(truth))),
            'precision': ratio(both, int(np.count_nonzero(hidden))),
        }

    def table(self, parts: Mapping[str, Mask], variants: tuple[str, ...]) -> str:
        """Write a row for each part that has examples and each variant."""
        rows = [
            {'part': name, 'weights': variant, **self.row(variant, part)}
            for name, part in parts.items()
            if part.any()
            for variant in variants
        ]
        return markdown_table(rows)


def parts(learned: Learned) -> dict[str, dict[str, Mask]]:
    """Return the examples by what is asked about them: title of a table to name to rows."""
    pool = learned.pool
    shadow = ~pool.map
    count = pool.count
    evidence = {
        '1 keyframe': count == 1,
        '2 keyframes': count == 2,
        '3 keyframes': count == 3,
        '4 to 8': (count > 3) & (count <= 8),
        'more': count > 8,
    }
    return {
        'By kind': {'shadow': shadow, 'map': pool.map},
        'By evidence (shadow)': {name: rows & shadow for name, rows in evidence.items()},
        'By prior (shadow)': {
            name: shadow & pool.of('detector', name)
            for name in sorted({source.detector for source in pool.sources})
        },
        'By scenario (shadow)': {
            name: shadow & pool.of('scenario', name)
            for name in sorted({source.scenario for source in pool.sources})
        },
    }


def write_report(
    folder: Path, learned: Learned, config: BeliefConfig, provenance: Mapping[str, Any]
) -> None:
    """
    Write `report.md` and `reliability.png`.

    Parameters
    ----------
    folder : Path
        Where to.
    learned : Learned
        The weights and what they predict.
    config : BeliefConfig
        What was in force before.
    provenance : mapping
        See `provenance_of`.

    """
    scorer = Scorer(learned, config)
    shadow = ~learned.pool.map
    compared = ('before', 'fitted')
    curves = {name: scorer.calibration(name, shadow) for name in compared}
    plot_reliability(folder / _PLOT, curves)
    pages = [
        '# bdgs fit-likelihood\n',
        ' '.join(_PROTOCOL.split()) + '\n',
        f'```\n{dump_json(provenance)}\n```\n',
        f'## Weights\n\n{_weights_table(learned, config)}',
        f'## Choice of alpha and shrinkage\n\n{_trials_table(learned)}',
    ]
    for title, named in parts(learned).items():
        pages.append(f'## {title}\n\n{scorer.table(named, compared)}')
    left_out = tuple(name for name in learned.log_odds if name != 'before')
    pages.append(
        f'## Each feature left out, or back in\n\n{scorer.table({"shadow": shadow}, left_out)}'
    )
    pages.append(f'## Reliability (shadow)\n\n![reliability]({_PLOT})\n')
    pages += [f'### {name}\n\n{reliability_table(curve)}' for name, curve in curves.items()]
    in_run = calibration(learned.pool.posterior[shadow], learned.pool.examples.truth[shadow])
    pages.append(f'## The filter in the run itself (shadow)\n\n{markdown_table([in_run.row()])}')
    write_text(folder / 'report.md', '\n'.join(pages))


def _weights_table(learned: Learned, config: BeliefConfig) -> str:
    before = likelihood.weights(config.likelihood)
    rows = [
        {'feature': name, 'before': float(old), 'fitted': new}
        for (name, new), old in zip(rounded(learned).items(), before, strict=True)
    ]
    return markdown_table(rows)


def _trials_table(learned: Learned) -> str:
    rows = [
        {
            'alpha': trial.settings.decay_rate,
            'clamp': trial.settings.clamps.known,
            'shrinkage': trial.settings.shrinkage,
            'log_loss': trial.log_loss,
        }
        for trial in learned.trials
    ]
    return markdown_table(rows)


def rounded(learned: Learned) -> dict[str, float]:
    """Return the weights by feature, with as many digits as they are known to."""
    return {
        name: round(float(weight), _DECIMALS) + 0.0  # no -0.0
        for name, weight in zip(FEATURES, learned.weights, strict=True)
    }


def provenance_of(
    learned: Learned, config: BeliefConfig, command: str, commit: str, date: str
) -> dict[str, Any]:
    """Return where the weights come from and how good they are, as plain values."""
    pool = learned.pool
    shadow = ~pool.map
    held_out = Scorer(learned, config).calibration('fitted', shadow)
    return {
        'command': command,
        'commit': commit,
        'date': date,
        'scenarios': sorted({source.scenario for source in pool.sources}),
        'seeds': pool.seeds,
        'frames': sorted({source.frames for source in pool.sources}),
        'priors': sorted({source.detector for source in pool.sources}),
        'examples': len(pool.examples),
        'dynamic_examples': int(np.count_nonzero(pool.examples.truth)),
        'without': list(learned.settings.without),
        'decay_rate': learned.settings.decay_rate,
        'max_log_odds': learned.settings.clamps.known,
        'shrinkage': learned.settings.shrinkage,
        'held_out_log_loss': round(held_out.log_loss, 5),
        'held_out_brier': round(held_out.brier, 5),
    }


def as_module(weights: Mapping[str, float], provenance: Mapping[str, Any]) -> str:
    """Write weights and provenance as the Python module that holds the defaults."""
    return (
        '"""The weights of Eq. 3 and where they come from. Generated by '
        '`bdgs fit-likelihood --ship`."""\n\n'
        'from __future__ import annotations\n\n'
        f'WEIGHTS: dict[str, float] = {_literal(weights)}\n\n'
        f'PROVENANCE: dict[str, str | int | float | list[str] | list[int]] = '
        f'{_literal(provenance)}\n'
    )


def _literal(values: Mapping[str, Any]) -> str:
    """Write a dict with an entry on each line, as the formatter of this project would."""
    lines = []
    for key, value in values.items():
        if isinstance(value, list):
            lines.append(f'    {key!r}: [\n{_lines(value)}    ],\n')
        elif isinstance(value, str) and len(value) > _LONG:
            lines.append(f'    {key!r}: (\n{_lines(_pieces(value), "")}    ),\n')
        else:
            lines.append(f'    {key!r}: {value!r},\n')
    return '{\n' + ''.join(lines) + '}'


def _lines(values: Sequence[Any], end: str = ',') -> str:
    return ''.join(f'        {value!r}{end}\n' for value in values)


def _pieces(text: str) -> list[str]:
    """Cut a text behind spaces; together the pieces are the text."""
    found = textwrap.wrap(text, _LONG)
    return [*(f'{piece} ' for piece in found[:-1]), found[-1]]
