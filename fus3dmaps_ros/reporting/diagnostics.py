"""The health of the mapping on ``/diagnostics``, which ``rqt_robot_monitor``, Foxglove and aggregators read."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.node import Node

from fus3dmaps_core.health.diagnosis import Diagnosis, MapSizes, PartReport
from fus3dmaps_core.health.input_problems import Offer
from fus3dmaps_core.health.mapping_problems import MemoryState

TOPIC = "/diagnostics"
_DEPTH = 10


class Diagnostics:
    """Publishes one status per part (inputs, mapping, map, memory) periodically."""

    def __init__(
        self,
        node: Node,
        diagnosis: Diagnosis,
        topics: Sequence[str],
        read_sizes: Callable[[], MapSizes],
        read_memory: Callable[[], Sequence[MemoryState]],
        *,
        hardware_id: str,
        period_s: float = 1.0,
    ) -> None:
        """Advertise the topic and start the timer.

        Args:
            node: Owner of the publisher; its graph knows the QoS of the publishers of the inputs.
            diagnosis: The diagnosis to publish.
            topics: The topics of its streams.
            read_sizes: Returns how large the map is; called once a period by the executor.
            read_memory: Returns how full each memory is; called in the same way.
            hardware_id: The device that the status is about, e.g. the encoder's.
            period_s: Time between two messages, seconds.
        """
        self._node = node
        self._diagnosis = diagnosis
        self._topics = tuple(topics)
        self._read_sizes = read_sizes
        self._read_memory = read_memory
        self._hardware_id = hardware_id
        self._lock = threading.Lock()
        self._is_closed = False
        self._publisher = node.create_publisher(DiagnosticArray, TOPIC, _DEPTH)
        # Steady: a ROS clock that stands still is one of the problems to report.
        self._timer = node.create_timer(
            period_s,
            self.publish,
            callback_group=MutuallyExclusiveCallbackGroup(),
            clock=Clock(clock_type=ClockType.STEADY_TIME),
        )

    def publish(self) -> None:
        """Publish the current state."""
        offers = {topic: publishers_of(self._node, topic) for topic in self._topics}
        reports = self._diagnosis.report(self._read_sizes(), self._read_memory(), offers)
        message = DiagnosticArray(status=[self._to_status(report) for report in reports])
        message.header.stamp = self._node.get_clock().now().to_msg()
        with self._lock:
            if not self._is_closed:
                self._publisher.publish(message)

    def close(self) -> None:
        """Stop the timer and remove the topic."""
        with self._lock:  # A report that is being made now will not be published.
            self._is_closed = True
        self._node.destroy_timer(self._timer)
        self._node.destroy_publisher(self._publisher)

    def _to_status(self, report: PartReport) -> DiagnosticStatus:
        return DiagnosticStatus(
            level=bytes([report.level]),
            name=f"{self._node.get_fully_qualified_name().lstrip('/')}: {report.part}",
            message=report.message,
            hardware_id=self._hardware_id,
            values=[KeyValue(key=key, value=value) for key, value in report.values.items()],
        )


def publishers_of(node: Node, topic: str) -> list[Offer]:
    """Return the publishers of a topic that the node's graph knows now.

    Args:
        node: Resolves the name and knows the graph.
        topic: Name as the node uses it, before remapping.
    """
    return [
        Offer(
            node=f"{endpoint.node_namespace.rstrip('/')}/{endpoint.node_name}",
            reliability=endpoint.qos_profile.reliability.name,
            durability=endpoint.qos_profile.durability.name,
        )
        for endpoint in node.get_publishers_info_by_topic(node.resolve_topic_name(topic))
    ]
