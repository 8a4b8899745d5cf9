"""Where a figure comes from: commit, machine, versions."""

from __future__ import annotations

import os
import platform
import subprocess
from importlib import metadata
from pathlib import Path

_PACKAGES = ('numpy', 'torch', 'opencv-python-headless', 'onnxruntime', 'rosbags')


def commit() -> str:
    """Return the git commit of this checkout, '+' if files differ; else the package's version."""
    root = Path(__file__).resolve().parents[2]
    if not (root / '.git').exists():
        return f'version {_version("bdgs_ros")}'
    head = _git(root, 'rev-parse', '--short=12', 'HEAD')
    changed = _git(root, 'status', '--porcelain', '--untracked-files=no')
    return f'{head}{"+" if changed else ""}' if head else f'version {_version("bdgs_ros")}'


def commit_date() -> str:
    """Return the day of the commit of this checkout, YYYY-MM-DD; empty where there is none."""
    root = Path(__file__).resolve().parents[2]
    return _git(root, 'show', '-s', '--format=%cs', 'HEAD') if (root / '.git').exists() else ''


def _git(root: Path, *arguments: str) -> str:
    try:
        done = subprocess.run(
            ['git', '-C', str(root), *arguments], capture_output=True, text=True, timeout=10
        )
    except (OSError, subprocess.TimeoutExpired):
        return ''
    return done.stdout.strip() if done.returncode == 0 else ''


def machine() -> dict[str, str | int]:
    """Describe processor, cores this process may use, operating system and Python."""
    return {
        'processor': _processor(),
        'cores': _cores(),
        'system': f'{platform.system()} {platform.release()}',
        'python': platform.python_version(),
    }


def versions() -> dict[str, str]:
    """Return the installed versions of what the figures depend on."""
    return {name: _version(name) for name in _PACKAGES}


def provenance() -> dict[str, object]:
    """Return commit, machine and versions, as they are written into every result file."""
    return {'commit': commit(), 'machine': machine(), 'versions': versions()}


def _cores() -> int:
    if hasattr(os, 'sched_getaffinity'):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _processor() -> str:
    info = Path('/proc/cpuinfo')
    if info.exists():
        for line in info.read_text(encoding='utf-8', errors='replace').splitlines():
            if line.startswith('model name'):
                return line.partition(':')[2].strip()
    return platform.processor() or platform.machine()


def _version(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return 'absent'
