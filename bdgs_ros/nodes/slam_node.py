"""Bring up the whole graph, with a replay if asked for: the one command that users need."""

from __future__ import annotations

import contextlib
import json
import queue
import sys
import threading
import time
from collections.abc import Callable
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from std_srvs.srv import Trigger

from bdgs_ros.bridge import parameters, topics
from bdgs_ros.bridge.leftovers import remove_leftovers
from bdgs_ros.bridge.node_config import NODE_CONFIGS, SlamConfig, TrackingNodeConfig
from bdgs_ros.bridge.observer import GraphObserver
from bdgs_ros.bridge.priority import may_go_first
from bdgs_ros.bridge.processes import Child, Children, forwarded_arguments
from bdgs_ros.bridge.runner import REFUSED, GraphNode, run
from bdgs_ros.core.config import BdgsConfig, specs, with_values
from bdgs_ros.core.errors import BdgsError, ConfigError, JournalError
from bdgs_ros.core.types import Trajectory
from bdgs_ros.journal.folder import Claim, in_cache
from bdgs_ros.nodes.in_process import InProcessNodes

_GRAPH = {
    'detection_node': 'DetectionNode',
    'tracking_node': 'TrackingNode',
    'mapping_node': 'MappingNode',
}
_WATCH_PERIOD_S = 0.1
_SERVICE_TIMEOUT_S = 120.0
_ASKED_AT_MOST = 6  # times within it; to save twice does no harm


def _ask(client: Any) -> Trigger.Response | None:
    """Call a service, again and again: answers get lost while it does not know its caller yet."""
    answers: queue.Queue[Trigger.Response] = queue.Queue()
    for _ in range(_ASKED_AT_MOST):
        future = client.call_async(Trigger.Request())
        future.add_done_callback(lambda future: answers.put(future.result()))
        with contextlib.suppress(queue.Empty):
            return answers.get(timeout=_SERVICE_TIMEOUT_S / _ASKED_AT_MOST)
    return None


class SlamNode(GraphNode):
    """Start, watch and end the graph; at the end of a recording, write the results."""

    def __init__(self, **options: Any) -> None:
        super().__init__('slam_node', **options)
        self._config = parameters.declare(self, SlamConfig())
        self._values = {name: p.value for name, p in self._parameter_overrides.items()}
        self._slam_config = check_everything(self._config, self._values)
        self._files = self._result_files()
        self._journal = self._claim_journal()
        self._started_s = time.time()
        self._is_over = False
        self._observer = GraphObserver(self)
        self._savers = {
            name: self.create_client(Trigger, name) for name in self._results_to_save()
        }
        arguments = forwarded_arguments(sys.argv)
        self._children = Children(arguments, self._with_own_share())
        self._threads = InProcessNodes(arguments)
        self._replay_report = self._children.file('replay.json')
        self._start_graph()
        self._timer = self.create_timer(
            _WATCH_PERIOD_S, self._watch, clock=Clock(clock_type=ClockType.STEADY_TIME)
        )

    def _claim_journal(self) -> Claim | None:
        """Take the folder that all nodes of this graph keep their journal in."""
        config = self._config
        if not config.journal.enabled:
            return None
        named = config.journal.folder or (config.output and str(Path(config.output) / 'journal'))
        try:
            return Claim([Path(named).resolve()] if named else in_cache(), keep=config.resume)
        except JournalError as error:
            if named or config.resume:
                raise
            self.get_logger().warning(f'no journal is kept: {error}')
            return None

    def _start_graph(self) -> None:
        values = {**self._values, **self._files}
        if self._journal is not None:
            values['journal.folder'] = str(self._journal.folder)
        for name, kind in _GRAPH.items():
            if self._config.processes == 'several':
                self._children.start(name, values)
            else:
                module = import_module(f'bdgs_ros.nodes.{name}')
                self._threads.start(getattr(module, kind), values)
        if self._config.bag:
            wanted = max(len(_GRAPH), int(values.get('wait_subscribers', 0)))
            own = {'wait_subscribers': wanted, 'report_file': str(self._replay_report)}
            self._children.start('replay_node', {**values, **own})

    def _with_own_share(self) -> frozenset[str]:
        """
        Return the nodes that other processes of the machine cannot starve.

        Mapping's priority is low for tracking's sake. Where tracking goes first anyway, mapping
        has a share like that of any other program, not what the rest of the graph leaves it.
        """
        default = TrackingNodeConfig().realtime_priority
        priority = int(self._values.get('realtime_priority', default))
        goes_first = not self._config.lockstep and may_go_first(priority)
        return frozenset({'mapping_node'} if goes_first else ())

    def _result_files(self) -> dict[str, str]:
        if not self._config.output:
            return {}
        given = str(self._values.get('map_file', ''))
        folder = Path(self._config.output).resolve()
        folder.mkdir(parents=True, exist_ok=True)
        return {
            'trajectory_file': str(folder / 'trajectory.txt'),
            'final_trajectory_file': str(folder / 'trajectory_final.txt'),
            # a map to begin in is the one to go on with
            'map_file': given if self._config.begins_in_map else str(folder / 'map.ply'),
        }

    def _results_to_save(self) -> list[str]:
        saved = [topics.SAVE_TRAJECTORY, topics.SAVE_FINAL_TRAJECTORY]
        return saved if self._config.localization else [*saved, topics.SAVE_MAP]

    def _watch(self) -> None:
        for child, status in self._children.ended():
            if child.name == 'replay_node':
                self._on_replay_end(child, status)
            else:
                self._on_death(child, status)

    def _on_replay_end(self, child: Child, status: int) -> None:
        child.done = True
        if status:
            self.get_logger().fatal(f'the replay ended with status {status}')
            self._begin_to_end(status)
        elif self._config.exit_at_end:
            self._begin_to_end(0)

    def interrupt(self) -> None:
        """Have the results saved and end, at the second time without."""
        if self._ending:
            self.get_logger().warning('ending at once; what was not saved yet is lost')
            self.finish()
        else:
            self._children.stop_one('replay_node')
            self._begin_to_end(0)

    def _begin_to_end(self, status: int) -> None:
        """Have the results saved, if a folder was given, and end."""
        if self._ending:
            return
        self._ending = True
        if self._config.output:
            threading.Thread(target=self._conclude, args=[status], daemon=True).start()
        else:
            self.get_logger().info("nothing is saved: the parameter 'output' names no folder")
            self.finish(status)

    def _on_death(self, child: Child, status: int) -> None:
        """Start a node again, unless it has refused its parameters or dies all the time."""
        if status == REFUSED or child.respawns >= self._config.respawns:
            child.done = True
            self.get_logger().fatal(f'{child.name} ended with status {status}')
            self.finish(status or 1)
            return
        child.respawns += 1
        self.get_logger().error(
            f'{child.name} ended with status {status}; starting it again '
            f'({child.respawns} of {self._config.respawns})'
        )
        self._children.start(child.name, {**child.values, 'resume': True})

    def _conclude(self, status: int) -> None:
        """Write the results, in a thread: the answers of the services come to the executor."""
        saves = [*(partial(self._call, name) for name in self._savers), self._write_metrics]
        saved = [self._succeeds(save) for save in saves]
        # Of a recording that is over and saved there is nothing to go on with.
        self._is_over = all(saved) and self._replay_report.is_file()
        self.finish(status or int(not all(saved)))

    def _succeeds(self, save: Callable[[], None]) -> bool:
        try:
            save()
        except (BdgsError, OSError) as error:
            self.get_logger().fatal(str(error))
            return False
        return True

    def _call(self, name: str) -> None:
        client = self._savers[name]
        if not client.wait_for_service(_SERVICE_TIMEOUT_S):
            raise BdgsError(f"nobody offers '{name}'")
        answer = _ask(client)
        if answer is None:
            self._children.show_stacks()
            raise BdgsError(
                f"'{name}' did not answer within {_SERVICE_TIMEOUT_S:g} s; the log says where the "
                'threads of all nodes are: please report it'
            )
        if not answer.success:
            raise BdgsError(f"'{name}': {answer.message}")

    def _write_metrics(self) -> None:
        folder = Path(self._config.output).resolve()
        if self._replay_report.is_file():  # it is written at the end of the recording
            report = json.loads(self._replay_report.read_text(encoding='utf-8'))
            self._observer.diagnostics['replay'] = report
        name, ground_truth = self._recording()
        metrics = self._observer.write_metrics(
            folder,
            self._slam_config,
            name,
            ground_truth,
            Path(self._files['map_file']),
            {
                'wall_s': time.time() - self._started_s,
                'mode': self._config.mode,
                'processes': self._config.processes,
                'respawns': sum(c.respawns for c in self._children.children.values()),
            },
        )
        found = metrics['metrics']
        shown = ('frames_sent', 'frames_in', 'frames_lost', 'frames_missed', 'ate_rmse')
        text = ', '.join(f'{k} {found[k]["value"]:.6g}' for k in shown if k in found)
        self.get_logger().info(f"results in '{folder}': {text}")

    def _recording(self) -> tuple[str, Trajectory | None]:
        """Return the name of what was run, and its ground truth if it has one."""
        if not self._config.bag:
            return Path(self._config.output).resolve().name, None
        from bdgs_ros.data.bag import open_bag
        from bdgs_ros.data.bag_recording import BagRecording, CameraTopics

        with open_bag(self._config.bag) as reader:
            names = (str(self._values.get(f'{name}_topic', '')) for name in ('color', 'depth'))
            info = str(self._values.get('info_topic', ''))
            recording = BagRecording(reader, topics=CameraTopics(*names, info))
            return recording.name, recording.ground_truth

    def close(self) -> None:
        """End the graph."""
        self._children.stop()
        self._threads.stop()
        remove_leftovers()
        if self._journal is not None and self._is_over:
            self._journal.remove()


def check_everything(config: SlamConfig, values: dict[str, Any]) -> BdgsConfig:
    """
    Check the parameters of all nodes before any of them is started.

    Returns
    -------
    config : BdgsConfig
        What the stages will use.

    Raises
    ------
    ConfigError
        For the first value that a node would refuse.

    """
    for kind in NODE_CONFIGS.values():
        names = {spec.name for spec in specs(kind())}
        with_values(kind(), {n: v for n, v in values.items() if n in names})
    if config.begins_in_map and not values.get('map_file'):
        raise ConfigError(
            "'load_at_start' and 'localization' need 'map_file': the map to begin in"
        )
    if config.exit_at_end and not (config.bag and config.output):
        raise ConfigError("'exit_at_end' needs 'bag' (what to replay) and 'output' (a folder)")
    stage_names = {spec.name for spec in specs(BdgsConfig())}
    return with_values(BdgsConfig(), {n: v for n, v in values.items() if n in stage_names})


def main(args: list[str] | None = None) -> int:
    """Run the graph."""
    return run(SlamNode, args)


if __name__ == '__main__':
    sys.exit(main())
