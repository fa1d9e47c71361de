"""The one configuration schema: defaults, units, ranges and descriptions.

The dotted keys of :class:`Config` (``map.voxel_size_m``) are the ROS parameters, the keys of the YAML files and what the
command line's ``--set`` takes. Defaults are the paper's [sec: Parameter Overview] wherever it states one.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Literal

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, ValidationInfo, field_validator
from pydantic.fields import FieldInfo

from fus3dmaps_core.errors import ConfigError

QosProfile = Literal["sensor_data", "reliable", "transient_local", "best_available"]
"""Subscriptions: best effort; reliable; reliable with earlier messages; the most that publishers offer at the start."""

_NAMESPACE = re.compile(r"[A-Za-z_]\w*(/[A-Za-z_]\w*)*", re.ASCII)


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class EncoderConfig(_Section):
    """Which vision-language encoders describe the images."""

    name: str = Field("lite", description="Encoder trio: patch, crop and text encoder of one space.")
    device: str = Field("cpu", description="Torch device of the encoders, e.g. cpu or cuda:0.")
    weights: str = Field(
        "",
        description="Weights of the encoders: a file, a directory that holds them, or a repository of the Hugging Face hub"
        " (org/repo or org/repo@revision). Empty: those that the authors published, from the local cache or downloaded.",
    )


class SegmenterConfig(_Section):
    """How images are cut into class-agnostic masks."""

    name: str = Field("lite", description="Segmenter that proposes the masks.")
    min_area_px: int = Field(400, ge=1, description="Masks with fewer pixels (at the working resolution) are dropped.")
    max_border_contact: float = Field(
        0.2, ge=0.0, le=1.0, description="Masks with a larger share of their contour on the image border are dropped."
    )
    max_masks: int = Field(64, ge=1, description="At most this many masks of a frame are used, largest first.")
    crop_padding: float = Field(
        0.05, ge=0.0, le=1.0, description="Padding around a mask's bounding box, as a share of its size."
    )


class ImageConfig(_Section):
    """Working resolution and depth range."""

    width: int = Field(640, ge=32, description="Width images are resized to, pixels.")
    height: int = Field(480, ge=32, description="Height images are resized to, pixels.")
    depth_min_m: float = Field(0.1, ge=0.0, description="Nearer depth readings give no point, metres.")
    depth_max_m: float = Field(6.0, gt=0.0, description="Farther depth readings give no point, metres.")
    depth_unit_m: float = Field(0.001, gt=0.0, description="Metres per unit of a 16-bit depth image (REP-118: 0.001).")


class KeyframeConfig(_Section):
    """Motion since the last keyframe that makes the next one; either threshold suffices."""

    dense_translation_m: float = Field(0.08, ge=0.0, description="Translation for a dense keyframe, metres.")
    dense_rotation_rad: float = Field(0.06, ge=0.0, description="Rotation for a dense keyframe, radians.")
    instance_translation_m: float = Field(0.14, ge=0.0, description="Translation for an instance keyframe, metres.")
    instance_rotation_rad: float = Field(0.11, ge=0.0, description="Rotation for an instance keyframe, radians.")


class SamplingConfig(_Section):
    """How many pixels of an encoder patch become points."""

    dense_per_patch: int = Field(5, ge=1, le=256, description="Pixels sampled per patch for the dense layer.")
    instance_per_patch: int = Field(9, ge=1, le=256, description="Pixels sampled per patch for the instance layer.")


class MapConfig(_Section):
    """The voxel map."""

    voxel_size_m: float = Field(0.05, gt=0.0, le=10.0, description="Edge of a voxel, metres.")
    max_hypotheses: int = Field(3, ge=1, le=16, description="Object hypotheses a voxel can hold (K).")
    iou_threshold: float = Field(
        0.2, ge=0.0, lt=1.0, description="Voxel IoU above which a proposal joins an existing instance."
    )
    association: Literal["iou", "visible_iou"] = Field(
        "iou",
        description="What a proposal is compared with: all voxels of an instance (iou), or those of its voxels in which the"
        " keyframe has a point (visible_iou), so that a view of a small part can join a large object.",
    )
    merge_overlap: float = Field(
        0.0,
        ge=0.0,
        le=1.0,
        description="Two instances that meet in a keyframe become one where they share this much of the smaller one's voxels"
        " and are as alike as merge_cosine says. 0: never.",
    )
    merge_cosine: float = Field(
        0.8, ge=-1.0, le=1.0, description="Cosine that the embeddings of two instances must have, at least, to become one."
    )
    dtype: Literal["float32", "float16", "int8"] = Field("float16", description="Storage type of dense embeddings.")
    device: str = Field("cpu", description="Torch device that holds the map, e.g. cpu or cuda:0.")
    backend: Literal["auto", "compiled", "torch"] = Field(
        "auto", description="Inner loops: compiled (CPU only), torch (any device), or auto: compiled where they run."
    )
    memory_budget_mib: float = Field(
        0.0,
        ge=0.0,
        description="What the map may take on its device, host or GPU alike, MiB; near it the window shrinks and the least"
        " observed voxels lose their dense embedding. 0: no bound.",
    )


class FusionConfig(_Section):
    """Cross-layer fusion and the sliding window."""

    variance_ratio: float = Field(
        0.0, ge=0.0, description="lambda = R_dense / R_instance; 0 takes the value of the encoder trio."
    )
    window_radius_m: float = Field(
        0.0, ge=0.0, description="Radius of the sliding window of the dense layer, metres; 0 keeps the whole dense layer."
    )
    period_frames: int = Field(5, ge=1, description="With a sliding window, fuse after every n-th processed frame.")
    keep_most_evidence: bool = Field(
        True,
        description="With a sliding window, replace an object's fused embedding only by one of more evidence; false replaces"
        " it at every fusion by that of what is left in the window.",
    )


class QueryConfig(_Section):
    """Answers to queries."""

    top_k: int = Field(5, ge=1, description="Instances returned where a query does not say how many.")
    min_voxels: int = Field(4, ge=1, description="Instances with fewer voxels are not ranked.")


class InputConfig(_Section):
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


class NodeConfig(_Section):
    """The ROS node."""

    queue_size: int = Field(4, ge=1, description="Frames that wait for the worker; the oldest is dropped when full.")
    publish_period_s: float = Field(
        2.0, gt=0.0, description="Period of ~/map, ~/instances and ~/path while someone subscribes, seconds."
    )
    status_period_s: float = Field(1.0, gt=0.0, description="Period of ~/status, seconds.")
    service_timeout_s: float = Field(
        30.0, gt=0.0, description="Longest time that a service takes before it replies that it was not done, seconds."
    )
    map_directory: str = Field("~/.ros/fus3dmaps", min_length=1, description="Directory that holds saved maps.")
    autosave_period_s: float = Field(
        0.0, ge=0.0, description="Period of saving a map that has changed into node.map_directory, seconds; 0: never."
    )
    resume: bool = Field(False, description="Start with the newest good map of node.map_directory, where there is one.")
    autostart: bool = Field(
        True, description="Load the models and map at once; false leaves both to a manager of lifecycle nodes."
    )


class Config(_Section):
    """Everything that can be configured."""

    encoder: EncoderConfig = EncoderConfig()
    segmenter: SegmenterConfig = SegmenterConfig()
    image: ImageConfig = ImageConfig()
    keyframes: KeyframeConfig = KeyframeConfig()
    sampling: SamplingConfig = SamplingConfig()
    map: MapConfig = MapConfig()
    fusion: FusionConfig = FusionConfig()
    query: QueryConfig = QueryConfig()
    input: InputConfig = InputConfig()
    node: NodeConfig = NodeConfig()

    @classmethod
    def from_flat(cls, values: Mapping[str, Any]) -> Config:
        """Build a configuration from dotted keys; missing ones take their default.

        Raises:
            ConfigError: A key is unknown or a value is of the wrong type or out of range; the message names the key.
        """
        nested: dict[str, dict[str, Any]] = {}
        for key, value in values.items():
            section, _, name = key.partition(".")
            if key not in _FIELDS:
                raise ConfigError(f"unknown parameter '{key}'")
            nested.setdefault(section, {})[name] = value
        try:
            return cls.model_validate(nested)
        except ValidationError as error:
            raise ConfigError(_describe(error)) from None

    @classmethod
    def from_yaml(cls, path: Path) -> Config:
        """Read a ROS parameter file (``/**: ros__parameters: ...``) or the same tree without these two levels.

        Raises:
            ConfigError: The file cannot be read or holds something that the schema refuses; the message names both.
        """
        try:
            tree = yaml.safe_load(path.read_text())
        except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
            raise ConfigError(f"cannot read configuration '{path}': {error}") from None
        if isinstance(tree, dict) and len(tree) == 1:
            (inner,) = tree.values()
            if isinstance(inner, dict) and "ros__parameters" in inner:
                tree = inner["ros__parameters"]
        if not isinstance(tree or {}, dict):
            raise ConfigError(f"configuration '{path}' is not a mapping")
        try:
            return cls.from_flat(dict(_flatten(tree or {})))
        except ConfigError as error:
            raise ConfigError(f"{path}: {error}") from None

    def flat(self) -> dict[str, Any]:
        """Every value under its dotted key, in the order of the schema."""
        return dict(_flatten(self.model_dump()))

    def with_values(self, values: Mapping[str, Any]) -> Config:
        """A copy in which the given dotted keys are replaced.

        Raises:
            ConfigError: As :meth:`from_flat`.
        """
        return Config.from_flat({**self.flat(), **values})


def _flatten(tree: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in tree.items():
        if isinstance(value, Mapping):
            yield from _flatten(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def _describe(error: ValidationError) -> str:
    return "; ".join(
        f"parameter '{'.'.join(str(part) for part in item['loc'])}': {item['msg']} (got {item['input']!r})"
        for item in error.errors()
    )


def fields() -> dict[str, FieldInfo]:
    """The schema's fields (default, description, bounds) under their dotted keys, in order."""
    return dict(_FIELDS)


_FIELDS: dict[str, FieldInfo] = {
    f"{section}.{name}": field
    for section, holder in Config.model_fields.items()
    if isinstance(holder.default, BaseModel)
    for name, field in type(holder.default).model_fields.items()
}
