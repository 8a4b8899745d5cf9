"""The ONNX detector: on networks of a few bytes written here, and on real weights if present."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from bdgs_ros.core.config.detection import DetectionConfig
from bdgs_ros.core.errors import ModelError
from bdgs_ros.detection.detector import NullDetector, make_detector

pytest.importorskip('onnxruntime')

FLOAT, INT64 = 1, 7


def _varint(value: int) -> bytes:
    out = bytearray()
    while value > 127:
        out.append(value & 127 | 128)
        value >>= 7
    return bytes([*out, value])


def _number(field: int, value: int) -> bytes:
    return _varint(field << 3) + _varint(value)


def _bytes(field: int, value: bytes | str) -> bytes:
    data = value.encode() if isinstance(value, str) else value
    return _varint(field << 3 | 2) + _varint(len(data)) + data


def _value_info(name: str, kind: int, shape: tuple[int, ...]) -> bytes:
    dims = b''.join(_bytes(1, _number(1, s)) for s in shape)
    return _bytes(1, name) + _bytes(2, _bytes(1, _number(1, kind) + _bytes(2, dims)))


def tiny_network(
    input_shape: tuple[int, ...] = (1, 3, 32, 32),
    answer: np.ndarray | None = None,
    kind: int = FLOAT,
    names: str = '',
) -> bytes:
    """Return an ONNX file whose network answers with a constant, whatever the image."""
    answer = np.zeros((1, 4, 85), np.float32) if answer is None else answer
    constant = b''.join(_number(1, s) for s in answer.shape) + _number(2, FLOAT)
    constant += _bytes(8, 'answer') + _bytes(9, answer.astype('<f4').tobytes())
    node = _bytes(1, 'answer') + _bytes(2, 'output0') + _bytes(4, 'Identity')
    graph = _bytes(1, node) + _bytes(2, 'tiny') + _bytes(5, constant)
    graph += _bytes(11, _value_info('images', kind, input_shape))
    graph += _bytes(12, _value_info('output0', FLOAT, answer.shape))
    meta = _bytes(14, _bytes(1, 'names') + _bytes(2, names)) if names else b''
    return _number(1, 8) + _bytes(7, graph) + _bytes(8, _number(2, 13)) + meta


Write = Callable[..., DetectionConfig]


@pytest.fixture
def write(tmp_path: Path) -> Write:
    """Return a function that writes a file and the configuration that names it."""

    def config(content: bytes, **values: object) -> DetectionConfig:
        path = tmp_path / 'net.onnx'
        path.write_bytes(content)
        return DetectionConfig(weights=str(path), provider='cpu', **values)

    return config


def one_person() -> np.ndarray:
    """Return an answer with one person in the middle of a 32x32 input."""
    answer = np.zeros((1, 4, 85), np.float32)
    answer[0, 2, :6] = 16, 16, 8, 16, 0.9, 0.9
    return answer


def test_finds_what_the_network_answers(write: Write) -> None:
    """A box in the input of 32x32 becomes one in the image of 64x48."""
    detector = make_detector(write(tiny_network(answer=one_person())))
    (found,) = detector.detect(np.zeros((48, 64, 3), np.uint8))
    assert found.box_xyxy == pytest.approx((24, 8, 40, 40))
    assert (found.class_name, found.score) == ('person', pytest.approx(0.81))
    assert detector.name == 'net.onnx on cpu'


def test_class_names_come_from_the_file(write: Write) -> None:
    """A network of two classes with its own names."""
    answer = np.zeros((1, 4, 7), np.float32)
    answer[0, 0] = 16, 16, 8, 8, 1.0, 0.1, 0.9
    net = tiny_network(answer=answer, names="{0: 'cart', 1: 'dog'}")
    (found,) = make_detector(write(net)).detect(np.zeros((32, 32, 3), np.uint8))
    assert found.class_name == 'dog' and found.p_dynamic > 0.7


def test_a_file_that_is_no_network_says_so(write: Write) -> None:
    """Half a download."""
    with pytest.raises(ModelError, match=r'net\.onnx.*1000 bytes.*cannot be read'):
        make_detector(write(tiny_network(answer=one_person())[:500] * 2))


def test_a_missing_file_is_named() -> None:
    """With what to do about it."""
    with pytest.raises(ModelError, match=r"no weights file '/nowhere/y\.onnx'.*leave it empty"):
        make_detector(DetectionConfig(weights='/nowhere/y.onnx'))


@pytest.mark.parametrize(
    ('net', 'received'),
    [
        (tiny_network(input_shape=(1, 1, 32, 32)), r'inputs.*\[1, 1, 32, 32\]'),
        (tiny_network(kind=INT64), r'inputs.*int64'),
        (tiny_network(answer=np.zeros((1, 116, 21), np.float32)), r'outputs.*\[1, 116, 21\]'),
        (tiny_network(answer=np.zeros((1, 85), np.float32)), r'outputs.*\[1, 85\]'),
    ],
)
def test_a_network_of_another_kind_is_refused(write: Write, net: bytes, received: str) -> None:
    """With what was expected and what was received."""
    with pytest.raises(ModelError, match=r'expected one input float32.*received ' + received):
        make_detector(write(net))


def test_no_weights_means_the_null_detector() -> None:
    """Which is no error."""
    detector = make_detector(DetectionConfig())
    assert isinstance(detector, NullDetector)
    assert detector.detect(np.zeros((4, 4, 3), np.uint8)) == []


def test_cuda_that_is_not_there_is_an_error_only_when_demanded(write: Write) -> None:
    """`auto` takes what there is."""
    import onnxruntime

    if 'CUDAExecutionProvider' in onnxruntime.get_available_providers():
        pytest.skip('this onnxruntime has CUDA')
    config = write(tiny_network())
    make_detector(DetectionConfig(weights=config.weights, provider='auto'))
    with pytest.raises(ModelError, match=r'detection\.provider'):
        make_detector(DetectionConfig(weights=config.weights, provider='cuda'))


@pytest.mark.recording
@pytest.mark.parametrize('weights', ['yolov5n-320.onnx', 'yolov5n.onnx'])
def test_people_of_a_real_image_are_found(shared_dir: Path, weights: str) -> None:
    """Three people stand in the crowd at frame 320, and nobody in the first frame."""
    import cv2

    path = shared_dir / 'models' / weights
    if not path.is_file():
        pytest.skip(f"no weights '{path}'")
    detector = make_detector(DetectionConfig(weights=str(path), provider='cpu'))
    images = sorted((shared_dir / 'data' / 'rgbd_bonn_crowd_part' / 'rgb').iterdir())

    def people(k: int) -> list[float]:
        found = detector.detect(cv2.cvtColor(cv2.imread(str(images[k])), cv2.COLOR_BGR2RGB))
        return [d.score for d in found if d.class_name == 'person']

    assert people(0) == []
    assert sum(score > 0.6 for score in people(320)) == 3
