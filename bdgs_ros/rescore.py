"""
Score and picture a finished run from its files alone: trajectory, map and recording.

For runs over DDS, where the processes that held the frames are gone.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from bdgs_ros.core.config import BdgsConfig
from bdgs_ros.core.errors import EvaluationError
from bdgs_ros.core.files import write_text
from bdgs_ros.core.types import Labels, RgbdFrame, TrackingResult, TrackingStatus, Trajectory
from bdgs_ros.data.trajectory_io import read_trajectory
from bdgs_ros.eval import scores
from bdgs_ros.eval.labels import LabelScore, score_labels
from bdgs_ros.eval.metric import Metric, dump_json
from bdgs_ros.eval.recorder import Recorder, RunResult
from bdgs_ros.job import open_truth
from bdgs_ros.runner import write_results


def rescore(
    folder: Path, recording: Path, config: BdgsConfig, camera_file: Path | None = None
) -> dict[str, Any]:
    """
    Complete the results of a run that left `trajectory.txt` and `map.ply`.

    The dynamic prior is computed anew by the detection stage; figures that `metrics.json` has
    already are kept.

    Parameters
    ----------
    folder : Path
        Of the results; gets pictures and a fuller `metrics.json`.
    recording : Path
        What was run; frames without a pose in the trajectory count as lost.
    config : BdgsConfig
        For the detection stage and the rasteriser.
    camera_file : Path, optional
        `camera.yaml` of the recording.

    Returns
    -------
    metrics : dict
        What `metrics.json` holds.

    Raises
    ------
    BdgsError
        If a file is missing or does not belong to the others.

    """
    from bdgs_ros.data.layouts import open_sequence
    from bdgs_ros.mapping.mapper import Mapper

    known = _known_results(folder / 'metrics.json')
    sequence = open_sequence(recording, camera_file, depth_offset_s=config.camera.depth_offset_s)
    est = read_trajectory(folder / 'trajectory.txt')
    mapper = Mapper(config.mapping, config.belief)
    mapper.load(folder / 'map.ply')
    truth = open_truth(recording)
    result, labels = relabel(sequence, est, config, truth, frozenset(mapper.history.stamps_ns))
    metrics = write_results(
        folder,
        result,
        mapper,
        name=sequence.name,
        ground_truth=sequence.ground_truth,
        truth=truth,
        more=labels,
        config=config,
        save_map=False,
    )
    figures = {**metrics['metrics'], **known.get('metrics', {})}
    metrics = {**metrics, **known, 'metrics': figures, 'notes': metrics['notes']}
    write_text(folder / 'metrics.json', dump_json(metrics) + '\n')
    return metrics


def _known_results(path: Path) -> dict[str, Any]:
    """Return what the run wrote itself; nothing if there is no such file."""
    if not path.is_file():
        return {}
    try:
        found = json.loads(path.read_text(encoding='utf-8'))
    except ValueError as error:
        raise EvaluationError(f"'{path}' is not JSON: {error}") from error
    return found if isinstance(found, dict) else {}


def relabel(
    sequence: Any,
    est: Trajectory,
    config: BdgsConfig,
    truth: scores.Truth | None,
    keyframe_stamps_ns: Collection[int] = (),
) -> tuple[RunResult, Sequence[Metric]]:
    """
    Go through a recording again, with the poses it was given and a dynamic prior computed anew.

    Parameters
    ----------
    sequence : Sequence
        The recording.
    est : Trajectory
        Frames without a pose in it count as lost.
    config : BdgsConfig
        For the detection stage.
    truth : Truth, optional
        To score the prior with.
    keyframe_stamps_ns : collection of int
        Frames that the map was fitted to.

    Returns
    -------
    result : RunResult
        As if from a run.
    labels : sequence of Metric
        Precision and recall of the prior; empty without truth.

    Raises
    ------
    EvaluationError
        If no frame has a pose.

    """
    from tqdm import tqdm

    from bdgs_ros.detection.stage import DetectionStage

    poses = {pose.stamp_ns: pose.T_world_camera for pose in est.poses}
    stage, recorder, score = DetectionStage(config.detection), Recorder(), LabelScore()
    for frame in tqdm(sequence, 'labels', unit='frame', file=sys.stderr, leave=False):
        labels = stage.process(frame)
        is_keyframe = frame.stamp_ns in keyframe_stamps_ns
        recorder.add(frame, _as_tracking(frame, labels, poses, is_keyframe), {})
        if truth is not None:
            score = score + score_labels(labels.p_dynamic, truth.dynamic(frame.stamp_ns))
    result = recorder.result()
    if not result.trajectory.poses:
        raise EvaluationError(
            f"none of {len(est)} poses has the stamp of a frame of '{sequence.name}'; "
            'do trajectory and recording belong together?'
        )
    return result, [] if truth is None else score.metrics('prior')


def _as_tracking(
    frame: RgbdFrame, labels: Labels, poses: Mapping[int, Any], is_keyframe: bool
) -> TrackingResult:
    pose = poses.get(frame.stamp_ns)
    return TrackingResult(
        frame.stamp_ns,
        TrackingStatus.LOST if pose is None else TrackingStatus.OK,
        np.eye(4) if pose is None else pose,
        np.full((6, 6), np.nan),
        is_keyframe,
        labels.p_dynamic,
    )
