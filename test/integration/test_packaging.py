"""The wheel holds what `ros2 run` and `ros2 launch` look for."""

from __future__ import annotations

import os
import runpy
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[2]
PARTS = ('bdgs_ros', 'config', 'launch', 'resource', 'rviz')
FILES = ('package.xml', 'pyproject.toml', 'setup.cfg', 'setup.py')


@pytest.fixture(scope='module')
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build a wheel of a copy without the kernels, whose compilation is slow."""
    folder = tmp_path_factory.mktemp('wheel')
    source = folder / 'source'
    ignored = shutil.ignore_patterns('__pycache__', '*.so')
    for name in PARTS:
        shutil.copytree(ROOT / name, source / name, ignore=ignored)
    for name in FILES:
        shutil.copy(ROOT / name, source / name)
    command = [sys.executable, '-m', 'pip', 'wheel', '--no-deps', '--no-build-isolation', '-q']
    subprocess.run([*command, '-w', str(folder), str(source)], check=True, timeout=300)
    (file,) = folder.glob('*.whl')
    return file


@pytest.fixture(scope='module')
def prefix(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Unpack its data files as pip does."""
    folder = tmp_path_factory.mktemp('prefix')
    with zipfile.ZipFile(wheel) as archive:
        for item in archive.infolist():
            _, _, path = item.filename.partition('.data/data/')
            if path and not item.is_dir():
                target = folder / path
                target.parent.mkdir(parents=True, exist_ok=True)
                target.write_bytes(archive.read(item))
                target.chmod(item.external_attr >> 16)
    return folder


def nodes() -> list[str]:
    """Return the node modules of the package."""
    return sorted(path.stem for path in (ROOT / 'bdgs_ros' / 'nodes').glob('*_node.py'))


def test_ros2_run_finds_every_node(prefix: Path) -> None:
    found = {path.name: path for path in (prefix / 'lib' / 'bdgs_ros').iterdir()}
    assert sorted(found) == nodes()
    assert all(os.access(path, os.X_OK) for path in found.values())


def test_a_launcher_runs_its_node_with_the_python_beside_it(prefix: Path) -> None:
    (prefix / 'bin').mkdir(exist_ok=True)
    stand_in = prefix / 'bin' / 'python3'
    stand_in.write_text('#!/bin/sh\necho "$@"\n')
    stand_in.chmod(0o755)
    launcher = prefix / 'lib' / 'bdgs_ros' / 'slam_node'
    said = subprocess.run(
        [launcher, '--ros-args', '-p', 'bag:=a b'], capture_output=True, text=True, check=True
    ).stdout
    assert said == '-m bdgs_ros.nodes.slam_node --ros-args -p bag:=a b\n'


def test_share_holds_what_ros_looks_for(prefix: Path) -> None:
    share = prefix / 'share'
    assert (share / 'ament_index' / 'resource_index' / 'packages' / 'bdgs_ros').is_file()
    found = {str(path.relative_to(share / 'bdgs_ros')) for path in share.glob('bdgs_ros/*/*')}
    assert (share / 'bdgs_ros' / 'package.xml').is_file()
    assert {
        'launch/bdgs.launch.py', 'launch/replay.launch.py', 'launch/_args.py', 'rviz/bdgs.rviz',
        'config/bdgs.yaml',
    } <= found  # fmt: skip


def test_every_package_is_in_the_wheel(wheel: Path) -> None:
    names = set(zipfile.ZipFile(wheel).namelist())
    for path in (ROOT / 'bdgs_ros').rglob('*.py'):
        assert str(path.relative_to(ROOT)) in names
    assert not [name for name in names if name.startswith('test/')]


def test_console_scripts_name_functions_that_exist(wheel: Path) -> None:
    archive = zipfile.ZipFile(wheel)
    (file,) = (n for n in archive.namelist() if n.endswith('entry_points.txt'))
    lines = [line for line in archive.read(file).decode().splitlines() if ' = ' in line]
    assert sorted(line.split(' = ')[0] for line in lines) == ['bdgs', *nodes()]
    for line in lines:
        module = line.split(' = ')[1].split(':')[0]
        assert (ROOT / Path(*module.split('.'))).with_suffix('.py').is_file(), line


def test_package_xml_is_valid_for_colcon() -> None:
    """An e-mail that does not validate makes colcon treat the package as plain Python."""
    from xml.etree import ElementTree

    package = ElementTree.parse(ROOT / 'package.xml').getroot()
    version = runpy.run_path(str(ROOT / 'bdgs_ros' / '__init__.py'))['__version__']
    assert package.findtext('version') == version
    assert package.findtext('export/build_type') == 'ament_python'
    assert '@' in package.find('maintainer').get('email')
