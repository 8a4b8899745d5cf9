"""Arrows between packages point downward only, and the algorithm loads without ROS."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1] / 'bdgs_ros'
STAGES = {'detection', 'tracking', 'belief', 'mapping', 'back_end', 'data', 'eval', 'journal'}
SIBLINGS = {
    ('mapping', 'belief'),
    ('detection', 'tracking'),
    ('back_end', 'tracking'),
    ('journal', 'mapping'),
}
ROS = {'rclpy', 'sensor_msgs', 'geometry_msgs', 'nav_msgs', 'std_msgs', 'std_srvs', 'tf2_msgs'}


def imported(path: Path) -> set[str]:
    tree = ast.parse(path.read_text())
    names = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module:
            names.add(node.module)
        elif isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
    return names


def files(package: str) -> list[Path]:
    return sorted((ROOT / package).rglob('*.py'))


def inside(names: set[str]) -> set[str]:
    return {n.split('.')[1] for n in names if n.startswith('bdgs_ros.')}


@pytest.mark.parametrize('package', sorted(STAGES | {'core'}))
def test_lower_layers_import_nothing_above(package: str) -> None:
    allowed = {'core', package} | {b for a, b in SIBLINGS if a == package}
    allowed |= {'core'} if package == 'core' else set()
    for path in files(package):
        beyond = {n for n in inside(imported(path)) if n not in allowed and not n.startswith('_')}
        assert not beyond, f'{path.relative_to(ROOT)} imports {sorted(beyond)}'


def test_only_bridge_and_nodes_know_ros() -> None:
    for path in ROOT.rglob('*.py'):
        if path.relative_to(ROOT).parts[0] in {'bridge', 'nodes'}:
            continue
        ros = {n.split('.')[0] for n in imported(path)} & ROS
        assert not ros, f'{path.relative_to(ROOT)} imports {sorted(ros)}'


def test_pipeline_runs_where_rclpy_is_absent() -> None:
    code = "import sys; sys.modules['rclpy'] = None; import bdgs_ros.pipeline"
    subprocess.run([sys.executable, '-c', code], check=True)


def test_importing_the_package_is_light() -> None:
    code = (
        'import sys, bdgs_ros;'
        "heavy = {'torch', 'rclpy', 'cv2', 'onnxruntime'} & set(sys.modules);"
        'sys.exit(1 if heavy else 0)'
    )
    subprocess.run([sys.executable, '-c', code], check=True)
