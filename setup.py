"""Build and install bdgs_ros, with pip alone or with colcon."""

import os
import shutil
import subprocess
import sys
import sysconfig
from glob import glob

from setuptools import Extension, find_packages, setup
from setuptools.command.build_ext import build_ext

NAME = 'bdgs_ros'
NODES = (
    'detection_node',
    'tracking_node',
    'mapping_node',
    'replay_node',
    'slam_node',
)
# `colcon build --symlink-install` runs a linked setup.py in the build folder: sources lie beside
# the real file, and setuptools wants them relative to the working directory.
ROOT = os.path.relpath(os.path.dirname(os.path.realpath(__file__)))

# One source, three builds; bdgs_ros.mapping.rasterize picks the best the processor can run.
RASTERIZER_FLAGS = {
    'avx512': [
        *('-mavx512f', '-mavx512dq', '-mavx512vl', '-mavx512bw', '-mfma', '-mavx2'),
        '-mprefer-vector-width=512',
    ],
    'avx2': ['-mavx2', '-mfma'],
    'base': [],
}
COMPILE = ['-O3', '-std=c++17', '-fopenmp', '-fvisibility=hidden', '-fno-math-errno']
# NaN keeps its meaning: nothing of -ffast-math that would assume it away
RASTERIZER_COMPILE = [*COMPILE, '-fno-trapping-math', '-ffp-contract=fast', '-Wno-psabi']


def native_extensions():
    """Return the native kernels, or none where pybind11 is missing."""
    try:
        import pybind11
    except ImportError:
        return []
    include = [pybind11.get_include(), os.path.join(ROOT, 'src')]
    modules = [
        Extension(
            f'{NAME}._rasterizer_{name}',
            [os.path.join(ROOT, 'src', 'rasterizer.cpp')],
            include_dirs=include,
            define_macros=[('BDGS_MODULE', f'_rasterizer_{name}')],
            depends=sorted(glob(os.path.join(ROOT, 'src', 'rasterizer*.hpp'))),
            extra_compile_args=RASTERIZER_COMPILE + flags,
            extra_link_args=['-fopenmp'],
            language='c++',
            optional=True,
        )
        for name, flags in RASTERIZER_FLAGS.items()
    ]
    modules += [
        Extension(
            f'{NAME}._{name}',
            [os.path.join(ROOT, 'src', f'{name}.cpp')],
            include_dirs=include,
            extra_compile_args=COMPILE,
            extra_link_args=['-fopenmp'],
            language='c++',
            optional=True,
        )
        for name in ('aligner', 'harmonics', 'surface', 'two_views')
    ]
    if cuda_architecture() is not None:
        source = os.path.join(ROOT, 'src', 'cuda', 'rasterizer.cu')
        headers = sorted(glob(os.path.join(ROOT, 'src', 'cuda', '*.*h*')))
        modules.append(
            Extension(
                f'{NAME}._rasterizer_cuda', [source], include_dirs=include, depends=headers,
                language='c++', optional=True,
            )
        )  # fmt: skip
    return [m for m in modules if os.path.exists(m.sources[0])]


def cuda_architecture():
    """
    Return what nvcc compiles for, or None where there is no nvcc or nothing to compile for.

    That is the card of this machine, or BDGS_CUDA_ARCH (sm_90, all-major) for another's.
    """
    if shutil.which('nvcc') is None:
        return None
    present = os.path.exists('/proc/driver/nvidia/version') or os.path.exists('/dev/nvidiactl')
    return os.environ.get('BDGS_CUDA_ARCH', 'native' if present else None)


class BuildNative(build_ext):
    """Build the kernels if there is a compiler; otherwise say what that means and go on."""

    def build_extension(self, ext):
        """Compile one kernel; a failure costs speed, not the installation."""
        try:
            if ext.sources[0].endswith('.cu'):
                self.compile_cuda(ext)
            else:
                super().build_extension(ext)
        except Exception as error:
            sys.stderr.write(
                f'\n*** {ext.name} was not built ({error}).\n'
                '*** bdgs_ros will run without it, on its slow twins or not on a card. For fast\n'
                '*** kernels install a C++17 compiler with OpenMP (Debian: apt install g++), for\n'
                '*** a card a CUDA toolkit (nvcc), and then bdgs_ros again.\n\n'
            )

    def compile_cuda(self, ext):
        """Compile and link by nvcc, whose runtime library goes into the module."""
        path = self.get_ext_fullpath(ext.name)
        os.makedirs(os.path.dirname(os.path.abspath(path)), exist_ok=True)
        python = sysconfig.get_paths()['include']
        include = [f'-I{folder}' for folder in (*ext.include_dirs, python)]
        command = ['nvcc', '-O3', '-std=c++17', f'-arch={cuda_architecture()}', '-shared']
        command += ['-Xcompiler', '-fPIC,-fvisibility=hidden', *include, *ext.sources]
        subprocess.run([*command, '-o', path], check=True)


def launchers():
    """
    Write the scripts that `ros2 run` finds under lib/bdgs_ros in a pip-installed wheel.

    pip ignores `install_scripts`, so the entry points alone would land in bin/ only.
    """
    folder = os.path.join('build', 'launchers')
    os.makedirs(folder, exist_ok=True)
    for node in NODES:
        path = os.path.join(folder, node)
        with open(path, 'w', encoding='utf-8') as file:
            file.write(
                '#!/bin/sh\n'
                f'exec "$(dirname "$0")/../../bin/python3" -m bdgs_ros.nodes.{node} "$@"\n'
            )
        os.chmod(path, 0o755)
    return [(f'lib/{NAME}', [os.path.join(folder, node) for node in NODES])]


def data_files():
    """Return what goes to share/, and for a wheel the launchers too."""
    share = f'share/{NAME}'
    files = [
        ('share/ament_index/resource_index/packages', [f'resource/{NAME}']),
        (share, ['package.xml']),
    ]
    for folder, pattern in (('launch', '*.py'), ('config', '*.yaml'), ('rviz', '*.rviz')):
        files.append((f'{share}/{folder}', sorted(glob(os.path.join(folder, pattern)))))
    return files + (launchers() if 'bdist_wheel' in sys.argv else [])


setup(
    name=NAME,
    version='0.1.0',
    packages=find_packages(exclude=['test', 'test.*']),
    package_data={NAME: ['py.typed']},
    data_files=data_files(),
    ext_modules=native_extensions(),
    cmdclass={'build_ext': BuildNative},
    python_requires='>=3.10',
    install_requires=[
        'numpy',
        'scipy',
        'opencv-python-headless',
        'torch',
        'onnxruntime',
        'rosbags',
        'tqdm',
        'matplotlib',
        'pyyaml',
    ],
    extras_require={
        # rclpy from pip; leave it out in a ROS 2 workspace, which brings its own
        'ros': ['ros-jazzy-rclpy[fastrtps]', 'ros-jazzy-common-interfaces'],
        'test': ['pytest', 'mypy', 'ruff', 'evo', 'cyclonedds', 'psutil', 'hypothesis'],
    },
    zip_safe=False,
    maintainer='bdgs_ros maintainers',
    maintainer_email='maintainers@example.com',
    description='Gaussian-splatting RGB-D SLAM among moving people (BDGS-SLAM)',
    license='Apache-2.0',
    entry_points={
        'console_scripts': [
            'bdgs = bdgs_ros.cli.main:main',
            *[f'{node} = bdgs_ros.nodes.{node}:main' for node in NODES],
        ],
    },
)
