"""The graph as users start it, on a recording that is replayed at camera rate."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from bdgs_ros.bench import sequences
from bdgs_ros.bench.harness import Cell, Options
from bdgs_ros.core.errors import BdgsError

SHM = Path('/dev/shm')
"""Where Fast DDS has its files; they are looked at."""
_TIMEOUT_S = 300.0
_BUSY = f"""
import time
end = time.monotonic() + {_TIMEOUT_S}
while time.monotonic() < end:
    pass
"""  # ends by itself, should the bench be killed
_CAMERA_HZ = 30.0


def bag_of(recording: Path, cell: Cell, options: Options) -> Path:
    """Return the recording as a bag, converted now if it was not yet."""
    from bdgs_ros.data.convert import ConvertOptions, convert

    limit = sequences.frame_limit(cell)
    bag = options.work / 'bags' / f'{recording.name}{"" if limit is None else f"_{limit}"}'
    if not (bag / 'metadata.yaml').is_file():
        duration_s = None if limit is None else limit / _CAMERA_HZ
        convert(recording, bag, ConvertOptions(duration_s=duration_s))
    return bag


def graph_values(bag: Path, output: Path, options: Options) -> dict[str, Any]:
    """Return the parameters by which the graph runs over a bag and ends."""
    return {
        'bag': bag.resolve(),
        'output': output.resolve(),
        'exit_at_end': 'true',
        'mode': 'realtime',
        'detection.weights': sequences.weights_path(options).resolve(),
        **options.values,
    }


@contextmanager
def busy_processes(count: int) -> Iterator[None]:
    """Have other processes use a processor each, in sessions of their own."""
    command = [sys.executable, '-c', _BUSY]
    busy = [subprocess.Popen(command, start_new_session=True) for _ in range(count)]
    try:
        yield
    finally:
        for process in busy:
            process.kill()
            process.wait()


def children_of(pid: int, module: str) -> list[int]:
    """Return the children of a process that run a module (Linux)."""
    path = Path(f'/proc/{pid}/task/{pid}/children')
    found = path.read_text(encoding='ascii').split() if path.exists() else []
    return [int(child) for child in found if module in _command(int(child))]


def _command(pid: int) -> list[str]:
    """Return the command line of a process; nothing if it has ended."""
    with suppress(OSError):
        return Path(f'/proc/{pid}/cmdline').read_bytes().decode().split('\0')
    return []


def run_graph(
    values: Mapping[str, Any],
    log: Path,
    watch: Callable[[int], None] = lambda pid: None,
    timeout_s: float = _TIMEOUT_S,
) -> None:
    """
    Run slam_node to its end.

    Parameters
    ----------
    values : mapping
        Parameters.
    log : Path
        Where its output goes.
    watch : callable
        Called with its process id once it runs.
    timeout_s : float
        For all of it.

    Raises
    ------
    BdgsError
        If it does not end well.

    """
    command = [sys.executable, '-m', 'bdgs_ros.nodes.slam_node', '--ros-args']
    for name, value in values.items():
        command += ['-p', f'{name}:={value}']
    domain = os.environ.get('ROS_DOMAIN_ID', str(10 + os.getpid() % 90))
    environment = {
        'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
        **os.environ,
        'ROS_DOMAIN_ID': domain,
    }
    with log.open('wb') as file:
        process = subprocess.Popen(command, env=environment, stdout=file, stderr=subprocess.STDOUT)
        try:
            watch(process.pid)
            status = process.wait(timeout_s)
        except subprocess.TimeoutExpired as error:
            raise BdgsError(f"the graph did not end ({error}); see '{log}'") from error
        finally:
            process.kill()
            process.wait()
    if status:
        raise BdgsError(f"the graph ended with status {status}; see '{log}'")
