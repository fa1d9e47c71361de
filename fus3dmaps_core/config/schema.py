"""The one configuration schema: defaults, units, ranges and descriptions.

The dotted keys of :class:`Config` (``map.voxel_size_m``) are the ROS parameters, the keys of the YAML files and what the
command line's ``--set`` takes. Defaults are the paper's [sec: Parameter Overview] wherever it states one. A running node
takes another value of a ``Changeable`` parameter at any time, of a ``Fixed`` one never, of all others while unconfigured.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Literal

import yaml
from pydantic import BaseModel, Field, ValidationError
from pydantic.fields import FieldInfo

from fus3dmaps_core.config.input import InputConfig
from fus3dmaps_core.config.section import Changeable, Fixed, Section
from fus3dmaps_core.errors import ConfigError

Runtime = Literal["torch", "compile", "onnxruntime", "tensorrt"]
"""What runs an encoder's networks."""

Precision = Literal["fp32", "fp16", "bf16"]
"""Number format of an exported graph's weights and sums."""


class EncoderConfig(Section):
    """Which vision-language encoders describe the images."""

    name: str = Field("lite", description="Encoder trio: patch, crop and text encoder of one space.")
    device: str = Field("cpu", description="Torch device of the encoders, e.g. cpu or cuda:0.")
    weights: str = Field(
        "",
        description="Weights of the encoders: a file, a directory that holds them, or a repository of the Hugging Face hub"
        " (org/repo or org/repo@revision). Empty: those that the authors published, from the local cache or downloaded.",
    )
    instance_embeddings: Literal["crops", "patches"] = Field(
        "crops",
        description="What describes a mask: the crop encoder, which sees its box (crops), or the mean of the patch"
        " embeddings under it, weighted by distance to its edge (patches), which costs no second encoder.",
    )
    runtime: Runtime = Field(
        "torch",
        description="What runs the networks: torch, torch.compile (compile), or the exported graph in ONNX Runtime"
        " (onnxruntime) or TensorRT (tensorrt, on CUDA).",
    )
    precision: Precision = Field(
        "fp16", description="Precision of the exported graph that tensorrt runs; the other runtimes take the encoder's own."
    )
    graph_directory: str = Field(
        "",
        description="Directory of exported graphs and TensorRT engines, which are made there if they are missing. Empty:"
        " ~/.cache/fus3dmaps/graphs.",
    )


class SegmenterConfig(Section):
    """How images are cut into class-agnostic masks."""

    name: str = Field("lite", description="Segmenter that proposes the masks.")
    weights: str = Field(
        "",
        description="Weights of the segmenter: a file, a directory or a repository, as encoder.weights. Empty: published.",
    )
    min_area_px: Changeable[int] = Field(
        400, ge=1, description="Masks with fewer pixels (at the working resolution) are dropped."
    )
    max_border_contact: Changeable[float] = Field(
        0.2, ge=0.0, le=1.0, description="Masks with a larger share of their contour on the image border are dropped."
    )
    max_masks: Changeable[int] = Field(64, ge=1, description="At most this many masks of a frame are used, largest first.")
    crop_padding: float = Field(
        0.05, ge=0.0, le=1.0, description="Padding around a mask's bounding box, as a share of its size."
    )


class ImageConfig(Section):
    """Working resolution and depth range."""

    width: int = Field(640, ge=32, description="Width images are resized to, pixels.")
    height: int = Field(480, ge=32, description="Height images are resized to, pixels.")
    depth_min_m: float = Field(0.1, ge=0.0, description="Nearer depth readings give no point, metres.")
    depth_max_m: float = Field(6.0, gt=0.0, description="Farther depth readings give no point, metres.")
    depth_unit_m: float = Field(0.001, gt=0.0, description="Metres per unit of a 16-bit depth image (REP-118: 0.001).")


class KeyframeConfig(Section):
    """Motion since the last keyframe that makes the next one; either threshold suffices."""

    dense_translation_m: Changeable[float] = Field(0.08, ge=0.0, description="Translation for a dense keyframe, metres.")
    dense_rotation_rad: Changeable[float] = Field(0.06, ge=0.0, description="Rotation for a dense keyframe, radians.")
    instance_translation_m: Changeable[float] = Field(
        0.14, ge=0.0, description="Translation for an instance keyframe, metres."
    )
    instance_rotation_rad: Changeable[float] = Field(0.11, ge=0.0, description="Rotation for an instance keyframe, radians.")


class SamplingConfig(Section):
    """How many pixels of an encoder patch become points."""

    dense_per_patch: int = Field(5, ge=1, le=256, description="Pixels sampled per patch for the dense layer.")
    instance_per_patch: int = Field(9, ge=1, le=256, description="Pixels sampled per patch for the instance layer.")


class MapConfig(Section):
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
    memory_budget_mib: Changeable[float] = Field(
        0.0,
        ge=0.0,
        description="What the map may take on its device, host or GPU alike, MiB; near it the window shrinks and the least"
        " observed voxels lose their dense embedding. 0: no bound.",
    )


class FusionConfig(Section):
    """Cross-layer fusion and the sliding window."""

    variance_ratio: float = Field(
        0.0, ge=0.0, description="lambda = R_dense / R_instance; 0 takes the value of the encoder trio."
    )
    window_radius_m: float = Field(
        0.0, ge=0.0, description="Radius of the sliding window of the dense layer, metres; 0 keeps the whole dense layer."
    )
    period_frames: Changeable[int] = Field(
        5, ge=1, description="With a sliding window, fuse after every n-th processed frame."
    )
    keep_most_evidence: bool = Field(
        True,
        description="With a sliding window, replace an object's fused embedding only by one of more evidence; false replaces"
        " it at every fusion by that of what is left in the window.",
    )


class QueryConfig(Section):
    """Answers to queries."""

    top_k: Changeable[int] = Field(5, ge=1, description="Instances returned where a query does not say how many.")
    min_voxels: Changeable[int] = Field(4, ge=1, description="Instances with fewer voxels are not ranked.")


class NodeConfig(Section):
    """The ROS node."""

    queue_size: int = Field(4, ge=1, description="Frames that wait for the worker; the oldest is dropped when full.")
    publish_period_s: Changeable[float] = Field(
        2.0, gt=0.0, description="Period of ~/map, ~/instances and ~/path while someone subscribes, seconds."
    )
    status_period_s: Changeable[float] = Field(1.0, gt=0.0, description="Period of ~/status, seconds.")
    service_timeout_s: Changeable[float] = Field(
        30.0, gt=0.0, description="Longest time that a service takes before it replies that it was not done, seconds."
    )
    map_directory: Changeable[str] = Field("~/.ros/fus3dmaps", min_length=1, description="Directory that holds saved maps.")
    autosave_period_s: Changeable[float] = Field(
        0.0, ge=0.0, description="Period of saving a map that has changed into node.map_directory, seconds; 0: never."
    )
    resume: bool = Field(False, description="Start with the newest good map of node.map_directory, where there is one.")
    autostart: Fixed[bool] = Field(
        True, description="Load the models and map at once; false leaves both to a manager of lifecycle nodes."
    )


class Config(Section):
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
        """Return every value under its dotted key, in the order of the schema."""
        return dict(_flatten(self.model_dump()))

    def with_values(self, values: Mapping[str, Any]) -> Config:
        """Return a copy in which the values of the given dotted keys are replaced.

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
    """Return the schema's fields (default, description, bounds) under their dotted keys, in order."""
    return dict(_FIELDS)


_FIELDS: dict[str, FieldInfo] = {
    f"{section}.{name}": field
    for section, holder in Config.model_fields.items()
    if isinstance(holder.default, BaseModel)
    for name, field in type(holder.default).model_fields.items()
}
