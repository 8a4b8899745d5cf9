"""Is the cost of a keyframe bounded, and does the map last: figures by blocks of a long run."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from bdgs_ros.bench.map_quality import LiveScores
from bdgs_ros.core.types import RgbdFrame, TrackingResult, Trajectory
from bdgs_ros.eval import memory
from bdgs_ros.eval.recorder import FrameRow
from bdgs_ros.eval.trajectory import associate, ate


class CpuTimed:
    """Stand in front of the mapper and note the processor time of each keyframe."""

    def __init__(self, mapper: Any) -> None:
        self._mapper = mapper
        self.cpu_ms: list[float] = []

    def process(self, *arguments: Any) -> Any:
        """Pass the keyframe on."""
        start = time.process_time()
        try:
            return self._mapper.process(*arguments)
        finally:
            self.cpu_ms.append(1e3 * (time.process_time() - start))

    def __getattr__(self, name: str) -> Any:
        """Be the mapper in everything else."""
        return getattr(self._mapper, name)

    def __setattr__(self, name: str, value: Any) -> None:
        """Hand on what the back end tells the mapper."""
        object.__setattr__(self if name in ('_mapper', 'cpu_ms') else self._mapper, name, value)


@dataclass
class BlockWatch:
    """Watch a run: Gaussians after each keyframe, peak of memory in each block of frames."""

    mapper: CpuTimed
    block: int
    gaussians: list[tuple[int, int]] = field(default_factory=list)
    """(frame, Gaussians) of every keyframe."""
    peaks_mb: list[float] = field(default_factory=list)
    _index: int = -1

    def __call__(self, frame: RgbdFrame, tracking: TrackingResult) -> None:
        """Take the outcome of one frame."""
        self._index += 1
        if tracking.is_keyframe:
            self.gaussians.append((self._index, len(self.mapper.map)))
        if (self._index + 1) % self.block == 0:
            self._end_block()

    def finish(self) -> None:
        """Close the last block if it is not complete."""
        if (self._index + 1) % self.block:
            self._end_block()

    def _end_block(self) -> None:
        self.peaks_mb.append(memory.peak_mb())
        memory.restart_peak()


def columns(rows: Sequence[FrameRow], watch: BlockWatch, quality: LiveScores) -> dict[str, Any]:
    """
    Return the figures of every block, and how they grow after the first.

    Returns
    -------
    columns : dict
        `block_*`: lists, one entry per block. `last_over_second`: median milliseconds per
        keyframe in the last block over those in the second; the map fills in the first.
        `growth`: the largest over the second, from the second on.

    """
    count = -(-len(rows) // watch.block)
    blocks = [rows[i * watch.block : (i + 1) * watch.block] for i in range(count)]
    times = [
        _median([r.times_ms['mapping'] for r in b if 'mapping' in r.times_ms]) for b in blocks
    ]
    kept = watch.gaussians
    sizes = [[n for i, n in kept if i // watch.block == b] for b in range(count)]
    costs = zip(kept, watch.mapper.cpu_ms, strict=True)
    by_block = [(i // watch.block, ms) for (i, _), ms in costs]
    scored = list(zip(quality.live_at, quality.live, strict=True))
    cpu = [_median([ms for of, ms in by_block if of == b]) for b in range(count)]
    return {
        'block_frames': watch.block,
        'block_mapping_ms': [round(t, 1) for t in times],
        'block_mapping_cpu_ms': [round(t, 1) for t in cpu],
        'block_tracking_ms': [
            round(_median([r.times_ms['tracking'] for r in b]), 1) for b in blocks
        ],
        'block_back_end_ms': [
            round(_median([r.times_ms['back_end'] for r in b if 'back_end' in r.times_ms]), 1)
            for b in blocks
        ],
        'block_keyframes': [len(s) for s in sizes],
        'block_gaussians': [round(_median(s)) if s else None for s in sizes],
        'block_live_psnr_db': _means(scored, 'psnr', watch.block, count),
        'block_live_seen_percent': _means(scored, 'seen', watch.block, count),
        'block_peak_mb': [round(p) for p in watch.peaks_mb],
        'last_over_second': times[-1] / (times[1:] or times)[0],
        'growth': _growth(times),
        'cpu_growth': _growth(cpu),
    }


def drift_cm(truth: Trajectory, final: Trajectory, block: int) -> list[float]:
    """
    Return the RMS position error of each block of poses when only the first block is aligned.

    Where a recording comes back to its start, drift shows as blocks that get worse.
    """
    T_truth_world = ate(truth, Trajectory(final.poses[:block])).T_gt_est
    drift = []
    for start in range(0, len(final), block):
        part = Trajectory(final.poses[start : start + block])
        true_rows, rows = associate(truth, part)
        positions = part.positions[rows] @ T_truth_world[:3, :3].T + T_truth_world[:3, 3]
        away = np.linalg.norm(positions - truth.positions[true_rows], axis=1)
        drift.append(round(100 * float(np.sqrt(np.mean(away**2))), 2))
    return drift


def _means(
    scored: Sequence[tuple[int, Mapping[str, float]]], name: str, block: int, count: int
) -> list[float | None]:
    """Return the mean of a score in each block, None where none was scored."""
    values = [[s[name] for i, s in scored if i // block == b] for b in range(count)]
    return [round(float(np.nanmean(v)), 2) if v else None for v in values]


def _growth(costs: Sequence[float]) -> float:
    settled = costs[1:] or costs
    return float(np.nanmax(settled)) / settled[0]


def _median(values: Sequence[float]) -> float:
    return float(np.median(values)) if values else float('nan')
