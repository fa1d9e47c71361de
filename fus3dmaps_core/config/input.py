"""The section ``input`` of the configuration schema: topics, transports, frames and how messages are matched."""

from __future__ import annotations

import re
from typing import Literal

from pydantic import Field, ValidationInfo, field_validator

from fus3dmaps_core.config.section import Section

QosProfile = Literal["sensor_data", "reliable", "transient_local", "best_available"]
"""Subscriptions: best effort; reliable; reliable with earlier messages; the most that publishers offer at the start."""

_NAMESPACE = re.compile(r"[A-Za-z_]\w*(/[A-Za-z_]\w*)*", re.ASCII)


class InputConfig(Section):
    """How messages become posed frames, live and from recordings."""

    cameras: str = Field(
        "",
        validate_default=True,
        description="Several cameras: comma-separated names, each the namespace of one camera's image and camera_info"
        " topics (front,rear: front/rgb/image, ...). Empty: one camera, the topics as they are.",
    )
    rgb_topic: str = Field(
        "rgb/image", min_length=1, validate_default=True, description="Colour images (without the transport's suffix)."
    )
    rgb_transport: Literal["raw", "compressed"] = Field(
        "raw",
        description="Colour images are sensor_msgs/Image, or sensor_msgs/CompressedImage (JPEG, PNG) on"
        " rgb_topic/compressed.",
    )
    depth_topic: str = Field(
        "depth/image", min_length=1, validate_default=True, description="Depth images (without the transport's suffix)."
    )
    depth_transport: Literal["raw", "compressed", "compressedDepth"] = Field(
        "raw",
        description="Depth images are sensor_msgs/Image, or sensor_msgs/CompressedImage: on depth_topic/compressed (PNG) or"
        " depth_topic/compressedDepth (PNG, RVL).",
    )
    camera_info_topic: str = Field(
        "rgb/camera_info", min_length=1, validate_default=True, description="Camera model of the colour images."
    )
    rectify: bool = Field(
        True,
        description="Undo the lens distortion that camera_info states; false for images that are rectified already.",
    )
    depth_registered: bool = Field(
        True,
        description="Depth images show what the colour camera sees, lens distortion included; false: they are of another"
        " camera and are registered to colour here.",
    )
    depth_camera_info_topic: str = Field(
        "depth/camera_info",
        min_length=1,
        validate_default=True,
        description="Camera model of depth images that are not registered.",
    )
    pose_source: Literal["pose", "pose_with_covariance", "odometry", "tf"] = Field(
        "pose", description="Where poses come from: one of the three topics, or TF (map_frame to body or camera frame)."
    )
    pose_topic: str = Field("pose", min_length=1, description="Poses (geometry_msgs/PoseStamped).")
    pose_with_covariance_topic: str = Field(
        "pose_with_covariance", min_length=1, description="Poses (geometry_msgs/PoseWithCovarianceStamped)."
    )
    odometry_topic: str = Field("odom", min_length=1, description="Poses (nav_msgs/Odometry).")
    map_frame: str = Field("map", min_length=1, description="Frame of the poses and of everything published.")
    camera_frame: str = Field(
        "",
        validate_default=True,
        description="Optical frame of the camera in TF (of several: comma-separated). Empty: frame_id of the colour images.",
    )
    extrinsic_source: Literal["parameter", "tf"] = Field(
        "parameter",
        description="Whether T_body_camera and T_rgb_depth are these parameters, or looked up in TF at the image's stamp.",
    )
    body_frame: str = Field(
        "",
        validate_default=True,
        description="TF frame whose pose is published. Empty: child_frame_id of the odometry; the camera frame with"
        " pose_source tf.",
    )
    T_body_camera: list[float] = Field(
        [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0],
        min_length=7,
        validate_default=True,
        description="Pose of the camera's optical frame in the frame whose pose is published: x, y, z (m), qx, qy, qz, qw;"
        " of several cameras, 7 numbers each.",
    )
    T_rgb_depth: list[float] = Field(
        [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0],
        min_length=7,
        validate_default=True,
        description="Pose of the depth camera in the colour camera (optical frames), for depth that is not registered;"
        " numbers as in T_body_camera, 7 for all cameras or 7 each.",
    )
    sync_tolerance_s: float = Field(0.02, ge=0.0, description="Largest stamp difference of colour and depth, seconds.")
    max_pose_gap_s: float = Field(0.5, gt=0.0, description="Poses farther apart than this are not interpolated, seconds.")
    max_wait_s: float = Field(2.0, gt=0.0, description="Images that wait longer for depth or pose are dropped, seconds.")
    tf_timeout_s: float = Field(0.5, gt=0.0, description="Images that wait longer for a transform are dropped, seconds.")
    rgb_qos: QosProfile = Field("sensor_data", description="QoS profile of colour images.")
    depth_qos: QosProfile = Field("sensor_data", description="QoS profile of depth images.")
    camera_info_qos: QosProfile = Field("sensor_data", description="QoS profile of the camera models.")
    pose_qos: QosProfile = Field("sensor_data", description="QoS profile of poses.")

    @property
    def camera_names(self) -> list[str]:
        """Namespaces of the cameras in order; one empty name where there is one camera."""
        return [name.strip() for name in self.cameras.split(",")]

    @field_validator("cameras")
    @classmethod
    def _namespaces(cls, value: str) -> str:
        names = [name.strip() for name in value.split(",")]
        if value and not all(_NAMESPACE.fullmatch(name) for name in names):
            raise ValueError("must be comma-separated relative namespaces (letters, digits, _, / within)")
        if len(set(names)) != len(names):
            raise ValueError("names a camera twice")
        return value

    @field_validator("rgb_topic", "depth_topic", "camera_info_topic", "depth_camera_info_topic")
    @classmethod
    def _within_namespaces(cls, value: str, info: ValidationInfo) -> str:
        if info.data.get("cameras") and value.startswith(("/", "~")):
            raise ValueError("must be a relative name where 'input.cameras' names several, whose namespaces go before it")
        return value

    @field_validator("camera_frame")
    @classmethod
    def _frame_of_each(cls, value: str, info: ValidationInfo) -> str:
        if value and len(value.split(",")) != _camera_count(info):
            raise ValueError(f"must name {_camera_count(info)} frames, one for each of 'input.cameras'")
        return value

    @field_validator("body_frame")
    @classmethod
    def _body_is_known(cls, value: str, info: ValidationInfo) -> str:
        if not value and info.data.get("extrinsic_source") == "tf" and "pose" in str(info.data.get("pose_source")):
            raise ValueError("must be set where 'input.extrinsic_source' is tf and poses do not name their frame")
        return value

    @field_validator("T_body_camera")
    @classmethod
    def _mounting_of_each(cls, value: list[float], info: ValidationInfo) -> list[float]:
        count = _camera_count(info)
        # Where the extrinsics, or poses of the cameras themselves, come from TF, one value may stand for all.
        tf = info.data.get("extrinsic_source") == "tf"
        tf |= info.data.get("pose_source") == "tf" and not info.data.get("body_frame")
        if len(value) != 7 * count and not (tf and len(value) == 7):
            raise ValueError(f"must hold 7 numbers for each camera ({7 * count})")
        return value

    @field_validator("T_rgb_depth")
    @classmethod
    def _depth_of_each(cls, value: list[float], info: ValidationInfo) -> list[float]:
        count = _camera_count(info)
        if len(value) not in (7, 7 * count):
            raise ValueError(f"must hold 7 numbers, or 7 for each camera ({7 * count})")
        return value


def _camera_count(info: ValidationInfo) -> int:
    return len(str(info.data.get("cameras", "")).split(","))
