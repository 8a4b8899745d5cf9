"""Where the tests run the kernels of `src/cuda`: on a card, and everywhere on their emulation."""

from __future__ import annotations

import importlib.util
import os
import shutil
import subprocess
import sysconfig
from functools import lru_cache
from pathlib import Path
from tempfile import mkdtemp
from types import ModuleType

import pytest

from bdgs_ros.mapping.cuda import kernels
from bdgs_ros.mapping.cuda.kernels import Device

SOURCE = Path(__file__).resolve().parents[2] / 'src' / 'cuda' / 'rasterizer.cu'
NAME = '_rasterizer_emulated'
PLACES = ['emulated', 'card']


def open_device(place: str) -> Device:
    """Return the emulation or the card; skip, or with BDGS_REQUIRE_CUDA fail, without."""
    if place == 'emulated':
        return Device(emulated(), 'cpu')
    reason = kernels.obstacle()
    if reason is not None:
        if 'BDGS_REQUIRE_CUDA' in os.environ:  # `make cuda-check`
            pytest.fail(reason)
        pytest.skip(reason)
    return kernels.device()


@lru_cache(maxsize=1)
def emulated() -> ModuleType:
    """Compile the kernels for one thread of this processor; see src/cuda/emulate.hpp."""
    compiler = shutil.which('g++')
    if compiler is None:
        pytest.skip('there is no g++ to compile the emulation of the kernels with')
    import pybind11

    built = Path(mkdtemp()) / f'{NAME}.so'
    include = (pybind11.get_include(), sysconfig.get_paths()['include'])
    command = [compiler, '-x', 'c++', '-O2', '-std=c++17', '-shared', '-fPIC', '-w']
    command += ['-fvisibility=hidden', f'-DBDGS_MODULE={NAME}', *(f'-I{path}' for path in include)]
    subprocess.run([*command, str(SOURCE), '-o', str(built)], check=True)
    spec = importlib.util.spec_from_file_location(NAME, built)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    shutil.rmtree(built.parent)
    return module
