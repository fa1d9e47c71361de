"""Publishers of the map, its instances, the camera's path, and the last answer that was asked to be published."""

from __future__ import annotations

import traceback
from collections.abc import Callable, Sequence

from nav_msgs.msg import Path
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.publisher import Publisher
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header
from visualization_msgs.msg import MarkerArray

from fus3dmaps_core.config.schema import Config
from fus3dmaps_msgs.msg import SemanticInstance
from fus3dmaps_ros.node.session import SessionHolder
from fus3dmaps_ros.node.timers import change_period
from fus3dmaps_ros.topics import conversions
from fus3dmaps_ros.topics.detections import to_detections, vision_messages
from fus3dmaps_ros.topics.qos import LATCHED

_LOG_PERIOD_S = 5.0


class Outputs:
    """Publishes the map periodically while someone subscribes, and answers on request.

    Periodically: ``~/map``, ``~/instances`` and ``~/path``. On request: ``~/similarity``, ``~/answer``, ``~/labels``, and
    ``~/detections`` where ``vision_msgs`` is installed.
    """

    def __init__(self, node: Node, sessions: SessionHolder, read: Callable[[], Config]) -> None:
        """Advertise the topics and start the timer.

        Args:
            node: Owner of the publishers.
            sessions: Has the map and the keyframes; without a session nothing is published.
            read: Returns the current configuration.
        """
        self._node = node
        self._log = node.get_logger()
        self._sessions = sessions
        self._read = read
        self._similarity = node.create_publisher(PointCloud2, "~/similarity", LATCHED)
        self._answer = node.create_publisher(MarkerArray, "~/answer", LATCHED)
        self._labels = node.create_publisher(PointCloud2, "~/labels", LATCHED)
        self._vision = vision_messages()
        self._detections = (
            None if self._vision is None else node.create_publisher(self._vision.Detection3DArray, "~/detections", LATCHED)
        )
        self._voxels = node.create_publisher(PointCloud2, "~/map", LATCHED)
        self._instances = node.create_publisher(MarkerArray, "~/instances", LATCHED)
        self._path = node.create_publisher(Path, "~/path", LATCHED)
        self._shown: dict[Publisher, tuple[object, int, int]] = {}
        # Steady: a paused simulation clock must not stop the display.
        self._timer = node.create_timer(
            read().node.publish_period_s,
            self._publish_map,
            callback_group=MutuallyExclusiveCallbackGroup(),
            clock=Clock(clock_type=ClockType.STEADY_TIME),
        )

    def header(self) -> Header:
        """Make a header with the map frame and the stamp of the latest mapped frame; 0 without one."""
        session = self._sessions.current
        return conversions.to_header(session.worker.stamp_ns if session else 0, self._read().input.map_frame)

    def publish_answer(self, similarity: PointCloud2, found: Sequence[SemanticInstance]) -> None:
        """Publish the voxels and instances of an answer."""
        self._similarity.publish(similarity)
        self._answer.publish(conversions.to_answer_markers(similarity.header, found))
        if self._vision is not None and self._detections is not None:
            self._detections.publish(to_detections(self._vision, similarity.header, found))

    def publish_labels(self, cloud: PointCloud2) -> None:
        """Publish a labelled map."""
        self._labels.publish(cloud)

    def clear_answers(self) -> None:
        """Replace the last answers, which are latched, by empty ones, because their map is gone."""
        header = self.header()
        self.publish_answer(conversions.empty_similarity_cloud(header), [])
        self._labels.publish(conversions.empty_label_cloud(header))

    def follow(self, config: Config) -> None:
        """Apply ``node.publish_period_s``."""
        change_period(self._node, self._timer, config.node.publish_period_s)

    def _publish_map(self) -> None:
        try:
            self.publish_map()
        except Exception:
            # For example there is no memory for a copy of the map. The next attempt may succeed, and mapping goes on.
            self._log.error(f"publishing the map failed\n{traceback.format_exc()}", throttle_duration_sec=_LOG_PERIOD_S)

    def publish_map(self) -> None:
        """Publish voxels, instances and keyframe poses, each if a subscriber has not got this state yet."""
        session = self._sessions.current
        if session is None:
            return
        semantic_map, revision = session.pipeline.semantic_map, session.worker.revision
        if self._is_due(self._voxels, session, revision):
            self._voxels.publish(conversions.to_map_cloud(self.header(), semantic_map.voxels()))
        if self._is_due(self._instances, session, revision):
            min_voxels = self._read().query.min_voxels
            self._instances.publish(conversions.to_markers(self.header(), semantic_map.instances(), min_voxels))
        if self._is_due(self._path, session, revision):
            self._path.publish(conversions.to_path(self.header(), session.pipeline.camera_poses()))

    def _is_due(self, publisher: Publisher, session: object, revision: int) -> bool:
        state = (session, revision, publisher.get_subscription_count())
        shown, self._shown[publisher] = self._shown.get(publisher), state
        return state[2] > 0 and (shown is None or state[0] is not shown[0] or state[1] != shown[1] or state[2] > shown[2])
