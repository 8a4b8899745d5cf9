"""Conversion to rosbag2, whole or not at all, and the two commands."""

from __future__ import annotations

import argparse
import json
import signal
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from data_recordings import PERIOD_NS, START, color_ns, depth_units, write_tum

import bdgs_ros.data.convert as convert_module
from bdgs_ros.cli import convert as convert_cli
from bdgs_ros.cli import info as info_cli
from bdgs_ros.core.errors import DatasetError
from bdgs_ros.data.bag import open_bag
from bdgs_ros.data.bag_recording import COLOR_TOPIC, DEPTH_TOPIC, INFO_TOPIC
from bdgs_ros.data.convert import ConvertOptions, convert, encode_depth
from bdgs_ros.data.layouts import open_sequence


def test_everything_recorded_goes_in_with_its_stamp(tmp_path: Path) -> None:
    report = convert(write_tum(tmp_path / 'walk', without_depth=(2,)), tmp_path / 'bag')
    assert report.counts == {
        '/ground_truth/pose': 6, INFO_TOPIC: 6, COLOR_TOPIC: 6, DEPTH_TOPIC: 5,
    }  # fmt: skip
    assert report.pairs == 5 and report.unpaired_color == ('rgb/1500000000.066666.png',)
    with open_bag(tmp_path / 'bag') as reader:
        for raw, message in reader.messages([COLOR_TOPIC, DEPTH_TOPIC, INFO_TOPIC]):
            stamp = message.header.stamp
            assert stamp.sec * 10**9 + stamp.nanosec == raw.stamp_ns
            assert message.header.frame_id == 'camera_color_optical_frame'
        order = [raw.topic for raw in reader.raw_messages()]
        assert order[:4] == ['/ground_truth/pose', INFO_TOPIC, COLOR_TOPIC, DEPTH_TOPIC]
        info = next(m for _, m in reader.messages([INFO_TOPIC]))
        assert info.d.tolist() == [0.1, -0.05, 0.001, 0.002, 0.0]
        assert info.distortion_model == 'plumb_bob' and (info.width, info.height) == (32, 24)


def test_a_part_keeps_the_partners_at_its_ends(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / 'walk', count=20)
    options = ConvertOptions(start_s=5 * PERIOD_NS / 1e9, duration_s=4 * PERIOD_NS / 1e9)
    report = convert(folder, tmp_path / 'bag', options)
    sequence = open_sequence(tmp_path / 'bag')
    assert len(sequence) == report.pairs == report.counts[COLOR_TOPIC] == 4
    assert sequence.stamps_ns[0] == START * 10**9 + color_ns(6)
    with pytest.raises(DatasetError, match=r'is 0\.63 s long: nothing lies after start 9 s'):
        convert(folder, tmp_path / 'late', ConvertOptions(start_s=9))
    assert not (tmp_path / 'late').exists()


def test_millimetres_round_and_cut_off() -> None:
    depth_m = np.array([[0, 1.2346, 65.535, 70.0]], np.float32)
    assert encode_depth(depth_m, '16UC1').tolist() == [[0, 1235, 65535, 0]]
    assert encode_depth(depth_m, '32FC1') is depth_m


def test_millimetres_in_a_bag(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / 'walk')
    convert(folder, tmp_path / 'bag', ConvertOptions(depth_encoding='16UC1'))
    got = open_sequence(tmp_path / 'bag').recording.read_depth(1)
    exact = depth_units(1) / 5000
    assert np.abs(got - exact).max() < 0.00051 and (got == 0).sum() == (exact == 0).sum()


def test_an_existing_bag_is_kept_without_force(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / 'walk')
    convert(folder, tmp_path / 'bag')
    before = sorted(tmp_path.rglob('*'))
    with pytest.raises(DatasetError, match=r"bag' exists already; .* --force"):
        convert(folder, tmp_path / 'bag')
    convert(folder, tmp_path / 'bag', ConvertOptions(force=True, duration_s=0.07))
    assert sorted(tmp_path.rglob('*')) == before
    assert len(open_sequence(tmp_path / 'bag')) == 3


def test_force_replaces_bags_only(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / 'walk')
    with pytest.raises(DatasetError, match='is not a bag; --force replaces only bags'):
        convert(folder, folder, ConvertOptions(force=True))
    assert (folder / 'rgb.txt').is_file()


@pytest.mark.parametrize('error', [KeyboardInterrupt, OSError])
def test_an_interrupted_conversion_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: type[BaseException]
) -> None:
    folder = write_tum(tmp_path / 'walk')
    convert(folder, tmp_path / 'bag', ConvertOptions(duration_s=0.07))
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob('*') if path.is_file()}
    calls = []

    def serialize(*arguments: object) -> bytes:
        calls.append(arguments)
        if len(calls) == 5:
            assert len(list(tmp_path.rglob('.bag.partial*'))) == 1
            raise error('no space left')
        return original(*arguments)

    original = convert_module._serialize
    monkeypatch.setattr(convert_module, '_serialize', serialize)
    expected = DatasetError if error is OSError else error
    with pytest.raises(expected):
        convert(folder, tmp_path / 'bag', ConvertOptions(force=True))
    with pytest.raises(expected):
        calls.clear()
        convert(folder, tmp_path / 'new' / 'bag')
    after = {path: path.stat().st_mtime_ns for path in tmp_path.rglob('*') if path.is_file()}
    assert after == before
    assert not list((tmp_path / 'new').iterdir())


def test_a_full_disk_is_noticed_before_writing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    usage = convert_module.shutil.disk_usage(tmp_path)._replace(free=1000)
    monkeypatch.setattr(convert_module.shutil, 'disk_usage', lambda _: usage)
    with pytest.raises(DatasetError, match=r'needs 0\.00 GB, but .* has only 0\.00 GB free'):
        convert(write_tum(tmp_path / 'walk'), tmp_path / 'bag')
    assert not (tmp_path / 'bag').exists()


@pytest.mark.parametrize(
    ('changes', 'message'),
    [
        ({'storage': 'tape'}, "storage 'tape' is refused: allowed is mcap, sqlite3"),
        ({'depth_encoding': 'mm'}, 'allowed is 32FC1, 16UC1'),
        ({'start_s': -1.0}, 'start -1.0 s must be 0 or more'),
        ({'duration_s': 0.0}, 'duration 0.0 s above 0'),
    ],
)
def test_options_out_of_range(changes: dict[str, object], message: str) -> None:
    with pytest.raises(DatasetError, match=message):
        ConvertOptions(**changes)  # type: ignore[arg-type]


# ---- the commands


def run(module: ModuleType, *words: object) -> int:
    parser = argparse.ArgumentParser()
    module.add_arguments(parser)
    return int(module.run(parser.parse_args([str(word) for word in words])))


def test_convert_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = write_tum(tmp_path / 'walk', without_depth=(2,))
    handler = signal.getsignal(signal.SIGTERM)
    assert run(convert_cli, folder, tmp_path / 'bag') == 0
    text = capsys.readouterr().out
    assert '5 RGB-D pairs, 1 colour images without depth' in text and '066666.png' in text
    assert run(convert_cli, folder, tmp_path / 'b2', '--storage', 'sqlite3', '--json') == 0
    report = json.loads(capsys.readouterr().out)
    assert report['pairs'] == 5 and report['topics'][COLOR_TOPIC] == 6
    assert next((tmp_path / 'b2').glob('*.db3')) and report['size_bytes'] > 10_000
    assert signal.getsignal(signal.SIGTERM) is handler


def test_info_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = write_tum(tmp_path / 'walk', count=9, without_depth=(4,))
    convert(folder, tmp_path / 'bag')
    run(info_cli, tmp_path / 'bag')
    text = capsys.readouterr().out
    for expected in ('mcap bag', COLOR_TOPIC, '30.00 Hz', '1 gaps, the longest 67 ms at 0.10 s',
                     'pairs   8', 'fx 30.000', 'ground truth: 9 poses'):  # fmt: skip
        assert expected in text
    run(info_cli, tmp_path / 'bag', '--json')
    bag = json.loads(capsys.readouterr().out)
    run(info_cli, folder, '--json')
    directory = json.loads(capsys.readouterr().out)
    assert directory['kind'] == 'folder' and not directory['topics']
    for key in ('color', 'depth', 'camera', 'pairs', 'ground_truth_poses'):
        assert bag[key] == directory[key]


def test_info_of_a_bag_without_images(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from rosbags.rosbag2 import StoragePlugin, Writer

    from bdgs_ros.data import messages

    with Writer(tmp_path / 'p', version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection(
            '/pose', messages.POSE_STAMPED, typestore=messages.jazzy()
        )
        writer.write(connection, 5, messages.serialize_pose(5, 'map', np.eye(4)))
    assert run(info_cli, tmp_path / 'p') == 0
    text = capsys.readouterr().out
    assert '/pose' in text and 'not usable as an RGB-D recording' in text


@pytest.mark.recording
def test_real_recordings_come_back_bit_for_bit(shared_dir: Path, tmp_path: Path) -> None:
    for name in ('rgbd_bonn_crowd_part', 'rgbd_dataset_freiburg1_rpy_part'):
        source = shared_dir / 'data' / name
        convert(source, tmp_path / name, ConvertOptions(duration_s=0.5))
        wanted, got = open_sequence(source), open_sequence(tmp_path / name)
        assert 14 <= len(got) <= 16 and got.camera == wanted.camera
        for one, other in zip(wanted, got, strict=False):
            assert one.stamp_ns == other.stamp_ns
            np.testing.assert_array_equal(one.color, other.color)
            np.testing.assert_array_equal(one.depth_m, other.depth_m)
