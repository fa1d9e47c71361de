"""The input topics of the map: their names, message types and QoS, the same for the live node and for recordings."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

from fus3dmaps_core.config.input import InputConfig, QosProfile

_POSE_TYPES = {
    "pose": "geometry_msgs/msg/PoseStamped",
    "pose_with_covariance": "geometry_msgs/msg/PoseWithCovarianceStamped",
    "odometry": "nav_msgs/msg/Odometry",
}


class Qos(NamedTuple):
    """What a subscription asks of publishers, by ROS's names.

    Attributes:
        reliability: ``RELIABLE``, ``BEST_EFFORT`` or ``BEST_AVAILABLE``.
        durability: ``TRANSIENT_LOCAL``, ``VOLATILE`` or ``BEST_AVAILABLE``.
    """

    reliability: str
    durability: str


QOS_PROFILES: dict[QosProfile, Qos] = {
    "sensor_data": Qos("BEST_EFFORT", "VOLATILE"),
    "reliable": Qos("RELIABLE", "VOLATILE"),
    "transient_local": Qos("RELIABLE", "TRANSIENT_LOCAL"),
    "best_available": Qos("BEST_AVAILABLE", "BEST_AVAILABLE"),
}


@dataclass(frozen=True)
class Stream:
    """One input topic of the map.

    Attributes:
        topic: Its name as configured, with camera and transport.
        role: What its messages are.
        msgtype: Message type, e.g. ``sensor_msgs/msg/Image``.
        parameter: Key of the parameter that names the topic.
        profile: QoS profile of the subscription.
        add: Takes a message.
    """

    topic: str
    role: Literal["rgb", "depth", "pose", "camera_info"]
    msgtype: str
    parameter: str
    profile: QosProfile
    add: Callable[[Any], None]

    @property
    def qos(self) -> Qos:
        """Reliability and durability of the profile."""
        return QOS_PROFILES[self.profile]

    @property
    def qos_parameter(self) -> str:
        """Key of the parameter that chooses the profile."""
        return f"input.{self.role}_qos"

    @property
    def once(self) -> bool:
        """Whether one message is enough, as for a latched camera model: silence after it is no problem."""
        return self.role == "camera_info"


@dataclass(frozen=True)
class CameraTopics:
    """Topics of one camera.

    Attributes:
        rgb: Colour images, with the transport's suffix.
        depth: Depth images, with the transport's suffix.
        camera_info: Camera model of the colour images.
        depth_camera_info: Camera model of the depth images, None if they are registered to colour.
    """

    rgb: str
    depth: str
    camera_info: str
    depth_camera_info: str | None


def camera_topics(config: InputConfig) -> list[CameraTopics]:
    """Return the topics of each camera, in the order of ``input.cameras``."""
    topics = []
    for name in config.camera_names:
        namespace = f"{name}/" if name else ""
        topics.append(
            CameraTopics(
                namespace + _with_transport(config.rgb_topic, config.rgb_transport),
                namespace + _with_transport(config.depth_topic, config.depth_transport),
                namespace + config.camera_info_topic,
                None if config.depth_registered else namespace + config.depth_camera_info_topic,
            )
        )
    return topics


def image_type(transport: str) -> str:
    """Return the message type of images of a transport."""
    return "sensor_msgs/msg/Image" if transport == "raw" else "sensor_msgs/msg/CompressedImage"


def pose_parameter(config: InputConfig) -> str:
    """Return the name of the configuration field that holds the pose topic; has no meaning with TF."""
    return f"{config.pose_source}_topic"


def pose_topic(config: InputConfig) -> str:
    """Return the topic of the poses, or ``TF`` if they come from there."""
    return "TF" if config.pose_source == "tf" else str(getattr(config, pose_parameter(config)))


def pose_type(config: InputConfig) -> str | None:
    """Return the message type of the poses, None if they come from TF."""
    return _POSE_TYPES.get(config.pose_source)


def uses_tf(config: InputConfig) -> bool:
    """Return whether poses or extrinsics are looked up in TF."""
    return "tf" in (config.pose_source, config.extrinsic_source)


def _with_transport(topic: str, transport: str) -> str:
    """Return the name under which image_transport publishes."""
    return topic if transport == "raw" or topic.endswith(f"/{transport}") else f"{topic}/{transport}"
