"""`bdgs export`: a map as viewers of Gaussian splats want it."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from bdgs_ros.cli.config import add_config_arguments, load_config

NAME = 'export'
HELP = 'write a map for viewers: without what the filter hides and, with --plain, its state'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument('map', type=Path, help='map.ply of a run, or any 3DGS .ply')
    parser.add_argument('output', type=Path, help='.ply to write')
    parser.add_argument(
        '--plain', action='store_true', help='only the properties that every 3DGS .ply has'
    )
    parser.add_argument(
        '--all', action='store_true', help='also Gaussians that are hidden because they move'
    )
    add_config_arguments(parser)


def run(arguments: argparse.Namespace) -> int:
    """Read, choose, write."""
    from bdgs_ros.mapping.ply import load_ply, save_ply

    gaussians = load_ply(arguments.map, load_config(arguments).belief)
    total = len(gaussians)
    if not arguments.all:
        gaussians.keep(gaussians.visible_mask())
    save_ply(arguments.output, gaussians, state=not arguments.plain)
    sys.stdout.write(f"{len(gaussians)} of {total} Gaussians in '{arguments.output}'\n")
    return 0
