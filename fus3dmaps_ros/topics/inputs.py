"""Subscriptions to cameras and poses, whose messages are paired into frames."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

from fus3dmaps_core.config.schema import Config
from fus3dmaps_core.ledger import Drops
from fus3dmaps_core.messages.fields import stamp_ns
from fus3dmaps_core.sources.pairing import FramePairer, PairedMessages
from fus3dmaps_core.sources.streams import Stream, uses_tf
from fus3dmaps_ros.topics.qos import named_qos
from fus3dmaps_ros.topics.tf_poses import TfListener

_TYPES: dict[str, type[Any]] = {
    "sensor_msgs/msg/Image": Image,
    "sensor_msgs/msg/CompressedImage": CompressedImage,
    "sensor_msgs/msg/CameraInfo": CameraInfo,
    "geometry_msgs/msg/PoseStamped": PoseStamped,
    "geometry_msgs/msg/PoseWithCovarianceStamped": PoseWithCovarianceStamped,
    "nav_msgs/msg/Odometry": Odometry,
}
# Deep enough for a pause of the interpreter of a third of a second at 30 Hz; the usual depth of 5 is not.
_IMAGE_DEPTH = 10
_POSE_DEPTH = 200
_POSE_PARAMETERS = ("input.pose_topic", "input.pose_with_covariance_topic", "input.odometry_topic")
_TF_PERIOD_S = 0.02  # Longest time that an image waits after its transform has come.


class Inputs:
    """Subscribes to colour, depth, camera models and poses, and passes complete frames on.

    Attributes:
        streams: The topics and their message types.
    """

    def __init__(
        self,
        node: Node,
        config: Config,
        take: Callable[[PairedMessages], None],
        drops: Drops,
        arrived: Callable[[str, int], None] | None = None,
    ) -> None:
        """Subscribe.

        Args:
            node: Owner of the subscriptions.
            config: Topics, pairing and QoS.
            take: Called with every complete frame, in stamp order; must not block.
            drops: Counts messages that led to no frame.
            arrived: Called with the topic and the stamp (nanoseconds) of every message.

        Raises:
            ConfigError: A mounting is not a pose, or TF is needed and not installed.
        """
        self._node = node
        self._lock = threading.Lock()
        self._take = take
        self._drops = drops
        self._arrived = arrived
        self._tf = TfListener(node) if uses_tf(config.input) else None
        self._pairer = FramePairer(config.input, self._tf)
        group = MutuallyExclusiveCallbackGroup()
        self.streams = self._pairer.streams()
        self._subscriptions = [
            node.create_subscription(
                _TYPES[stream.msgtype],
                stream.topic,
                self._callback(stream),
                named_qos(stream.profile, _POSE_DEPTH if stream.role == "pose" else _IMAGE_DEPTH),
                callback_group=group,
            )
            for stream in self.streams
        ]
        self._timer = None
        if self._tf is not None:
            # The pairer does not see messages on /tf, so it is polled. A steady clock: that of a simulation may stand still.
            self._timer = node.create_timer(
                _TF_PERIOD_S, self._hand_on, callback_group=group, clock=Clock(clock_type=ClockType.STEADY_TIME)
            )

    def reset(self) -> None:
        """Forget the messages that wait for their partners."""
        with self._lock:
            self._pairer.reset()

    def close(self) -> None:
        """Unsubscribe for good and forget what waits; can be called again."""
        if self._timer is not None:
            self._node.destroy_timer(self._timer)
            self._timer = None
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)
        self._subscriptions = []
        if self._tf is not None:
            self._tf.close()
        self.reset()

    def _callback(self, stream: Stream) -> Callable[[Any], None]:
        def received(message: Any) -> None:
            with self._lock:
                stream.add(message)
            if self._arrived is not None:
                self._arrived(stream.topic, stamp_ns(message))
            self._hand_on()

        return received

    def _hand_on(self) -> None:
        """Offer the frames that are complete and report what was dropped."""
        with self._lock:
            ready = self._pairer.poll()
        # Together: many images that are given up at once are one line in the log.
        self._pairer.drops.pour_into(self._drops)
        for paired in ready:
            self._take(paired)
