"""ROS messages for tests, made of rosbags' types, so that no ROS is needed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_typestore

TYPESTORE = get_typestore(Stores.ROS2_JAZZY)


def make(msgtype: str, *values: Any) -> Any:
    return TYPESTORE.types[msgtype](*values)


def header(stamp_ns: int, frame_id: str = "camera") -> Any:
    stamp = make("builtin_interfaces/msg/Time", *divmod(stamp_ns, 1_000_000_000))
    return make("std_msgs/msg/Header", stamp, frame_id)


def image(
    stamp_ns: int = 0,
    encoding: str = "rgb8",
    pixels: np.ndarray | None = None,
    *,
    padding: int = 0,
    big_endian: bool = False,
    **changes: Any,
) -> Any:
    """An image message of the given pixels; ``padding`` bytes of 0xAB follow each row, ``changes`` overwrite fields."""
    if pixels is None:
        pixels = np.zeros((4, 6, 3), np.uint8) if encoding == "rgb8" else np.zeros((4, 6), np.uint16)
    height, width = pixels.shape[:2]
    ordered = np.ascontiguousarray(pixels.astype(pixels.dtype.newbyteorder(">" if big_endian else "<")))
    rows = ordered.reshape(height, -1).view(np.uint8)
    rows = np.hstack([rows, np.full((height, padding), 0xAB, np.uint8)])
    message = make(
        "sensor_msgs/msg/Image",
        header(stamp_ns),
        height,
        width,
        encoding,
        int(big_endian),
        rows.shape[1],
        np.ascontiguousarray(rows).reshape(-1),
    )
    for name, value in changes.items():
        setattr(message, name, value)
    return message


def camera_info(
    stamp_ns: int = 0,
    width: int = 6,
    height: int = 4,
    focal: float = 5.0,
    *,
    binning: tuple[int, int] = (0, 0),
    roi: tuple[int, int, int, int] = (0, 0, 0, 0),
) -> Any:
    """A camera model; ``roi`` is x offset, y offset, height, width."""
    K = np.array([focal, 0, (width - 1) / 2, 0, focal, (height - 1) / 2, 0, 0, 1], float)
    return make(
        "sensor_msgs/msg/CameraInfo",
        header(stamp_ns),
        height,
        width,
        "plumb_bob",
        np.zeros(5),
        K,
        np.eye(3).ravel(),
        np.zeros(12),
        *binning,
        make("sensor_msgs/msg/RegionOfInterest", *roi, False),
    )


def pose(
    stamp_ns: int = 0,
    position: Sequence[float] = (0.0, 0.0, 0.0),
    quaternion: Sequence[float] = (0.0, 0.0, 0.0, 1.0),
    frame_id: str = "map",
) -> Any:
    return make("geometry_msgs/msg/PoseStamped", header(stamp_ns, frame_id), _pose(position, quaternion))


def odometry(
    stamp_ns: int = 0,
    position: Sequence[float] = (0.0, 0.0, 0.0),
    quaternion: Sequence[float] = (0.0, 0.0, 0.0, 1.0),
    frame_id: str = "map",
) -> Any:
    still = make("geometry_msgs/msg/Vector3", 0.0, 0.0, 0.0)
    return make(
        "nav_msgs/msg/Odometry",
        header(stamp_ns, frame_id),
        "base_link",
        make("geometry_msgs/msg/PoseWithCovariance", _pose(position, quaternion), np.zeros(36)),
        make("geometry_msgs/msg/TwistWithCovariance", make("geometry_msgs/msg/Twist", still, still), np.zeros(36)),
    )


def pose_with_covariance(
    stamp_ns: int = 0,
    position: Sequence[float] = (0.0, 0.0, 0.0),
    quaternion: Sequence[float] = (0.0, 0.0, 0.0, 1.0),
    frame_id: str = "map",
) -> Any:
    return make(
        "geometry_msgs/msg/PoseWithCovarianceStamped",
        header(stamp_ns, frame_id),
        make("geometry_msgs/msg/PoseWithCovariance", _pose(position, quaternion), np.zeros(36)),
    )


def compressed(stamp_ns: int, image_format: str, data: bytes) -> Any:
    return make("sensor_msgs/msg/CompressedImage", header(stamp_ns), image_format, np.frombuffer(data, np.uint8))


def transforms(*edges: tuple[Any, ...]) -> Any:
    """A message of edges: parent, child, stamp, translation and, if it is turned, quaternion."""
    stamped = []
    for parent, child, stamp_ns, translation, *turn in edges:
        quaternion = turn[0] if turn else (0.0, 0.0, 0.0, 1.0)
        transform = make(
            "geometry_msgs/msg/Transform",
            make("geometry_msgs/msg/Vector3", *translation),
            make("geometry_msgs/msg/Quaternion", *quaternion),
        )
        stamped.append(make("geometry_msgs/msg/TransformStamped", header(stamp_ns, parent), child, transform))
    return make("tf2_msgs/msg/TFMessage", stamped)


def _pose(position: Sequence[float], quaternion: Sequence[float]) -> Any:
    return make(
        "geometry_msgs/msg/Pose",
        make("geometry_msgs/msg/Point", *position),
        make("geometry_msgs/msg/Quaternion", *quaternion),
    )
