"""Bench `card`: what an NVIDIA card does to a whole run, beside the CPU of the same machine."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from bdgs_ros.bench import mapping, sequences
from bdgs_ros.bench.harness import Cell, Options
from bdgs_ros.core.config.parameter_file import read_yaml
from bdgs_ros.mapping import rasterize

NAME = 'card'
ISOLATED = True
PROTOCOL = """
As the bench mapping: every frame in order, none dropped, scores as described there. native: the
default parameters on the CPU. cuda: the same on the card. card: config/card.yaml on the card.
frames_per_s: of the whole pipeline, reading, detection (which runs ahead) and mapping included,
scoring left out. device_mb: the most that was taken of the card's memory, by torch and by the
rasteriser's own buffers.
"""

PRESET = Path(__file__).resolve().parents[2] / 'config' / 'card.yaml'
_SCENARIO = 'walking_xyz'
TABLES = {
    'Speed': (
        'frames', 'keyframes', 'frames_per_s', 'tracking_ms', 'back_end_ms', 'mapping_ms',
        'mapping_p95_ms', 'gaussians', 'device', 'device_mb', 'peak_rss_mb', 'refine_s',
        'refine_iterations', 'refined_gaussians',
    ),
    'Quality': (
        'live_psnr_db', 'after_psnr_db', 'refined_psnr_db', 'live_ssim', 'after_ssim',
        'refined_ssim', 'after_depth_l1_cm', 'ate_rmse_cm', 'ate_final_cm',
    ),
}  # fmt: skip


def cells(options: Options) -> list[Cell]:
    """List a real and a synthetic recording, on the CPU and, if there is one, on the card."""
    ways = {'native': {'mapping.backend': 'native'}}
    if 'cuda' in rasterize.available_backends():
        ways |= {'cuda': {'mapping.backend': 'cuda'}, 'card': read_yaml(PRESET)}
    refine = {'refine_s': options.refine_s}
    recordings = {sequences.REAL[0].name: sequences.real_settings(options)}
    name = sequences.synth_name(_SCENARIO)
    recordings[name] = sequences.synth_settings(_SCENARIO, options)
    configuration = 'weights' if sequences.weights_path(options).is_file() else 'geometric'
    common = {**sequences.detector_settings(configuration, options), **refine}
    return [
        Cell(recording, way, 0, {**settings, **common, 'detector': configuration, 'way': values})
        for recording, settings in recordings.items()
        for way, values in ways.items()
    ]


def run_cell(cell: Cell, options: Options) -> dict[str, Any]:
    """Run one recording in one way."""
    values = {**cell.settings['way'], **options.values}
    as_mapping = replace(cell, configuration=cell.settings['detector'])
    row = mapping.run_quality(as_mapping, replace(options, values=values))
    return {**row, **of_device(values['mapping.backend'])}


def of_device(backend: str) -> dict[str, Any]:
    """Return the card's name and the most that this process took of its memory."""
    device = rasterize.map_device(backend)
    if device is None:
        return {}
    import torch

    taken = torch.cuda.max_memory_allocated() + device.rasterizer.bytes
    return {'device': torch.cuda.get_device_name(), 'device_mb': taken / 1e6}


def summarise(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return frames per second and PSNR of every run."""
    return {
        f'{row["sequence"]}_{row["configuration"]}_{what}': row.get(what)
        for row in rows
        for what in ('frames_per_s', 'live_psnr_db', 'refined_psnr_db')
    }
