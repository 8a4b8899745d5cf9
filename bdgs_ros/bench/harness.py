"""
The harness of all benches: run cells, keep each result, write `results.json` and a table.

A bench is a module with `NAME`, `PROTOCOL` (one paragraph), `cells(options)`,
`run_cell(cell, options)` and `summarise(rows)`. Every finished cell is a file of its own, so a
run that was interrupted goes on where it stopped. More is optional:

- `TABLES`: titles with the columns of each, where one table would be too wide;
- `overviews(rows)`: further tables, title to rows, of the rows that succeeded;
- `draw(rows, folder)`: pictures of them;
- `SEEDS`: how many random seeds unless the command line says so (1);
- `ISOLATED = True`: every cell has a process of its own, so that its peak of memory is not that
  of the cell before;
- `PARALLEL = True`: cells may run beside each other, `jobs` of them. Times are then no measure
  of anything: columns that end in `_ms` are left out, and the row says how many ran at once.
  `prepare(cell, options)` is called before, for what several cells share.
"""

from __future__ import annotations

import hashlib
import json
import logging
import multiprocessing
import re
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Protocol

from bdgs_ros.bench import parallel
from bdgs_ros.bench.choice import choose
from bdgs_ros.core.errors import BdgsError
from bdgs_ros.core.files import write_text
from bdgs_ros.eval import provenance
from bdgs_ros.eval.metric import dump_json, format_value, jsonable, markdown_table

_LOGGER = logging.getLogger(__name__)
_IDENTITY = ('sequence', 'configuration', 'seed')
_Placed = tuple[int, dict[str, Any]]  # place among the cells, row


@dataclass(frozen=True)
class Cell:
    """One measurement: what, how, and which random seed."""

    sequence: str
    configuration: str
    seed: int = 0
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Everything else that decides the result; part of the cell's identity."""

    @property
    def key(self) -> str:
        """A file name that is the same for the same measurement, readable at its start."""
        text = json.dumps(jsonable(asdict(self)), sort_keys=True)
        digest = hashlib.sha256(text.encode()).hexdigest()[:10]
        label = re.sub(r'[^A-Za-z0-9.]+', '_', self.label)
        return f'{label}-{digest}'

    @property
    def label(self) -> str:
        """What people and `--only` call the cell."""
        return f'{self.sequence}/{self.configuration}/{self.seed}'


@dataclass(frozen=True)
class Options:
    """What the command line says to every bench."""

    work: Path
    """Where cells, recordings and results are kept."""
    data: Path
    """The folder that holds `data/` and `models/`."""
    quick: bool = False
    seeds: tuple[int, ...] = (0,)
    weights: Path | None = None
    values: Mapping[str, Any] = field(default_factory=dict)
    """Parameters that differ from the defaults, for every configuration."""
    all_cells: bool = False
    """Measure also what the bench leaves out by default."""
    refine_s: float = 60.0
    """Seconds of refinement after a run; 0 for none."""
    beside: tuple[int, ...] = (0,)
    """How many other processes use a processor each, of live runs."""
    rates: tuple[float, ...] = (1.0,)
    """Of the replay, of live runs."""
    jobs: int = 1
    """Cells that run at once, where the bench allows it."""
    minutes: float = 10.0
    """For how long the graph is disturbed."""


_RunCell = Callable[[Cell, Options], dict[str, Any]]


class Bench(Protocol):
    """What a bench module offers."""

    NAME: str
    PROTOCOL: str

    def cells(self, options: Options) -> list[Cell]:
        """List what is to be measured."""

    def run_cell(self, cell: Cell, options: Options) -> dict[str, Any]:
        """Measure one cell; returns the columns of its row."""

    def summarise(self, rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
        """Boil the rows that succeeded down to a few figures."""


def run_bench(
    bench: Bench, options: Options, only: Sequence[str] = (), force: bool = False
) -> dict[str, Any]:
    """
    Measure every cell that has no result yet, and write all results.

    Parameters
    ----------
    bench : module
        See the top of this file.
    options : Options
        Where and how.
    only : sequence of str
        Patterns such as `crowd*` or `*/geometric/*`; a cell whose label, sequence or
        configuration matches one is measured. All by default.
    force : bool
        Measure again what has a result.

    Returns
    -------
    results : dict
        `summary`, `rows`, `protocol` and provenance, as in `results.json`. A cell that failed is
        a row with `error`; it is tried again next time.

    Raises
    ------
    ConfigError
        If a pattern matches no cell.

    """
    from tqdm import tqdm

    chosen = choose(bench.cells(options), only, bench.NAME)
    parallel_safe = getattr(bench, 'PARALLEL', False)
    run = _at_once if parallel_safe and options.jobs > 1 else _in_turn
    rows: dict[int, dict[str, Any]] = {}
    with tqdm(
        total=len(chosen), desc=bench.NAME, unit='cell', file=sys.stderr, leave=False
    ) as bar:
        for place, row in run(bench, chosen, options, force):
            rows[place] = row
            bar.set_postfix_str(chosen[place].label)
            bar.update()
    results = _document(bench, options, [rows[place] for place in range(len(chosen))])
    write_text(options.work / 'results.json', dump_json(results) + '\n')
    write_text(options.work / 'results.md', to_markdown(results))
    draw = getattr(bench, 'draw', None)
    if draw is not None:
        draw([row for row in results['rows'] if 'error' not in row], options.work)
    return results


def _in_turn(
    bench: Bench, cells: Sequence[Cell], options: Options, force: bool
) -> Iterator[_Placed]:
    isolated = getattr(bench, 'ISOLATED', False)
    run_cell = partial(_run_isolated, bench.run_cell) if isolated else bench.run_cell
    for place, cell in enumerate(cells):
        row = None if force else _kept(cell, options)
        yield place, row or _measured(run_cell, cell, options)


def _at_once(
    bench: Bench, cells: Sequence[Cell], options: Options, force: bool
) -> Iterator[_Placed]:
    """Measure cells in processes of one thread each; rows come as they are done."""
    with parallel.pool(options.jobs) as workers:
        places = {}
        for place, cell in enumerate(cells):
            row = None if force else _kept(cell, options)
            if row is not None:
                yield place, row
                continue
            _prepare(bench, cell, options)
            places[workers.submit(_measured, bench.run_cell, cell, options, options.jobs)] = place
        for future in as_completed(places):
            yield places[future], future.result()


def _prepare(bench: Bench, cell: Cell, options: Options) -> None:
    """Let the bench make what several cells share; the cell itself will say what is wrong."""
    with suppress(BdgsError):
        getattr(bench, 'prepare', lambda cell, options: None)(cell, options)


def _cell_path(cell: Cell, options: Options) -> Path:
    return options.work / 'cells' / f'{cell.key}.json'


def _kept(cell: Cell, options: Options) -> dict[str, Any] | None:
    """Return the row of a cell that was measured before."""
    path = _cell_path(cell, options)
    if not path.is_file():
        return None
    row: dict[str, Any] = json.loads(path.read_text(encoding='utf-8'))
    return row


def _measured(run_cell: _RunCell, cell: Cell, options: Options, jobs: int = 1) -> dict[str, Any]:
    """Return the row of a cell and keep it; one that failed says why and is not kept."""
    row = {'sequence': cell.sequence, 'configuration': cell.configuration, 'seed': cell.seed}
    start = time.perf_counter()
    try:
        row.update(run_cell(cell, options))
    except BdgsError as error:
        _LOGGER.warning('%s failed: %s', cell.label, error)
        return {**row, 'error': str(error)}
    row.update(wall_s=time.perf_counter() - start, commit=provenance.commit())
    if jobs > 1:
        row = {name: value for name, value in row.items() if not name.endswith('_ms')}
        row['jobs'] = jobs
    row = dict(jsonable(row))
    write_text(_cell_path(cell, options), dump_json(row) + '\n')
    return row


def _run_isolated(run_cell: _RunCell, cell: Cell, options: Options) -> dict[str, Any]:
    # spawn: a fork would start with the memory, and the threads, of this process
    context = multiprocessing.get_context('spawn')
    with ProcessPoolExecutor(1, mp_context=context) as pool:
        row = pool.submit(run_cell, cell, options).result()
    return dict(row)


def _document(bench: Bench, options: Options, rows: list[dict[str, Any]]) -> dict[str, Any]:
    good = [row for row in rows if 'error' not in row]
    overviews = getattr(bench, 'overviews', None)
    return {
        'bench': bench.NAME,
        'summary': bench.summarise(good) if good else {},
        'overviews': overviews(good) if good and overviews is not None else {},
        'rows': rows,
        'tables': {k: list(v) for k, v in getattr(bench, 'TABLES', {}).items()},
        'failed': len(rows) - len(good),
        'protocol': ' '.join(bench.PROTOCOL.split()),
        'quick': options.quick,
        'parameters': dict(options.values),
        'commits': sorted({row['commit'] for row in good}),
        'provenance': provenance.provenance(),
    }


def to_markdown(results: Mapping[str, Any]) -> str:
    """Write results as a page: how they were made, the rows, the summary."""
    machine = results['provenance']['machine']
    hidden = ('commit', 'wall_s', 'counts')
    rows = [{k: _cell_text(v) for k, v in r.items() if k not in hidden} for r in results['rows']]
    summary = [{'figure': k, 'value': v} for k, v in results['summary'].items()]
    quick = ' Quick: shortened, not for comparison.' if results['quick'] else ''
    return (
        f'# bdgs bench {results["bench"]}\n\n{results["protocol"]}{quick}\n\n'
        f'Commit {", ".join(results["commits"]) or "-"}; {machine["processor"]}, '
        f'{machine["cores"]} cores; Python {machine["python"]}.\n\n'
        f'{_tables(rows, results["tables"])}\n{_overviews(results)}{markdown_table(summary)}'
    )


def _overviews(results: Mapping[str, Any]) -> str:
    tables = results.get('overviews', {}).items()
    return ''.join(f'## {title}\n\n{markdown_table(rows)}\n' for title, rows in tables)


def _tables(rows: list[dict[str, Any]], tables: Mapping[str, Sequence[str]]) -> str:
    """Write one table, or one for each title of the rows and columns that have anything in it."""
    if not tables:
        return markdown_table(rows)
    pages = []
    for title, columns in tables.items():
        measured = [c for c in columns if any(row.get(c) is not None for row in rows)]
        chosen = [r for r in rows if 'error' in r or any(r.get(c) is not None for c in measured)]
        names = [*_IDENTITY, *measured, *(['error'] if any('error' in r for r in chosen) else [])]
        if chosen:
            pages.append(f'## {title}\n\n{markdown_table(chosen, names)}')
    return '\n'.join(pages)


def _cell_text(value: Any) -> Any:
    """Write a list of figures as one cell."""
    return ' / '.join(map(format_value, value)) if isinstance(value, list) else value
