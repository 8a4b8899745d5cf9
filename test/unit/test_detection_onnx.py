"""The ONNX detector: on networks of a few bytes written here, and on real weights if present."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bdgs_ros.core.config.detection import DetectionConfig
from bdgs_ros.core.errors import ModelError
from bdgs_ros.detection.detector import NullDetector, make_detector

onnxruntime = pytest.importorskip('onnxruntime')
onnx_detector = pytest.importorskip('bdgs_ros.detection.onnx_detector')

FLOAT, INT64 = 1, 7
CPU, CUDA = 'CPUExecutionProvider', 'CUDAExecutionProvider'


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
    if CUDA in onnxruntime.get_available_providers():
        pytest.skip('this onnxruntime has CUDA')
    config = write(tiny_network())
    make_detector(DetectionConfig(weights=config.weights, provider='auto'))
    with pytest.raises(ModelError, match=r'detection\.provider'):
        make_detector(DetectionConfig(weights=config.weights, provider='cuda'))


class FakeRuntime:
    """An onnxruntime with CUDA built in, whose sessions start on `starts`."""

    SessionOptions = onnxruntime.SessionOptions

    def __init__(self, starts: str) -> None:
        self.starts = starts
        self.preloaded = False
        self.asked: list[tuple[str, dict[str, str]]] = []

    def get_available_providers(self) -> list[str]:
        """As onnxruntime-gpu does, whether or not there is a card."""
        return ['TensorrtExecutionProvider', CUDA, CPU]

    def preload_dlls(self) -> None:
        """Note the call."""
        self.preloaded = True

    def InferenceSession(self, path: str, options: object, providers: list) -> object:
        """Open the network on the CPU, and claim to be elsewhere."""
        self.asked = providers
        session = onnxruntime.InferenceSession(path, options, providers=[CPU])
        used = [self.starts, CPU] if self.starts == CUDA else [CPU]
        session.get_providers = lambda: used
        return session


def fake_runtime(monkeypatch: pytest.MonkeyPatch, starts: str) -> FakeRuntime:
    """Put a `FakeRuntime` in onnxruntime's place."""
    fake = FakeRuntime(starts)
    monkeypatch.setattr(onnx_detector, 'onnxruntime', fake)
    return fake


@pytest.mark.parametrize('provider', ['auto', 'cuda'])
def test_cuda_is_taken_where_it_is_offered(
    write: Write, monkeypatch: pytest.MonkeyPatch, provider: str
) -> None:
    """And its libraries are looked for beside torch's first."""
    fake = fake_runtime(monkeypatch, CUDA)
    detector = make_detector(replace(write(tiny_network()), provider=provider))
    assert detector.name == 'net.onnx on cuda'
    assert fake.preloaded and fake.asked[0][0] == CUDA
    assert fake.asked[0][1] == {'cudnn_conv_algo_search': 'HEURISTIC'}


def test_cpu_can_be_demanded_where_cuda_is_offered(
    write: Write, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The override."""
    fake = fake_runtime(monkeypatch, CPU)
    detector = make_detector(write(tiny_network()))
    assert detector.name == 'net.onnx on cpu'
    assert fake.asked == [(CPU, {})] and not fake.preloaded


def test_cuda_that_does_not_start_is_a_warning_or_an_error(
    write: Write, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Onnxruntime itself turns to the CPU in silence."""
    fake_runtime(monkeypatch, CPU)
    config = write(tiny_network())
    with caplog.at_level(logging.WARNING):
        assert make_detector(replace(config, provider='auto')).name == 'net.onnx on cpu'
    assert sum('did not start' in r.message for r in caplog.records) == 1
    with pytest.raises(ModelError, match=r"provider is 'cuda', but .*did not start.*driver"):
        make_detector(replace(config, provider='cuda'))


def test_a_real_cuda_runs_the_network(write: Write) -> None:
    """Where there is one."""
    if CUDA not in onnxruntime.get_available_providers():
        reason = 'this onnxruntime has no CUDA: install onnxruntime-gpu beside a CUDA device'
        if 'BDGS_REQUIRE_CUDA' in os.environ:  # `make cuda-check`
            pytest.fail(reason)
        pytest.skip(reason)
    detector = make_detector(replace(write(tiny_network(answer=one_person())), provider='cuda'))
    (found,) = detector.detect(np.zeros((48, 64, 3), np.uint8))
    assert detector.name == 'net.onnx on cuda'
    assert found.box_xyxy == pytest.approx((24, 8, 40, 40))


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
