"""Start the nodes of the graph as child processes, watch them, and end them; ROS-free."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from bdgs_ros.bridge.runner import END_SIGNAL, PARENT_VARIABLE, STACKS_SIGNAL

_GRACE_S = 5.0
_FORWARDED_WITH_VALUE = ('--log-level', '--log-config-file', '--log-file-name', '--enclave', '-e')
_REMAPS = ('-r', '--remap')
# The terminal's ctrl-C reaches the parent alone, which passes it on. Not by a session for each:
# Linux shares the processor evenly between sessions (autogroup), whatever their nice values are.
_OWN_SESSION: dict[str, Any] = {'start_new_session': True}
_APART: dict[str, Any] = {'process_group': 0} if sys.version_info >= (3, 11) else _OWN_SESSION


def forwarded_arguments(arguments: Sequence[str]) -> list[str]:
    """
    Return the ROS arguments that hold for every node of the graph.

    Remaps, the namespace and log levels do; a node's name does not, and parameters travel in a
    file of their own.
    """
    kept: list[str] = []
    inside = False
    for word, following in zip(arguments, [*arguments[1:], ''], strict=True):
        if word in ('--ros-args', '--'):
            inside = word == '--ros-args'
        elif inside and _holds_for_all(word, following):
            kept += [word, following]
    return kept


def _holds_for_all(word: str, following: str) -> bool:
    if word in _REMAPS:
        return not following.startswith(('__node', '__name'))
    return word in _FORWARDED_WITH_VALUE


def write_parameters(folder: Path, name: str, values: Mapping[str, object]) -> Path:
    """Write a ROS 2 parameter file for whatever node reads it."""
    path = folder / f'{name}.yaml'
    document = {'/**': {'ros__parameters': dict(values)}}
    path.write_text(yaml.safe_dump(document), encoding='utf-8')
    return path


@dataclass
class Child:
    """One node in a process of its own."""

    name: str
    values: dict[str, object]
    process: subprocess.Popen[bytes] | None = None
    respawns: int = 0
    done: bool = False


@dataclass
class Children:
    """
    The processes of the graph.

    They end with their parent, whatever ends it: each asks the kernel for a signal at the
    parent's death (`runner.follow_parent`).
    """

    ros_arguments: list[str]
    own_session: frozenset[str] = frozenset()
    """Nodes with a share of the processor of their own, whoever else there is."""
    children: dict[str, Child] = field(default_factory=dict)
    _folder: tempfile.TemporaryDirectory[str] = field(
        default_factory=lambda: tempfile.TemporaryDirectory(prefix='bdgs_ros-')
    )

    def file(self, name: str) -> Path:
        """Return a path that lives as long as the graph."""
        return Path(self._folder.name) / name

    def start(self, name: str, values: Mapping[str, object]) -> None:
        """Start a node; call it from the main thread, which the children follow."""
        child = self.children.setdefault(name, Child(name, dict(values)))
        child.values = dict(values)
        file = write_parameters(Path(self._folder.name), name, values)
        command = [sys.executable, '-m', f'bdgs_ros.nodes.{name}', '--ros-args']
        command += ['--params-file', str(file), *self.ros_arguments]
        environment = {**os.environ, PARENT_VARIABLE: str(os.getpid())}
        apart = _OWN_SESSION if name in self.own_session else _APART
        child.process = subprocess.Popen(command, env=environment, **apart)

    def ended(self) -> list[tuple[Child, int]]:
        """Return the children that have ended since the last call, with their exit status."""
        found = []
        for child in self.children.values():
            if child.process is None or child.done:
                continue
            status = child.process.poll()
            if status is not None:
                child.process = None
                found.append((child, status))
        return found

    def running(self) -> list[str]:
        """Return the names of the children that run."""
        return [child.name for child in self.children.values() if child.process is not None]

    def show_stacks(self) -> None:
        """Have all children write where their threads are, for whoever reads the log."""
        for process in self._alive():
            process.send_signal(STACKS_SIGNAL)

    def _alive(self) -> list[subprocess.Popen[bytes]]:
        return [c.process for c in self.children.values() if c.process is not None]

    def stop_one(self, name: str) -> None:
        """End a child gently, if it runs, without waiting; its end is no news then."""
        child = self.children.get(name)
        if child is not None and child.process is not None:
            child.done = True
            child.process.send_signal(END_SIGNAL)

    def stop(self) -> None:
        """End all children, gently first."""
        alive = self._alive()
        for process in alive:
            process.send_signal(END_SIGNAL)
        deadline = time.monotonic() + _GRACE_S
        for process in alive:
            _end(process, max(0.1, deadline - time.monotonic()))
        self._folder.cleanup()


def _end(process: subprocess.Popen[bytes], patience_s: float) -> None:
    try:
        process.wait(patience_s)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
