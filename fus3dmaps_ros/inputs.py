"""Subscriptions to what a camera and a localisation publish, paired into frames."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable
from typing import Any

from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, Image

from fus3dmaps_core.config import Config
from fus3dmaps_core.sources.pairing import FramePairer, PairedMessages
from fus3dmaps_ros.drops import DropLog

_RELIABILITY = {"sensor_data": ReliabilityPolicy.BEST_EFFORT, "reliable": ReliabilityPolicy.RELIABLE}
# Deep enough to ride out a pause of the interpreter of a third of a second at 30 Hz; the profile's usual 5 are not.
_IMAGE_DEPTH = 10
_POSE_DEPTH = 200


class Inputs:
    """Subscribes to colour, depth, camera model and poses, and hands complete frames on."""

    def __init__(self, node: Node, config: Config, take: Callable[[PairedMessages], None], drops: DropLog) -> None:
        """Subscribe.

        Args:
            node: Owner of the subscriptions.
            config: Topics, pairing and QoS.
            take: Gets every complete frame, in stamp order; must not block.
            drops: Counts what led to no frame.
        """
        self._pairer = FramePairer(config.input)
        self._lock = threading.Lock()
        self._take = take
        self._drops = drops
        self._reported: Counter[str] = Counter()
        topics, pairer = config.input, self._pairer
        odometry = topics.pose_source == "odometry"
        streams: list[tuple[type[Any], str, Callable[[Any], None], int]] = [
            (CameraInfo, topics.camera_info_topic, pairer.add_camera_info, _IMAGE_DEPTH),
            (Image, topics.rgb_topic, pairer.add_rgb, _IMAGE_DEPTH),
            (Image, topics.depth_topic, pairer.add_depth, _IMAGE_DEPTH),
            (
                Odometry if odometry else PoseStamped,
                topics.odometry_topic if odometry else topics.pose_topic,
                pairer.add_pose,
                _POSE_DEPTH,
            ),
        ]
        group = MutuallyExclusiveCallbackGroup()
        self._node = node
        self._topics = [topic for _, topic, _, _ in streams]
        self._subscriptions = [
            node.create_subscription(
                message_type, topic, self._callback(add), input_qos(config.node.input_qos, depth), callback_group=group
            )
            for message_type, topic, add, depth in streams
        ]

    def reset(self) -> None:
        """Forget the messages that wait for their partners."""
        with self._lock:
            self._pairer.reset()

    def silent(self) -> list[str]:
        """A phrase for every topic on which nothing has come yet, with the number of its publishers."""
        with self._lock:
            received = set(self._pairer.received)
        return [
            f"{subscription.topic_name} ({self._node.count_publishers(subscription.topic_name)} publishers)"
            for topic, subscription in zip(self._topics, self._subscriptions, strict=True)
            if topic not in received
        ]

    def _callback(self, add: Callable[[Any], None]) -> Callable[[Any], None]:
        def received(message: Any) -> None:
            with self._lock:
                add(message)
                ready = self._pairer.poll()
                news = {
                    reason: (count - self._reported[reason], self._pairer.last_drop[reason])
                    for reason, count in self._pairer.drops.items()
                    if count > self._reported[reason]
                }
                self._reported = Counter(self._pairer.drops)
            for reason, (number, sentence) in news.items():
                self._drops.count(reason, sentence, number)
            for paired in ready:
                self._take(paired)

        return received


def input_qos(profile: str, depth: int) -> QoSProfile:
    """The QoS of an input by profile name (``sensor_data`` or ``reliable``); matches latched publishers as well."""
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
        reliability=_RELIABILITY[profile],
        durability=DurabilityPolicy.VOLATILE,
    )
