"""The command `bdgs`: one subcommand per module of this package."""

from __future__ import annotations

import argparse
import logging
import sys
from collections.abc import Sequence
from types import ModuleType

from bdgs_ros.cli import (
    bench,
    config,
    convert,
    demo,
    eval,
    export,
    fit_likelihood,
    info,
    refine,
    report,
    run,
    synth,
)
from bdgs_ros.core.errors import BdgsError

# Each has NAME, HELP, add_arguments(parser) and run(arguments) -> exit code.
_MODULES: tuple[ModuleType, ...] = (
    synth, convert, info, run, refine, export, eval, report, bench,
    fit_likelihood, config, demo,
)  # fmt: skip

_FAILED = 2
_INTERRUPTED = 130


def build_parser() -> argparse.ArgumentParser:
    """Assemble the parser of all subcommands."""
    parser = argparse.ArgumentParser(
        prog='bdgs', description='Gaussian-splatting RGB-D SLAM among moving people.'
    )
    parser.add_argument(
        '-v', '--verbose', action='store_true', help='log what is going on, to stderr'
    )
    subparsers = parser.add_subparsers(dest='command', required=True, metavar='COMMAND')
    for module in _MODULES:
        sub = subparsers.add_parser(module.NAME, help=module.HELP, description=module.HELP)
        module.add_arguments(sub)
        sub.set_defaults(run=module.run)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run one subcommand; errors that were foreseen are one line on stderr and exit code 2."""
    arguments = build_parser().parse_args(argv)
    logging.basicConfig(
        level=logging.INFO if arguments.verbose else logging.WARNING,
        format='%(levelname)s: %(message)s',
    )
    try:
        return int(arguments.run(arguments))
    except (BdgsError, OSError) as error:
        sys.stderr.write(f'bdgs {arguments.command}: {error}\n')
        return _FAILED
    except KeyboardInterrupt:
        sys.stderr.write(f'bdgs {arguments.command}: interrupted\n')
        return _INTERRUPTED


if __name__ == '__main__':
    sys.exit(main())
