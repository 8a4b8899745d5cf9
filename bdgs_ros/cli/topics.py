"""The options by which commands are told what a camera's topics are called in a bag."""

from __future__ import annotations

import argparse

from bdgs_ros.data.bag_recording import CameraTopics

_MEANINGS = {'color': 'colour images', 'depth': 'depth images', 'info': 'camera_info'}


def add_topic_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    for name, meaning in _MEANINGS.items():
        parser.add_argument(
            f'--{name}-topic',
            default='',
            metavar='TOPIC',
            help=f'of a bag: where its {meaning} are (default: found by their names)',
        )


def camera_topics(arguments: argparse.Namespace) -> CameraTopics:
    """Return what was given."""
    return CameraTopics(arguments.color_topic, arguments.depth_topic, arguments.info_topic)
