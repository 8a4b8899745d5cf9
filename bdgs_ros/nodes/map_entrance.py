"""Show tracking the map that it begins in, when it asks."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

from rclpy.node import Node
from std_msgs.msg import Empty

from bdgs_ros.bridge import topics
from bdgs_ros.bridge.frames import FrameDecoder, RawFrame
from bdgs_ros.bridge.health import Health
from bdgs_ros.bridge.map_output import MapOutput
from bdgs_ros.bridge.model_view import ModelPublisher
from bdgs_ros.core import se3
from bdgs_ros.core.errors import BdgsError
from bdgs_ros.core.types import NO_KEYFRAME_NS, Pose
from bdgs_ros.mapping.entrance import check_entrance, entrance
from bdgs_ros.nodes.map_services import LiveMap


class MapEntrance:
    """
    Answers `bdgs/map_request` as soon as the camera is known.

    Parameters
    ----------
    node : Node
        It subscribes, and knows the name of the map.
    live : LiveMap
        The map.
    decoder : FrameDecoder
        Knows the camera.
    models : ModelPublisher
        The answer goes there.
    output : MapOutput
        Is told the camera, too.
    health : Health
        Gets what goes wrong.
    width : int
        Of the view at most, in pixels.
    put : callable
        Has a task done by the thread that may use the map.
    reenter : callable
        Called with the stamp of the last frame before tracking comes in again, and `T_new_old`:
        it was in a world as that was before corrections that it has not heard of.

    """

    def __init__(
        self,
        node: Node,
        live: LiveMap,
        decoder: FrameDecoder,
        models: ModelPublisher,
        output: MapOutput,
        health: Health,
        width: int,
        put: Callable[[Callable[[], None]], None],
        reenter: Callable[[int, Pose], None],
    ) -> None:
        self._node = node
        self._live = live
        self._decoder = decoder
        self._models = models
        self._output = output
        self._health = health
        self._width = width
        self._put = put
        self._reenter = reenter
        self._newest: RawFrame | None = None
        self._is_asked = False
        self.is_waited_for = False
        """Whether tracking waits for the answer."""
        self._left_ns: int | None = None  # the last frame before tracking came in again
        node.create_subscription(
            Empty, topics.MAP_REQUEST, lambda _: self._on_request(), topics.RELIABLE
        )

    def note_frame(self, raw: RawFrame) -> None:
        """Take a frame: it says what the camera is like."""
        self._newest = raw
        self._answer()

    def forget(self) -> None:
        """Wait for a camera again."""
        self._newest = None
        self._is_asked = self.is_waited_for = False

    def _on_request(self) -> None:
        self._live.is_entered = True
        self._is_asked = True
        self._answer()

    def _answer(self) -> None:
        if self._is_asked and self._newest is not None:
            self._is_asked, self.is_waited_for = False, True
            self._put(partial(self._show, self._newest))

    def _show(self, raw: RawFrame) -> None:
        view, is_answer = None, True
        try:
            camera = self._decoder.camera(raw)
            self._output.see_through(camera, raw.color.header.frame_id)
            with self._live.lock:
                if len(self._live.mapper.map):
                    start = self._where_it_starts()
                    view = entrance(self._live.mapper, start, camera, self._width)
            if view is not None:
                file = self._node.get_parameter('map_file').value
                check_entrance(view, Path(str(file or 'the map')))
        except BdgsError as error:
            self._health.error(error)
            is_answer = not self._live.poses  # tracking was in this map: it asks again
        finally:
            self.is_waited_for = False
            if is_answer:  # an empty one says that there is no map
                self._models.publish(NO_KEYFRAME_NS, view)

    def _where_it_starts(self) -> Pose:
        """Return where the camera was last, if tracking asks because it was restarted."""
        if not self._live.poses:
            return self._live.start_pose
        last = self._live.poses[-1]
        now = self._live.mapper.final_pose(last.stamp_ns, last.T_world_camera)
        if last.stamp_ns != self._left_ns:  # it may ask twice
            self._left_ns = last.stamp_ns
            self._reenter(last.stamp_ns, now @ se3.inverse(last.T_world_camera))
        return now
