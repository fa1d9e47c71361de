"""What the node publishes: the map, its instances and the similarity of the last published query."""

from __future__ import annotations

from collections.abc import Callable

from nav_msgs.msg import Path
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header
from visualization_msgs.msg import MarkerArray

from fus3dmaps_core.config import Config
from fus3dmaps_core.pipeline import Pipeline
from fus3dmaps_ros import conversions
from fus3dmaps_ros.worker import FrameWorker

LATCHED = QoSProfile(
    history=HistoryPolicy.KEEP_LAST,
    depth=1,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)
"""QoS of everything published: late subscribers get the last message."""


class Outputs:
    """Publishes ``~/similarity`` on request; ``~/map``, ``~/instances`` and ``~/path`` by period while someone listens."""

    def __init__(self, node: Node, pipeline: Pipeline, worker: FrameWorker, read: Callable[[], Config]) -> None:
        """Advertise the topics and start the timer.

        Args:
            node: Owner of the publishers.
            pipeline: Its map and keyframes are shown.
            worker: Knows when the map has changed and how new it is.
            read: Gives the configuration in force.
        """
        self._pipeline = pipeline
        self._worker = worker
        self._read = read
        self._similarity = node.create_publisher(PointCloud2, "~/similarity", LATCHED)
        self._voxels = node.create_publisher(PointCloud2, "~/map", LATCHED)
        self._instances = node.create_publisher(MarkerArray, "~/instances", LATCHED)
        self._path = node.create_publisher(Path, "~/path", LATCHED)
        self._shown: dict[Publisher, tuple[int, int]] = {}
        # Steady: under simulated time a paused clock must not stop what a person looks at.
        self._timer = node.create_timer(
            read().node.publish_period_s,
            self.publish_map,
            callback_group=MutuallyExclusiveCallbackGroup(),
            clock=Clock(clock_type=ClockType.STEADY_TIME),
        )

    def header(self) -> Header:
        """Map frame, and the stamp of the latest mapped frame."""
        return conversions.to_header(self._worker.stamp_ns, self._read().input.map_frame)

    def publish_similarity(self, cloud: PointCloud2) -> None:
        """Publish the voxels of an answer."""
        self._similarity.publish(cloud)

    def clear_similarity(self) -> None:
        """Replace the last answer, which is latched, by an empty one."""
        self._similarity.publish(conversions.empty_similarity_cloud(self.header()))

    def publish_map(self) -> None:
        """Publish voxels, instances and keyframe poses, each if it has a subscriber who has not seen this state yet."""
        if self._is_due(self._voxels):
            self._voxels.publish(conversions.to_map_cloud(self.header(), self._pipeline.semantic_map.voxels()))
        if self._is_due(self._instances):
            min_voxels = self._read().query.min_voxels
            self._instances.publish(
                conversions.to_markers(self.header(), self._pipeline.semantic_map.instances(), min_voxels)
            )

        if self._is_due(self._path):
            self._path.publish(conversions.to_path(self.header(), self._pipeline.camera_poses()))

    def _is_due(self, publisher: Publisher) -> bool:
        state = (self._worker.revision, publisher.get_subscription_count())
        shown, self._shown[publisher] = self._shown.get(publisher), state
        return state[1] > 0 and (shown is None or state[0] != shown[0] or state[1] > shown[1])
