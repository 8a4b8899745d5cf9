"""Folders of every layout, and the messages for folders of none."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import pytest
from data_recordings import (
    CAMERA_YAML,
    HEIGHT,
    WIDTH,
    color_image,
    depth_units,
    pose,
    write_openloris,
    write_tum,
)

from bdgs_ros.core import se3
from bdgs_ros.core.camera import Rectifier
from bdgs_ros.core.errors import DatasetError
from bdgs_ros.data.camera_file import read_camera_file
from bdgs_ros.data.layouts import open_recording, open_sequence
from bdgs_ros.data.tum import freiburg_camera


def test_frames_are_rectified_pairs(tmp_path: Path) -> None:
    sequence = open_sequence(write_tum(tmp_path / 'walk'))
    rectifier = Rectifier(sequence.camera)
    assert len(sequence) == 6 and sequence.name == 'walk' and not sequence.unpaired_color
    frames = list(sequence)
    assert [frame.stamp_ns for frame in frames] == sequence.stamps_ns.tolist()
    for index, frame in enumerate(frames):
        assert frame.camera.is_rectified and not sequence.camera.is_rectified
        np.testing.assert_array_equal(frame.color, rectifier.color(color_image(index)))
        depth_m = depth_units(index).astype(np.float32) / np.float32(5000)
        np.testing.assert_array_equal(frame.depth_m, rectifier.depth(depth_m))
        np.testing.assert_array_equal(sequence[index].color, frame.color)
    np.testing.assert_array_equal(sequence[-1].depth_m, frames[-1].depth_m)
    assert sequence.ground_truth is not None
    np.testing.assert_allclose(sequence.ground_truth.matrices[2], pose(2), atol=1e-9)


def test_colour_without_depth_is_counted_and_named(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING):
        sequence = open_sequence(write_tum(tmp_path / 'walk', without_depth=(1, 4)))
    assert len(sequence) == 4
    assert sequence.unpaired_color == ('rgb/1500000000.033333.png', 'rgb/1500000000.133333.png')
    assert '2 of 6 colour images have no depth within 30 ms: rgb/15' in caplog.text


def test_images_may_lie_elsewhere(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / 'walk', without_depth=(1,))
    (folder / 'rgb').rename(tmp_path / 'images')
    listed = (folder / 'rgb.txt').read_text()
    (folder / 'rgb.txt').write_text(listed.replace(' rgb/', f' {tmp_path}/images/'))
    sequence = open_sequence(folder)
    assert len(sequence) == 5
    assert sequence.unpaired_color == (f'{tmp_path}/images/1500000000.033333.png',)


def test_stamps_of_depth_that_are_late_are_corrected(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / 'walk')
    delays_ns = [frame.depth_delay_ns for frame in open_sequence(folder)]
    listed = [line.split() for line in (folder / 'depth.txt').read_text().splitlines()]
    late = [f'{float(stamp) + 0.7:.6f} {file}' for stamp, file in listed if stamp != '#']
    (folder / 'depth.txt').write_text('\n'.join(late))
    with pytest.raises(DatasetError, match='no two within 30 ms'):
        open_sequence(folder)
    frames = list(open_sequence(folder, depth_offset_s=0.7))
    assert [frame.depth_delay_ns for frame in frames] == pytest.approx(delays_ns, abs=1000)
    assert len(set(delays_ns)) == 1 and delays_ns[0] != 0


def test_no_pair_at_all_is_an_error(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / 'walk')
    with pytest.raises(DatasetError, match='6 colour and 6 depth images but no two within 5 ms'):
        open_sequence(folder, max_difference_s=0.005)


def test_a_bonn_folder_corrects_the_orientation_only(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / 'rgbd_bonn_test')
    truth = open_sequence(folder).ground_truth
    assert truth is not None
    C = se3.from_position_quat_xyzw(np.zeros(3), np.array([-0.1287, 0.8866, -0.4396, 0.0634]))
    np.testing.assert_allclose(truth.matrices[3], pose(3) @ C, atol=1e-9)
    np.testing.assert_allclose(truth.positions[3], pose(3)[:3, 3], atol=1e-9)


@pytest.mark.parametrize(('name', 'fx'), [('1_rpy', 517.3), ('2_desk', 520.9), ('3_xyz', 535.4)])
def test_freiburg_cameras(name: str, fx: float) -> None:
    recorded = freiburg_camera(f'rgbd_dataset_freiburg{name}')
    assert recorded is not None and recorded.camera.fx == fx and recorded.depth_scale == 5000
    assert recorded.camera.is_rectified == name.startswith('3')


def test_a_freiburg_folder_of_another_size_says_so(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / 'rgbd_dataset_freiburg1_x', camera=False)
    sequence = open_sequence(folder)
    with pytest.raises(DatasetError, match=r'shape \(24, 32\), but the camera of .* \(480, 640\)'):
        sequence[0]


def test_openloris_depth_and_ground_truth(tmp_path: Path) -> None:
    T_base_depth = se3.exp(np.array([0.3, 0.1, 1.2, -0.5, 0.4, 0.3]))
    T_depth_color = se3.exp(np.array([0.015, 0, 0, 0, 0.01, 0]))
    sequence = open_sequence(write_openloris(tmp_path / 'cafe1-1', T_base_depth, T_depth_color))
    assert (sequence.camera.fx, sequence.camera.fy) == (30, 31)
    assert (sequence.camera.cx, sequence.camera.cy) == (15.5, 11.5)
    np.testing.assert_array_equal(
        sequence[1].depth_m, depth_units(1).astype(np.float32) / np.float32(1000)
    )
    truth = sequence.ground_truth
    assert truth is not None
    expected = pose(2) @ T_base_depth @ T_depth_color
    np.testing.assert_allclose(truth.matrices[2], expected, atol=1e-9)


def test_openloris_without_the_camera_in_the_tree(tmp_path: Path) -> None:
    folder = write_openloris(tmp_path / 'cafe', np.eye(4), np.eye(4))
    path = folder / 'trans_matrix.yaml'
    path.write_text(path.read_text().replace('d400_color', 'd400_other'))
    with pytest.raises(DatasetError, match="'base_link' to 'd400_color_optical_frame'; it knows"):
        open_recording(folder)


def test_a_camera_given_outweighs_all(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / 'rgbd_dataset_freiburg1_x')
    assert open_recording(folder).camera.fx == 30.0  # its camera.yaml, before its name
    other = tmp_path / 'other.yaml'
    other.write_text(CAMERA_YAML.replace('fx: 30.0', 'fx: 29.0'))
    assert open_recording(folder, other).camera.fx == 29.0


def test_an_unknown_camera_says_how_to_give_it(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / 'kitchen', camera=False)
    with pytest.raises(DatasetError, match=r"has no 'camera.yaml'; put one there, or .* --camera"):
        open_recording(folder)


def test_an_unknown_layout_says_what_was_looked_for(tmp_path: Path) -> None:
    (tmp_path / 'video.mp4').write_bytes(b'')
    with pytest.raises(DatasetError) as caught:
        open_recording(tmp_path)
    for expected in ('rgb.txt', 'OpenLORIS', 'metadata.yaml', 'ROS 1 .bag', 'found video.mp4'):
        assert expected in str(caught.value)
    with pytest.raises(DatasetError, match='there is no recording at'):
        open_recording(tmp_path / 'nothing')


def test_missing_and_broken_images_are_named(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / 'walk')
    last = sorted((folder / 'depth').iterdir())[-1]
    last.write_bytes(b'not a png')
    with pytest.raises(DatasetError, match=f"{last.name}' is not a readable depth image"):
        list(open_sequence(folder))
    last.unlink()
    with pytest.raises(DatasetError, match=rf'lists 6 images but 1 are missing.*{last.name}'):
        open_sequence(folder)


def test_eight_bit_depth_is_refused(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / 'walk')
    color = sorted((folder / 'rgb').iterdir())[0]
    depth = sorted((folder / 'depth').iterdir())[0]
    depth.write_bytes(color.read_bytes())
    with pytest.raises(DatasetError, match='16-bit single-channel depth image, received uint8'):
        open_sequence(folder)[0]


@pytest.mark.parametrize(
    ('old', 'new', 'message'),
    [
        ('  fx: 30.0\n', '', r"missing keys \['fx'\]"),
        ('fx:', 'focal: 1\n  fx:', r"unknown keys \['focal'\]"),
        ('fx: 30.0', 'fx: -1', 'above 0'),
        ('fx: 30.0', 'fx: wide', 'could not convert'),
        ('[0.1, -0.05,', '[', 'with 3 coefficients; expected one of plumb_bob with'),
        ('camera:', 'lens:', "no section 'camera'"),
        ('camera:', 'camera: [', 'cannot read the camera file'),
    ],
)
def test_camera_file_errors(tmp_path: Path, old: str, new: str, message: str) -> None:
    path = tmp_path / 'camera.yaml'
    assert old in CAMERA_YAML
    path.write_text(CAMERA_YAML.replace(old, new))
    with pytest.raises(DatasetError, match=message):
        read_camera_file(path)


def test_a_camera_file_is_read_in_full(tmp_path: Path) -> None:
    path = tmp_path / 'camera.yaml'
    path.write_text(CAMERA_YAML)
    recorded = read_camera_file(path)
    assert recorded.camera.shape == (HEIGHT, WIDTH) and recorded.depth_scale == 5000
    assert recorded.camera.distortion == (0.1, -0.05, 0.001, 0.002, 0.0)


@pytest.mark.recording
def test_the_real_recordings_open(shared_dir: Path) -> None:
    crowd = open_sequence(shared_dir / 'data' / 'rgbd_bonn_crowd_part')
    rpy = open_sequence(shared_dir / 'data' / 'rgbd_dataset_freiburg1_rpy_part')
    assert len(crowd) + len(crowd.unpaired_color) == 520 and len(rpy) == 240
    assert crowd.camera.fx == 542.822841 and rpy.camera.fx == 517.3
    assert crowd[0].depth_m.max() < 14 and (rpy[-1].depth_m > 0).mean() > 0.3
