"""Weights are chosen on held-out seeds, reported, and written in forms that can be used."""

from __future__ import annotations

import ast
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bdgs_ros.belief.filter import sigmoid
from bdgs_ros.belief.likelihood import FEATURES
from bdgs_ros.belief.sightings import Sightings
from bdgs_ros.bench import likelihood_material
from bdgs_ros.bench.likelihood_fit import Learned, bounds, held_out, learn, pool, scored
from bdgs_ros.bench.likelihood_material import MAP, SHADOW, Material, Source
from bdgs_ros.bench.likelihood_report import (
    as_module,
    parts,
    provenance_of,
    rounded,
    write_report,
)
from bdgs_ros.cli.config import read_yaml
from bdgs_ros.cli.main import main
from bdgs_ros.core.config import BdgsConfig, BeliefConfig, specs
from bdgs_ros.core.config.likelihood_fit import PROVENANCE, WEIGHTS
from bdgs_ros.core.errors import EvaluationError, ModelError
from bdgs_ros.data.synth import write_recording

CONFIG = BeliefConfig(decay_rate=0.5)
TRUE = {'prior': 4.0, 'free_space': 6.0, 'agreement': -2.0}
SECOND_NS = 1_000_000_000


def generated(seed: int, gaussians: int = 400, keyframes: int = 6) -> Sightings:
    """Every keyframe sees every Gaussian; the truth is drawn by what one keyframe shows."""
    rng = np.random.default_rng(seed)
    rows = gaussians * keyframes
    features = np.zeros((rows, len(FEATURES)), np.float32)
    for name in TRUE:
        features[:, FEATURES.index(name)] = rng.random(rows)
    features[:, FEATURES.index('color')] = rng.random(rows)  # says nothing
    log_odds = sum(w * features[:, FEATURES.index(n)] for n, w in TRUE.items()) - 2.5
    keyframe = np.repeat(np.arange(keyframes, dtype=np.int32), gaussians)
    return Sightings(
        names=np.array(FEATURES),
        stamps_ns=np.arange(keyframes) * 100 * SECOND_NS,  # the past is forgotten
        born_at=np.zeros(gaussians, np.int32),
        initial=np.full(gaussians, 0.5, np.float32),
        gaussian=np.tile(np.arange(gaussians, dtype=np.int32), keyframes),
        seen_at=keyframe,
        known_at=keyframe,
        features=features,
        truth=(rng.random(rows) < sigmoid(log_odds)).astype(np.int8),
        posterior=np.full(rows, 0.5, np.float32),
    )


def materials(seeds: tuple[int, ...] = (100, 101)) -> list[Material]:
    found = []
    for seed in seeds:
        for scenario in ('crowd', 'unknown_box'):
            source = Source(scenario, seed, 60, 'geometric')
            seen = {SHADOW: generated(seed), MAP: generated(seed + 50, gaussians=100)}
            found.append(Material(source, seen))
    return found


@pytest.fixture(scope='module')
def learned() -> Learned:
    return learn(materials(), CONFIG)


def test_what_matters_is_learned_and_what_does_not_is_small(learned: Learned) -> None:
    found = rounded(learned)
    assert found['prior'] > 2
    assert found['free_space'] > 3
    assert found['agreement'] < -1.5
    assert abs(found['color']) < 0.6
    assert found['streak'] == 0  # never occurs


def test_held_out_predictions_are_better_than_before(learned: Learned) -> None:
    before, fitted = (scored(learned.pool, learned.log_odds[n]) for n in ('before', 'fitted'))
    assert fitted.log_loss < before.log_loss
    assert fitted.brier < before.brier
    without = scored(learned.pool, learned.log_odds['without free_space'])
    assert without.log_loss > fitted.log_loss + 0.01


def test_a_seed_is_predicted_without_it(learned: Learned) -> None:
    found = pool(materials(), CONFIG.decay_rate)
    honest = held_out(found, learned.settings)
    flipped = found.of('seed', 101)
    found.examples.truth[flipped] ^= True
    np.testing.assert_array_equal(held_out(found, learned.settings)[flipped], honest[flipped])


def test_signs_that_are_known_hold_and_features_can_be_left_out() -> None:
    limits = dict(zip(FEATURES, bounds(['bias']), strict=True))
    assert limits['prior'] == (0.0, None)
    assert limits['streak'] == (None, 0.0)
    assert limits['bias'] == (0.0, 0.0)
    found = learn(materials(), CONFIG, without=('free_space', 'color'))
    assert rounded(found)['free_space'] == 0
    assert {'with free_space', 'without prior'} <= set(found.log_odds)


def test_settings_are_chosen_by_the_log_loss() -> None:
    found = learn(materials(), CONFIG, decay_rates=(0.001, 1.0), clamps=(2.0, 4.0))
    losses = [trial.log_loss for trial in found.trials]
    assert losses == sorted(losses)
    assert len(losses) == 12
    assert found.settings.decay_rate == 1.0  # each keyframe speaks for itself alone


def test_one_seed_is_not_enough() -> None:
    with pytest.raises(EvaluationError, match=r'only \[100\]; give at least two'):
        learn(materials((100,)), CONFIG)


def test_the_report_has_every_table(learned: Learned, tmp_path: Path) -> None:
    write_report(tmp_path, learned, CONFIG, provenance(learned))
    text = (tmp_path / 'report.md').read_text()
    for title in (*parts(learned), 'Weights', 'Each feature left out', 'Reliability'):
        assert f'## {title}' in text
    assert '| without free_space |' in text
    assert (tmp_path / 'reliability.png').is_file()


def provenance(learned: Learned) -> dict[str, Any]:
    return provenance_of(learned, CONFIG, 'bdgs fit-likelihood', 'abc', '2026-01-01')


def test_the_module_of_defaults_is_python_with_the_same_content(learned: Learned) -> None:
    command = 'bdgs fit-likelihood' + 20 * ' --set name=value'
    text = as_module(rounded(learned), {**provenance(learned), 'command': command})
    values: dict[str, Any] = {}
    exec(compile(ast.parse(text), 'likelihood_fit.py', 'exec'), values)
    assert values['WEIGHTS'] == rounded(learned)
    assert values['PROVENANCE']['seeds'] == [100, 101]
    assert values['PROVENANCE']['command'] == command
    assert max(map(len, text.splitlines())) < 100


def test_shipped_weights_are_the_defaults_of_all_features() -> None:
    prefix = 'belief.likelihood.w_'
    defaults = {s.name: s.value for s in specs(BdgsConfig()) if s.name.startswith(prefix)}
    assert {f'{prefix}{name}': weight for name, weight in WEIGHTS.items()} == defaults
    assert tuple(WEIGHTS) == FEATURES
    assert not {0, 1, 2, 3, 4} & set(PROVENANCE['seeds'])  # what is evaluated


def test_without_weights_of_the_detector_it_says_so(tmp_path: Path) -> None:
    source = Source('static', 0, 8, 'weights')
    with pytest.raises(ModelError, match='--weights'):
        likelihood_material.collect(source, BdgsConfig(), tmp_path / 'absent.onnx', tmp_path)


def test_names_that_are_not_known_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    common = ['fit-likelihood', '--output', str(tmp_path)]
    assert main([*common, '--scenarios', 'beach']) == 2
    assert "no scenario ['beach']" in capsys.readouterr().err
    assert main([*common, '--without', 'smell']) == 2
    assert "no feature ['smell']" in capsys.readouterr().err


def test_command_on_tiny_recordings(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for seed in (100, 101):
        folder = tmp_path / 'work' / 'synth' / f'walking_static_{seed}_16'
        write_recording(folder, 'walking_static', seed, 16, size=(160, 120), jobs=1)
    arguments = [
        'fit-likelihood', '--output', str(tmp_path / 'out'), '--work', str(tmp_path / 'work'),
        '--scenarios', 'walking_static', '--frames', '16', '--no-weights',
        '--set', 'mapping.iterations=1', '--set', 'tracking.keyframe.max_interval=3',
    ]  # fmt: skip
    assert main(arguments) == 0
    assert 'on held-out seeds' in capsys.readouterr().out
    values = read_yaml(tmp_path / 'out' / 'likelihood.yaml')
    assert {f'belief.likelihood.w_{name}' for name in FEATURES} < set(values)
    assert main(['config', '--config', str(tmp_path / 'out' / 'likelihood.yaml')]) == 0
    assert len(list((tmp_path / 'work' / 'likelihood').glob('*.npz'))) == 4
