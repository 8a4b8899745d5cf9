"""Write the map down while it grows, in a thread that takes little of the machine."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable

from bdgs_ros.core.errors import BdgsError
from bdgs_ros.journal.checkpoints import Checkpoints, State

_LEAST_S = 1.0  # between two states; with half of it a fast turning camera lost 5 % of its frames
_SHARE = 0.1  # of a processor, at most; to wait for the disk costs nothing


class MapKeeper:
    """
    Keeps the newest state of a map on the disk.

    Parameters
    ----------
    checkpoints : Checkpoints
        Where.
    on_problem : callable
        Called, in the thread, with what is wrong, and with an empty text when it is right again.
    prepare : callable, optional
        Called once, first, in the thread: how it gives way to others.

    """

    def __init__(
        self,
        checkpoints: Checkpoints,
        on_problem: Callable[[str], None],
        prepare: Callable[[], None] = lambda: None,
    ) -> None:
        self._checkpoints = checkpoints
        self._on_problem = on_problem
        self._prepare = prepare
        self._problem = ''
        self._due_s = 0.0
        self._tasks: queue.Queue[Callable[[], None] | None] = queue.Queue()
        self._thread = threading.Thread(target=self._run, name='map keeper', daemon=True)
        self._thread.start()

    @property
    def is_due(self) -> bool:
        """Whether the last state is written, and long enough ago."""
        return self._tasks.unfinished_tasks == 0 and time.monotonic() >= self._due_s

    def put(self, state: State) -> None:
        """Have a state written; it is taken by whoever may look at the map."""
        self._tasks.put(lambda: self._checkpoints.write(state))

    def forget(self) -> None:
        """Have what was written removed: the map was forgotten."""
        self._tasks.put(self._checkpoints.clear)

    def close(self) -> None:
        """Write what waits, and end."""
        self._tasks.put(None)
        self._thread.join()

    def _run(self) -> None:
        self._prepare()
        while True:
            task = self._tasks.get()
            if task is None:
                return
            started = time.thread_time()
            self._do(task)
            used_s = time.thread_time() - started
            self._due_s = time.monotonic() + max(_LEAST_S, used_s / _SHARE)
            self._tasks.task_done()

    def _do(self, task: Callable[[], None]) -> None:
        try:
            task()
            problem = ''
        except (OSError, BdgsError) as error:
            problem = f'the map is not kept on the disk: {error}'
        if problem != self._problem:
            self._problem = problem
            self._on_problem(problem)
