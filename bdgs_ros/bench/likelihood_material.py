"""Recordings through the pipeline, to learn the likelihood of Eq. 3 from: runs, kept as .npz."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bdgs_ros.belief.likelihood import FEATURES, Features, Observation
from bdgs_ros.belief.sightings import DYNAMIC, STATIC, UNKNOWN, Sightings
from bdgs_ros.bench.sequences import synth_path
from bdgs_ros.core import se3
from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.config import BdgsConfig, specs, with_values
from bdgs_ros.core.errors import ModelError
from bdgs_ros.core.types import DepthImage
from bdgs_ros.data.synth.truth import SynthTruth
from bdgs_ros.eval.gaussian_truth import project, true_states
from bdgs_ros.job import open_truth
from bdgs_ros.mapping.gaussians import GaussianMap
from bdgs_ros.mapping.witness import Shadow, Truth, Witness

Array = NDArray[np.float32]

DETECTORS = ('weights', 'geometric')
SHADOW, MAP = 'shadow', 'map'

_SHADOW_PIXELS = 600  # of each keyframe
_SHADOW_LIFETIME = 20  # keyframes
_MAP_SHARE = 8  # every so many-th Gaussian of the map is followed
_WRONG_POSE_M = 0.05
_STATES = np.array([UNKNOWN, STATIC, DYNAMIC], np.int8)  # by `TrueState`


@dataclass(frozen=True)
class Source:
    """One run to learn from."""

    scenario: str
    seed: int
    frames: int
    detector: str
    """One of `DETECTORS`: with the weights of the detector, or the geometric prior alone."""

    @property
    def label(self) -> str:
        """What it is called in tables."""
        return f'{self.scenario}/{self.seed}/{self.detector}'


@dataclass(frozen=True)
class Material:
    """What a run taught: Gaussians of the shadow map and of the map itself, by kind."""

    source: Source
    sightings: dict[str, Sightings]


def sources(
    scenarios: Sequence[str], seeds: Sequence[int], frames: int, weights: Path | None
) -> list[Source]:
    """List the runs; without weights only those with the geometric prior alone."""
    detectors = DETECTORS if weights is not None else DETECTORS[1:]
    return [Source(n, s, frames, d) for n in scenarios for s in seeds for d in detectors]


def collect(
    source: Source, config: BdgsConfig, weights: Path | None, work: Path, force: bool = False
) -> Material:
    """
    Return what a run teaches, from the file that an earlier one left, if there is one.

    Parameters
    ----------
    source : Source
        The recording is made if it is not there.
    config : BdgsConfig
        The run is known by all of it.
    weights : Path, optional
        Of the detector.
    work : Path
        Gets `likelihood/`; synthetic recordings are in `synth/` beside it.
    force : bool
        Run it again.

    Raises
    ------
    ModelError
        If there are no weights where they are needed.
    DatasetError
        If the recording or an earlier file cannot be read.

    """
    stem = work / 'likelihood' / _key(source, config)
    paths = {kind: stem.with_name(f'{stem.name}-{kind}.npz') for kind in (SHADOW, MAP)}
    if force or not all(path.is_file() for path in paths.values()):
        run_config = _with_detector(config, source, weights)
        recording = synth_path(source.scenario, source.seed, source.frames, work)
        for kind, sightings in witness_run(recording, run_config, source.seed).items():
            sightings.save(paths[kind])
    return Material(source, {kind: Sightings.load(path) for kind, path in paths.items()})


def _key(source: Source, config: BdgsConfig) -> str:
    values = {spec.name: spec.value for spec in specs(config)}
    settings = [values, FEATURES, _SHADOW_PIXELS, _SHADOW_LIFETIME, _MAP_SHARE]
    digest = hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:10]
    return f'{source.scenario}_{source.seed}_{source.frames}_{source.detector}-{digest}'


def _with_detector(config: BdgsConfig, source: Source, weights: Path | None) -> BdgsConfig:
    if source.detector != 'weights':
        return with_values(config, {'detection.weights': ''})
    if weights is None or not weights.is_file():
        raise ModelError(f"no weights of the detector at '{weights}'; give them with --weights")
    return with_values(config, {'detection.weights': str(weights)})


def witness_run(recording: Path, config: BdgsConfig, seed: int) -> dict[str, Sightings]:
    """
    Run a recording with truth, and return what was seen of Gaussians by kind.

    Truth labels what was seen; it does not reach the pipeline.
    """
    from bdgs_ros.data.layouts import open_sequence
    from bdgs_ros.pipeline import BdgsSlam

    sequence, truth = open_sequence(recording), open_truth(recording)
    if truth is None:
        truth = SynthTruth(recording)  # says what is missing
    states = truth_of(truth, sequence.camera.rectified())
    slam = BdgsSlam(config)
    shadow_witness = Witness(config.belief, states)
    shadow = Shadow(config.belief, shadow_witness, _SHADOW_PIXELS, _SHADOW_LIFETIME, seed)
    map_witness = _Overseer(config, states, shadow)
    slam.mapper.inference = map_witness
    for frame in sequence:
        slam.process(frame)
    return {SHADOW: shadow_witness.sightings(), MAP: map_witness.sightings()}


class _Overseer(Witness):
    """Record the map, and let the shadow see every keyframe that the map sees."""

    def __init__(self, config: BdgsConfig, truth: Truth, shadow: Shadow) -> None:
        super().__init__(config.belief, truth, _MAP_SHARE)
        self._shadow = shadow

    def observe(self, gaussians: GaussianMap, observation: Observation, index: int) -> Features:
        """Do the same as `Witness`, twice."""
        features = super().observe(gaussians, observation, index)
        self._shadow.update(observation, index)
        return features


def truth_of(truth: SynthTruth, camera: PinholeCamera) -> Truth:
    """
    Return what tells the states of Gaussians.

    They are told at the estimated poses, which the map is made with. Where these are wrong by
    more than `_WRONG_POSE_M`, because tracking is lost, nothing is known.

    Parameters
    ----------
    truth : SynthTruth
        Of the recording.
    camera : PinholeCamera
        Of its images.

    """
    first, *_ = poses = {p.stamp_ns: p.T_world_camera for p in truth.trajectory().poses}
    T_world_room = se3.inverse(poses[first])
    newest: dict[int, DepthImage] = {}

    def states(means: Array, observation: Observation) -> NDArray[np.int8]:
        stamp_ns = observation.stamp_ns
        T_world_camera = T_world_room @ poses[truth.nearest(stamp_ns)]
        off_m = np.linalg.norm(observation.T_world_camera[:3, 3] - T_world_camera[:3, 3])
        if off_m > _WRONG_POSE_M:
            return np.full(len(means), UNKNOWN, np.int8)
        if stamp_ns not in newest:
            newest.clear()
            newest[stamp_ns] = truth.static_depth(stamp_ns)
        at = project(means, observation.T_world_camera, camera)
        return _STATES[true_states(at, newest[stamp_ns])]

    return states
