"""From ROS messages to arrays, without ROS: anything that has a message's fields will do.

The functions take ``sensor_msgs/Image``, ``sensor_msgs/CameraInfo``, ``geometry_msgs/PoseStamped`` and ``nav_msgs/Odometry``
as rclpy delivers them or as rosbags deserialises them. Every refusal is a FrameError whose message names the topic.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fus3dmaps_core.errors import FrameError
from fus3dmaps_core.frame import Intrinsics

_QUATERNION_TOLERANCE = 1e-2  # Publishers round; farther from unit length is not a rotation but a bug or an unset field.


class _Encoding(NamedTuple):
    """How a pixel is stored: scalar type, number of channels, and which of them are red, green and blue (or all three)."""

    dtype: np.dtype[Any]
    channels: int = 1
    rgb: slice = slice(0, 1)


_FORWARD, _BACKWARD = slice(0, 3), slice(2, None, -1)


_COLOR_ENCODINGS = {
    "rgb8": _Encoding(np.dtype(np.uint8), 3, _FORWARD),
    "bgr8": _Encoding(np.dtype(np.uint8), 3, _BACKWARD),
    "rgba8": _Encoding(np.dtype(np.uint8), 4, _FORWARD),
    "bgra8": _Encoding(np.dtype(np.uint8), 4, _BACKWARD),
    "mono8": _Encoding(np.dtype(np.uint8)),
}
_DEPTH_ENCODINGS = {
    "16UC1": _Encoding(np.dtype(np.uint16)),
    "mono16": _Encoding(np.dtype(np.uint16)),
    "32FC1": _Encoding(np.dtype(np.float32)),
}


def stamp_ns(message: Any) -> int:
    """The stamp of a message's header, nanoseconds since the epoch of its clock."""
    stamp = message.header.stamp
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def check_color(message: Any, topic: str) -> None:
    """Check a colour image's encoding, sizes and data length without touching its pixels.

    Raises:
        FrameError: Reasons ``unknown_encoding``, ``bad_image`` (no pixels, rows too short) or ``size_mismatch`` (the data
            is not height x step bytes).
    """
    _checked_encoding(message, topic, _COLOR_ENCODINGS)


def check_depth(message: Any, topic: str) -> None:
    """As :func:`check_color`, for a depth image."""
    _checked_encoding(message, topic, _DEPTH_ENCODINGS)


def decode_color(message: Any, topic: str) -> NDArray[np.uint8]:
    """The pixels of a colour or grey image as (H, W, 3) uint8, red first; a fresh array.

    Raises:
        FrameError: As :func:`check_color`.
    """
    encoding = _checked_encoding(message, topic, _COLOR_ENCODINGS)
    colors = _pixels(message, encoding)[:, :, encoding.rgb]
    return np.array(np.broadcast_to(colors, (*colors.shape[:2], 3)), order="C")


def decode_depth(message: Any, topic: str, unit_m: float) -> NDArray[np.float32]:
    """The readings of a depth image as (h, w) float32 metres; no reading stays 0 (16 bit) or 0, NaN or inf (float).

    Args:
        message: Image of encoding 16UC1, mono16 or 32FC1.
        topic: Where it came from, for error messages.
        unit_m: Metres per unit of a 16-bit image; float images are metres [REP-118].

    Raises:
        FrameError: As :func:`check_depth`.
    """
    encoding = _checked_encoding(message, topic, _DEPTH_ENCODINGS)
    readings = _pixels(message, encoding)[:, :, 0].astype(np.float32)
    if encoding.dtype == np.uint16:
        readings *= np.float32(unit_m)
    return readings


def to_intrinsics(message: Any, topic: str) -> Intrinsics:
    """The pinhole model of a ``CameraInfo``, for the image as published: region of interest and binning are applied.

    The raw camera matrix K is used; distortion coefficients are not: colour images are expected rectified, or of a lens
    whose distortion is negligible.

    Raises:
        FrameError: Reason ``bad_intrinsics``: a focal length or size is not positive, or a value not finite.
    """
    fx, _, cx, _, fy, cy = (float(value) for value in tuple(message.k)[:6])
    width, height = int(message.width), int(message.height)
    roi = message.roi
    if roi.width and roi.height:
        cx, cy, width, height = cx - roi.x_offset, cy - roi.y_offset, int(roi.width), int(roi.height)
    try:
        full = Intrinsics(fx, fy, cx, cy, width, height)
        return full.resized(width // max(int(message.binning_x), 1), height // max(int(message.binning_y), 1))
    except FrameError as error:
        raise FrameError(f"{topic}: {error}", reason=error.reason) from None


def to_pose(message: Any, topic: str) -> NDArray[np.float64]:
    """The pose of a ``PoseStamped`` or an ``Odometry`` as a (4, 4) float64 transform into its header's frame.

    Raises:
        FrameError: Reason ``bad_pose``: a value is not finite, or the quaternion's length is off 1 by more than 0.01.
    """
    pose = message.pose
    pose = getattr(pose, "pose", pose)  # Odometry wraps it with a covariance.
    position, orientation = pose.position, pose.orientation
    try:
        return transform_from(
            (position.x, position.y, position.z, orientation.x, orientation.y, orientation.z, orientation.w)
        )
    except FrameError as error:
        raise FrameError(f"{topic}: {error}", reason=error.reason) from None


def transform_from(values: tuple[float, ...] | list[float]) -> NDArray[np.float64]:
    """The (4, 4) transform of x, y, z (metres), qx, qy, qz, qw; the quaternion is normalised.

    Raises:
        FrameError: As :func:`to_pose`.
    """
    vector = np.asarray(values, dtype=np.float64)
    if not np.all(np.isfinite(vector)):
        raise FrameError(f"pose is not finite: {vector.tolist()}", reason="bad_pose")
    length = float(np.linalg.norm(vector[3:]))
    if abs(length - 1.0) > _QUATERNION_TOLERANCE:
        raise FrameError(
            f"quaternion {vector[3:].tolist()} has length {length:.4g}, which is not a rotation", reason="bad_pose"
        )
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat(vector[3:] / length).as_matrix()
    T[:3, 3] = vector[:3]
    return T


def _checked_encoding(message: Any, topic: str, encodings: dict[str, _Encoding]) -> _Encoding:
    encoding = encodings.get(message.encoding)
    if encoding is None:
        raise FrameError(
            f"{topic}: unknown encoding '{message.encoding}', known are {', '.join(encodings)}", reason="unknown_encoding"
        )
    height, width, step = int(message.height), int(message.width), int(message.step)
    if height <= 0 or width <= 0:
        raise FrameError(f"{topic}: image of {width}x{height} pixels", reason="bad_image")
    row_bytes = width * encoding.channels * encoding.dtype.itemsize
    if step < row_bytes:
        raise FrameError(
            f"{topic}: step of {step} bytes is too short for {width} pixels of {message.encoding} ({row_bytes} bytes)",
            reason="bad_image",
        )
    if len(message.data) != height * step:
        raise FrameError(
            f"{topic}: image of {height} rows of {step} bytes holds {len(message.data)} bytes, not {height * step}",
            reason="size_mismatch",
        )
    return encoding


def _pixels(message: Any, encoding: _Encoding) -> NDArray[Any]:
    """View of the pixels, (H, W, channels), in the byte order of the message."""
    height, width, step = int(message.height), int(message.width), int(message.step)
    row_bytes = width * encoding.channels * encoding.dtype.itemsize
    rows = np.frombuffer(message.data, dtype=np.uint8).reshape(height, step)[:, :row_bytes]
    dtype = encoding.dtype.newbyteorder(">" if message.is_bigendian else "<")
    return np.ascontiguousarray(rows).view(dtype).reshape(height, width, encoding.channels)
