"""Which cells of a bench the command line asks for."""

from __future__ import annotations

import difflib
import fnmatch
from collections.abc import Sequence
from typing import Protocol, TypeVar

from bdgs_ros.core.errors import ConfigError

_NAMES_SHOWN = 8  # of those that a pattern could match


class Named(Protocol):
    """What a cell is called; see `bdgs_ros.bench.harness.Cell`."""

    @property
    def sequence(self) -> str:
        """What is run."""

    @property
    def configuration(self) -> str:
        """How."""

    @property
    def label(self) -> str:
        """Both, and the seed."""


AnyCell = TypeVar('AnyCell', bound=Named)


def choose(cells: Sequence[AnyCell], only: Sequence[str], bench: str) -> list[AnyCell]:
    """
    Return the cells that a pattern matches; all of them without patterns.

    Parameters
    ----------
    cells : sequence of Cell
        All that the bench has.
    only : sequence of str
        Patterns such as `crowd*` or `*/geometric/*`, of sequence, configuration or label.
    bench : str
        Its name, for the message.

    Raises
    ------
    ConfigError
        If a pattern matches no cell.

    """
    for pattern in only:
        if not any(_matches(cell, pattern) for cell in cells):
            raise ConfigError(_no_match(pattern, cells, bench))
    return [c for c in cells if not only or any(_matches(c, pattern) for pattern in only)]


def _matches(cell: Named, pattern: str) -> bool:
    names = (cell.label, cell.sequence, cell.configuration)
    return any(fnmatch.fnmatch(name, pattern) for name in names)


def _no_match(pattern: str, cells: Sequence[Named], bench: str) -> str:
    """Say what a pattern could have matched, the likeliest first."""
    sequences = _some(pattern, [cell.sequence for cell in cells])
    configurations = _some(pattern, [cell.configuration for cell in cells])
    example = f", or a whole cell such as '{cells[0].label}'" if cells else ''
    return (
        f"--only '{pattern}' matches none of the {len(cells)} cells of bench {bench} with these "
        f'options; there are the sequences {sequences} and the configurations {configurations}'
        f'{example}'
    )


def _some(pattern: str, names: Sequence[str]) -> str:
    known = dict.fromkeys(names)
    alike = difflib.get_close_matches(pattern, known, _NAMES_SHOWN)
    shown = list(dict.fromkeys([*alike, *known]))[:_NAMES_SHOWN]
    return ', '.join(shown) + (', ...' if len(known) > len(shown) else '')
