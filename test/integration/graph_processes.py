"""Start nodes as users do, each in its own process, and look at what they say."""

from __future__ import annotations

import itertools
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import TracebackType

HERE = Path(__file__).resolve().parent
_COUNTER = itertools.count(os.getpid() * 7)


def new_domain() -> int:
    """Return a DDS domain that other tests are not likely to use at the same time."""
    return 10 + next(_COUNTER) % 90


class Running:
    """A process with its output in a file."""

    def __init__(self, command: list[str], environment: dict[str, str], log: Path) -> None:
        self.log = log
        self._file = log.open('wb')
        self.process = subprocess.Popen(
            command, env=environment, stdout=self._file, stderr=subprocess.STDOUT
        )

    def text(self) -> str:
        """Return everything it has printed so far."""
        return self.log.read_text(encoding='utf-8', errors='replace')

    def wait_for(self, words: str, timeout_s: float = 30.0) -> str:
        """Wait until it has printed something."""
        deadline = time.monotonic() + timeout_s
        while words not in self.text():
            if time.monotonic() > deadline or (
                self.process.poll() is not None and words not in self.text()
            ):
                raise AssertionError(f'{words!r} did not come; it said:\n{self.text()}')
            time.sleep(0.05)
        return self.text()

    def wait(self, timeout_s: float = 60.0) -> int:
        """Wait for its end and return its exit status."""
        try:
            return self.process.wait(timeout_s)
        except subprocess.TimeoutExpired as error:
            raise AssertionError(f'still running after {timeout_s} s:\n{self.text()}') from error

    def stop(self, with_signal: signal.Signals = signal.SIGTERM, timeout_s: float = 15.0) -> int:
        """Send a signal and return the exit status."""
        if self.process.poll() is None:
            self.process.send_signal(with_signal)
        return self.wait(timeout_s)

    def close(self) -> None:
        """End it, whatever it does."""
        if self.process.poll() is None:
            self.process.terminate()
            try:
                self.process.wait(10)
            except subprocess.TimeoutExpired:
                self.process.kill()
                self.process.wait()
        self._file.close()


class Graph:
    """Processes that share a DDS domain; all of them are ended on leaving."""

    def __init__(self, folder: Path) -> None:
        self.domain = new_domain()
        self.environment = {
            **os.environ,
            'ROS_DOMAIN_ID': str(self.domain),
            'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
            'ROS_LOG_DIR': str(folder / 'ros_log'),
        }
        self._folder = folder
        self._running: list[Running] = []

    def node(self, name: str, *arguments: str, **parameters: object) -> Running:
        """Start a node of the project; `__` in a name stands for a dot."""
        command = [sys.executable, '-m', f'bdgs_ros.nodes.{name}', '--ros-args', *arguments]
        for key, value in parameters.items():
            text = str(value).lower() if isinstance(value, bool) else str(value)
            command += ['-p', f'{key.replace("__", ".")}:={text}']
        return self.process(name, command)

    def script(self, name: str, *arguments: str) -> Running:
        """Start a script that lies beside the tests."""
        return self.process(name, [sys.executable, str(HERE / name), *arguments])

    def process(self, name: str, command: list[str]) -> Running:
        """Start anything."""
        log = self._folder / f'{len(self._running)}_{name}.log'
        running = Running(command, self.environment, log)
        self._running.append(running)
        return running

    def __enter__(self) -> Graph:
        """Return itself."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """End every process."""
        for running in reversed(self._running):
            running.close()
