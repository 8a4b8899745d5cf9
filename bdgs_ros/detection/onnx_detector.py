"""YOLOv5 networks in ONNX format, run by onnxruntime on the CPU or on CUDA."""

from __future__ import annotations

import ast
import logging
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime

from bdgs_ros.core.config.detection import DetectionConfig
from bdgs_ros.core.errors import ModelError
from bdgs_ros.core.types import ColorImage, Detection
from bdgs_ros.detection import postprocess
from bdgs_ros.detection.classes import COCO_NAMES

_EXPECTED = (
    'expected one input float32 [1, 3, S, S] and an output float32 [1, N, 5 + classes], as '
    "'export.py --include onnx' of YOLOv5 writes them"
)
_FREE_SIZE = 320  # the input size when the file leaves it open
_CPU, _CUDA = 'CPUExecutionProvider', 'CUDAExecutionProvider'
_PROVIDERS = {'cpu': (_CPU,), 'cuda': (_CUDA,), 'auto': (_CUDA, _CPU)}
# The default tries every algorithm of every layer at the first image, which takes seconds.
_CUDA_OPTIONS = {'cudnn_conv_algo_search': 'HEURISTIC'}

_LOGGER = logging.getLogger(__name__)


class OnnxDetector:
    """
    A YOLOv5 network.

    The input size and, where the file tells them, the class names are read from the file. It runs
    on CUDA where onnxruntime has it, unless `provider` says otherwise.

    Parameters
    ----------
    config : DetectionConfig
        `weights` is the path of the file; `provider` 'auto', 'cpu' or 'cuda'.

    Raises
    ------
    ModelError
        If the file cannot be read, is not a YOLOv5 detector, or CUDA is demanded and cannot be
        used.

    """

    def __init__(self, config: DetectionConfig) -> None:
        self._config = config
        self._path = Path(config.weights).expanduser()
        self._session = _open_session(self._path, config)
        self._input = self._check_input()
        self._names = self._read_names()
        self._check_output()
        device = self._session.get_providers()[0].removesuffix('ExecutionProvider').lower()
        self.name = f'{self._path.name} on {device}'

    def detect(self, color: ColorImage) -> list[Detection]:
        """Return the objects in an RGB image, shape (H, W, 3), best first."""
        name, height, width = self._input
        blob, placement = postprocess.letterbox(color, height, width)
        try:
            output = np.asarray(self._session.run(None, {name: blob})[0])
        except Exception as error:  # onnxruntime has no common base for its exceptions
            raise ModelError(f"'{self._path}' failed on an image: {error}") from error
        if output.ndim != 3 or output.shape[2] != 5 + len(self._names):
            raise ModelError(self._complaint(f'an output of shape {list(output.shape)}'))
        return postprocess.detections(
            output,
            placement,
            (color.shape[0], color.shape[1]),
            self._names,
            self._config.score_threshold,
            self._config.iou_threshold,
        )

    def _check_input(self) -> tuple[str, int, int]:
        inputs = self._session.get_inputs()
        described = [f'{i.name} {i.type} {i.shape}' for i in inputs]
        shape = inputs[0].shape if len(inputs) == 1 else []
        if len(shape) != 4 or shape[1] != 3 or inputs[0].type != 'tensor(float)':
            raise ModelError(self._complaint(f'inputs {described}'))
        height, width = (s if isinstance(s, int) else _FREE_SIZE for s in shape[2:])
        return inputs[0].name, height, width

    def _check_output(self) -> None:
        outputs = self._session.get_outputs()
        shape = outputs[0].shape
        fits = len(shape) == 3 and shape[2] in (5 + len(self._names), None)
        fits = fits or (len(shape) == 3 and isinstance(shape[2], str))
        if not fits or outputs[0].type != 'tensor(float)':
            described = [f'{o.name} {o.type} {o.shape}' for o in outputs]
            raise ModelError(
                self._complaint(f'outputs {described} for {len(self._names)} classes')
            )

    def _read_names(self) -> tuple[str, ...]:
        """Class names from the metadata that YOLOv5's exporter writes; COCO's otherwise."""
        text = self._session.get_modelmeta().custom_metadata_map.get('names', '')
        try:
            table: Any = ast.literal_eval(text)
        except (ValueError, SyntaxError):
            return COCO_NAMES
        if isinstance(table, dict):
            table = [table[k] for k in sorted(table)]
        return tuple(str(name) for name in table)

    def _complaint(self, received: str) -> str:
        return f"'{self._path}' is not a YOLOv5 detector: {_EXPECTED}; received {received}"


def _open_session(path: Path, config: DetectionConfig) -> Any:
    if not path.is_file():
        raise ModelError(
            f"no weights file '{path}'; give detection.weights the path of a YOLOv5 ONNX file, "
            'or leave it empty to use the geometric prior alone'
        )
    providers = _providers(config.provider)
    try:
        session = onnxruntime.InferenceSession(
            str(path), _session_options(config), providers=providers
        )
    except Exception as error:  # onnxruntime has no common base for its exceptions
        size = path.stat().st_size
        raise ModelError(
            f"'{path}' ({size} bytes) cannot be read as an ONNX network: {error}; "
            'was it downloaded completely?'
        ) from error
    _check_provider(session.get_providers()[0], config.provider, [name for name, _ in providers])
    return session


def _check_provider(used: str, wanted: str, offered: list[str]) -> None:
    """Say what the network runs on: onnxruntime turns to the CPU where CUDA fails to start."""
    if used == offered[0]:
        _LOGGER.info("detector: onnxruntime's %s (detection.provider is '%s')", used, wanted)
        return
    complaint = (
        f'{offered[0]} is built into this onnxruntime but did not start, which leaves {used}; '
        'it needs an NVIDIA driver, and CUDA and cuDNN of the versions it was built for'
    )
    if wanted == 'cuda':
        raise ModelError(f"detection.provider is 'cuda', but {complaint}")
    _LOGGER.warning('%s', complaint)


def _session_options(config: DetectionConfig) -> Any:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = config.threads
    options.inter_op_num_threads = 1
    # Threads that spin while they wait take the core that tracking needs.
    options.add_session_config_entry('session.intra_op.allow_spinning', '0')
    options.log_severity_level = 3
    return options


def _providers(wanted: str) -> list[tuple[str, dict[str, str]]]:
    """Return names and options of the execution providers to try, best first."""
    available = onnxruntime.get_available_providers()
    usable = [p for p in _PROVIDERS[wanted] if p in available]
    if not usable:
        raise ModelError(
            f"detection.provider is '{wanted}', but this onnxruntime has only {available}; "
            "install onnxruntime-gpu, or set it to 'auto'"
        )
    if _CUDA in usable and hasattr(onnxruntime, 'preload_dlls'):
        onnxruntime.preload_dlls()  # finds the CUDA libraries that pip installed, torch's also
    return [(p, _CUDA_OPTIONS if p == _CUDA else {}) for p in usable]
