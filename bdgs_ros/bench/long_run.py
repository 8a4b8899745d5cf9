"""Is the cost of a keyframe bounded: figures by blocks of a long run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from bdgs_ros.core.types import RgbdFrame, TrackingResult
from bdgs_ros.eval import memory
from bdgs_ros.eval.recorder import FrameRow


@dataclass
class BlockWatch:
    """Watch a run: Gaussians after each keyframe, peak of memory in each block of frames."""

    mapper: Any
    """Has `map`, of which `len` is the number of Gaussians."""
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


def columns(rows: Sequence[FrameRow], watch: BlockWatch) -> dict[str, Any]:
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
    sizes = [[n for i, n in watch.gaussians if i // watch.block == b] for b in range(count)]
    settled = times[1:] or times
    return {
        'block_frames': watch.block,
        'block_mapping_ms': [round(t, 1) for t in times],
        'block_tracking_ms': [
            round(_median([r.times_ms['tracking'] for r in b]), 1) for b in blocks
        ],
        'block_keyframes': [len(s) for s in sizes],
        'block_gaussians': [round(_median(s)) if s else None for s in sizes],
        'block_peak_mb': [round(p) for p in watch.peaks_mb],
        'last_over_second': settled[-1] / settled[0],
        'growth': float(np.nanmax(settled)) / settled[0],
    }


def _median(values: Sequence[float]) -> float:
    return float(np.median(values)) if values else float('nan')
