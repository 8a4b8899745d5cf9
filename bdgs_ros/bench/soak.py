"""Bench `soak`: the live graph for a long time, a random fault every half minute; does it grow."""

from __future__ import annotations

import json
import os
import signal
import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from bdgs_ros.bench import sequences
from bdgs_ros.bench.harness import Cell, Options
from bdgs_ros.bench.live import SHM, bag_of, children_of, graph_values, run_graph
from bdgs_ros.bench.sequences import REAL

NAME = 'soak'
PROTOCOL = """
slam_node replays a recording over and over at camera rate, stamps jump back each time it begins
again, and every 30 s something happens at random: tracking, mapping or detection is killed
(SIGKILL), the camera is silent for 3 s, or mapping stands still for 3 s (SIGSTOP). Once a second
the memory (RSS), open files and threads of each node are noted, and what is in shared memory and
in the journal. First a quarter of the time to warm up: growth is what a straight line through the
rest says, in MB per hour. At the end Ctrl-C, and the results have to be there.
"""
_NODES = ('slam', 'replay', 'tracking', 'mapping', 'detection')
_FAULTS = ('kill_tracking', 'kill_mapping', 'kill_detection', 'silent', 'stall_mapping')
_FAULT_PERIOD_S = 30.0
_STILL_S = 3.0
_SAMPLE_S = 1.0
_WARM_UP = 0.25
_RESULTS = ('trajectory.txt', 'trajectory_final.txt', 'map.ply', 'metrics.json')
_END_S = 30.0


def cells(options: Options) -> list[Cell]:
    """List the first real recording; other seeds are other faults."""
    settings = {
        **sequences.real_settings(options),
        **sequences.detector_settings('weights', options),
        'minutes': options.minutes,
    }
    return [Cell(REAL[0].name, 'soak', seed, settings) for seed in options.seeds]


def run_cell(cell: Cell, options: Options) -> dict[str, Any]:
    """Run the graph for some minutes, disturb it, and look at it."""
    bag = bag_of(sequences.cell_recording(cell, options), cell, options)
    output = options.work / 'runs' / cell.key
    output.mkdir(parents=True, exist_ok=True)
    for name in _RESULTS:
        (output / name).unlink(missing_ok=True)
    values = graph_values(bag, output, options)
    values |= {'exit_at_end': 'false', 'loop': 'true', 'respawns': 1000}
    watch = Watch(60.0 * cell.settings['minutes'], output / 'journal', cell.seed)
    run_graph(values, output / 'log.txt', watch.begin, watch.seconds + 2 * _END_S)
    (output / 'samples.json').write_text(json.dumps(watch.samples), encoding='utf-8')
    plot(output / 'soak.png', watch)
    log = (output / 'log.txt').read_text(encoding='utf-8', errors='replace')
    return {
        'minutes': watch.seconds / 60,
        'faults': len(watch.faults),
        'tracebacks': log.count('Traceback'),
        'results': sum((output / name).is_file() for name in _RESULTS),
        **growth(watch.samples),
    }


@dataclass
class Watch:
    """Notes what the processes of a graph use, and disturbs them, in threads of its own."""

    seconds: float
    journal: Path
    seed: int
    samples: list[dict[str, float]] = field(default_factory=list)
    faults: list[tuple[float, str]] = field(default_factory=list)
    """When, s, and what."""

    def begin(self, pid: int) -> None:
        """Watch the graph of a slam_node."""
        for work in (self._sample, self._disturb):
            threading.Thread(target=work, args=[pid, time.monotonic()], daemon=True).start()

    def _sample(self, pid: int, begun_s: float) -> None:
        while (now := time.monotonic() - begun_s) < self.seconds:
            self.samples.append({'s': now, **sample(pid, self.journal)})
            time.sleep(_SAMPLE_S)
        os.kill(pid, signal.SIGINT)

    def _disturb(self, pid: int, begun_s: float) -> None:
        rng = np.random.default_rng(self.seed)
        while True:
            time.sleep(_FAULT_PERIOD_S)
            now = time.monotonic() - begun_s
            if now > self.seconds - _FAULT_PERIOD_S / 2:
                return
            fault = str(rng.choice(_FAULTS))
            self.faults.append((now, fault))
            disturb(pid, fault)


def disturb(slam_pid: int, fault: str) -> None:
    """Do something to a graph that it has to live with."""
    how, _, node = fault.partition('_')
    for pid in children_of(slam_pid, f'bdgs_ros.nodes.{node or "replay"}_node'):
        if how == 'kill':
            os.kill(pid, signal.SIGKILL)
        else:
            os.kill(pid, signal.SIGSTOP)
            time.sleep(_STILL_S)
            os.kill(pid, signal.SIGCONT)


def sample(slam_pid: int, journal: Path) -> dict[str, float]:
    """Return what a graph uses at the moment; a node that is away is left out."""
    found: dict[str, float] = {
        'shm_mb': _bytes_in(SHM) / 1e6,
        'journal_mb': _bytes_in(journal) / 1e6,
    }
    for node in _NODES:
        module = f'bdgs_ros.nodes.{node}_node'
        pids = [slam_pid] if node == 'slam' else children_of(slam_pid, module)
        for pid in pids:
            try:
                status = Path(f'/proc/{pid}/status').read_text(encoding='ascii')
                files = len(list(Path(f'/proc/{pid}/fd').iterdir()))
            except OSError:  # it has just died
                continue
            fields = dict(line.split(':', 1) for line in status.splitlines())
            found[f'{node}_mb'] = int(fields.get('VmRSS', '0 kB').split()[0]) / 1e3
            found[f'{node}_files'] = files
            found[f'{node}_threads'] = int(fields.get('Threads', '0'))
    return found


def _bytes_in(folder: Path) -> int:
    total = 0
    for path in folder.rglob('*'):
        with suppress(OSError):  # it may have gone
            total += path.stat().st_size
    return total


def growth(samples: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Return for each column the most, and the slope per hour after the time to warm up."""
    row: dict[str, float] = {}
    late = [s for s in samples if s['s'] >= _WARM_UP * samples[-1]['s']] if samples else []
    for name in sorted({key for s in late for key in s} - {'s'}):
        known = [(s['s'] / 3600, s[name]) for s in late if name in s]
        row[f'{name}_most'] = max(value for _, value in known)
        if len(known) > 1 and not name.endswith('_threads'):
            hours, values = np.transpose(known)
            row[f'{name}_per_h'] = float(np.polyfit(hours, values, 1)[0])
    return row


def plot(path: Path, watch: Watch) -> None:
    """Draw memory, files and shared memory over time, with the faults."""
    from matplotlib.figure import Figure

    from bdgs_ros.core.files import write_aside

    figure = Figure(figsize=(10, 8))
    panels = figure.subplots(3, 1, sharex=True)
    for axes, suffix, label in zip(
        panels, ('_mb', '_files', '_mb'), ('memory, MB', 'open files', 'MB'), strict=True
    ):
        names = ('shm', 'journal') if axes is panels[2] else _NODES
        for name in names:
            known = [(s['s'] / 60, s[name + suffix]) for s in watch.samples if name + suffix in s]
            if known:
                axes.plot(*np.transpose(known), label=name, linewidth=1)
        for seconds, _ in watch.faults:
            axes.axvline(seconds / 60, color='0.85', linewidth=0.8, zorder=0)
        axes.set_ylabel(label)
        axes.legend(loc='upper left', fontsize=8, ncols=5)
    panels[2].set_xlabel('minutes; grey: something was done to a node')
    write_aside(path, lambda aside: figure.savefig(aside, dpi=90, bbox_inches='tight'))


def summarise(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return what has to be flat, the worst of all rows."""
    names = [name for row in rows for name in row if name.endswith('_per_h')]
    return {name: max(row[name] for row in rows if name in row) for name in dict.fromkeys(names)}
