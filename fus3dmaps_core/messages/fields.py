"""Conversion of ROS messages to arrays, without ROS: any object with the fields of the message is accepted.

The functions take ``sensor_msgs/CameraInfo`` and poses as rclpy delivers them or as rosbags deserialises them. A message
that cannot be used raises a FrameError that names the topic. Images are decoded in :mod:`fus3dmaps_core.messages.images`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fus3dmaps_core.errors import FrameError
from fus3dmaps_core.frame import Intrinsics
from fus3dmaps_core.geometry.distortion import Distortion
from fus3dmaps_core.messages.images import about

_QUATERNION_TOLERANCE = 1e-2  # Publishers round. A larger deviation is a bug or an unset field, not a rotation.


def stamp_ns(message: Any) -> int:
    """Return the stamp of a message's header, nanoseconds since the epoch of its clock."""
    stamp = message.header.stamp
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def to_intrinsics(message: Any, topic: str) -> Intrinsics:
    """Return the pinhole model of a ``CameraInfo`` for the image as published, with region of interest and binning applied.

    The raw camera matrix K is used; :func:`to_distortion` gives the lens distortion.

    Raises:
        FrameError: Reason ``bad_intrinsics``: a focal length or size is not positive, or a value not finite.
    """
    fx, _, cx, _, fy, cy = (float(value) for value in tuple(message.k)[:6])
    width, height = int(message.width), int(message.height)
    roi = message.roi
    if roi.width and roi.height:
        cx, cy, width, height = cx - roi.x_offset, cy - roi.y_offset, int(roi.width), int(roi.height)
    with about(topic):
        full = Intrinsics(fx, fy, cx, cy, width, height)
        return full.resized(width // max(int(message.binning_x), 1), height // max(int(message.binning_y), 1))


def to_distortion(message: Any, topic: str) -> Distortion | None:
    """Return the lens distortion of a ``CameraInfo``, or None if the image needs no rectification.

    It belongs to the model of :func:`to_intrinsics`. Coefficients apply to rays, not to pixels, so region of interest and
    binning do not change them. As in ROS, None stands for an unset model or coefficients that are all 0, even of
    ``equidistant``.

    Raises:
        FrameError: Reason ``bad_intrinsics``: an unknown model, a wrong number of coefficients or a value not finite.
    """
    model = str(message.distortion_model)
    coefficients = tuple(float(value) for value in message.d)
    with about(topic):
        if not np.all(np.isfinite(coefficients)):
            raise FrameError(f"distortion coefficients {coefficients} are not finite", reason="bad_intrinsics")
        if not model or not any(coefficients):
            return None
        return Distortion(model, coefficients)


def to_pose(message: Any, topic: str) -> NDArray[np.float64]:
    """Return the (4, 4) pose of a ``PoseStamped``, ``PoseWithCovarianceStamped`` or ``Odometry`` in its header's frame.

    Raises:
        FrameError: Reason ``bad_pose``: a value is not finite, or the quaternion's length is off 1 by more than 0.01.
    """
    pose = message.pose
    pose = getattr(pose, "pose", pose)  # The latter two wrap it with a covariance.
    with about(topic):
        return _transform(pose.position, pose.orientation)


def transform_of(message: Any, topic: str) -> NDArray[np.float64]:
    """Return the (4, 4) transform of a ``TransformStamped``, the pose of its child frame in its header's frame.

    Raises:
        FrameError: As :func:`to_pose`.
    """
    with about(topic):
        return _transform(message.transform.translation, message.transform.rotation)


def transform_from(values: tuple[float, ...] | list[float]) -> NDArray[np.float64]:
    """Return the (4, 4) transform for x, y, z (metres), qx, qy, qz, qw. The quaternion is normalised.

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


def _transform(position: Any, orientation: Any) -> NDArray[np.float64]:
    return transform_from((position.x, position.y, position.z, orientation.x, orientation.y, orientation.z, orientation.w))
