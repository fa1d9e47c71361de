"""Sources of the body's pose (messages or TF), and the mounting of each camera on the body."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from fus3dmaps_core.config.input import InputConfig
from fus3dmaps_core.errors import ConfigError, FrameError
from fus3dmaps_core.geometry.trajectory import PoseBuffer, PoseGap
from fus3dmaps_core.messages.fields import transform_from
from fus3dmaps_core.sources.streams import pose_topic
from fus3dmaps_core.sources.timeline import seconds
from fus3dmaps_core.sources.transforms import NoTransform, TransformBuffer, TransformGap

FOREVER_NS = 2**63
"""Waiting time of an image when no more messages will come."""

_REASONS = {
    TransformGap.UNKNOWN_FRAME: "tf_unknown_frame",
    TransformGap.NOT_CONNECTED: "tf_not_connected",
    TransformGap.BEFORE_FIRST: "no_pose",
    TransformGap.AFTER_LAST: "no_pose",
    TransformGap.TOO_WIDE: "pose_gap",
    TransformGap.UNUSABLE: "bad_transform",
}
_FINAL = (TransformGap.BEFORE_FIRST, TransformGap.TOO_WIDE, TransformGap.UNUSABLE)


@dataclass(frozen=True)
class Moment:
    """An image that waits for its pose.

    Attributes:
        topic: Topic of the image, for error messages.
        frame: Optical frame of its camera in TF.
        stamp_ns: Its stamp, nanoseconds.
        waited_ns: How far the other inputs are past its stamp, nanoseconds.
    """

    topic: str
    frame: str
    stamp_ns: int
    waited_ns: int


class PoseProvider(Protocol):
    """Poses of the body in the map frame over time."""

    def body_frame(self, moment: Moment) -> str:
        """Return the name of the body's frame in TF; empty if it is not known."""

    def at(self, moment: Moment) -> NDArray[np.float64] | None:
        """Return T_world_body at an image's stamp, (4, 4) float64, or None while it may still come.

        Raises:
            FrameError: It will not come: reasons ``no_pose``, ``pose_gap``, ``tf_unknown_frame``, ``tf_not_connected`` or
                ``bad_transform``.
        """

    def forget_before(self, stamp_ns: int) -> None:
        """Remove poses that no image of this stamp or later needs."""

    def clear(self) -> None:
        """Remove all poses, because time restarts."""


class BufferedPoses:
    """Poses that came as messages, interpolated. Images wait for them up to ``input.max_wait_s``.

    Attributes:
        child_frame: Name of the body in the latest odometry; empty for other messages.
    """

    def __init__(self, config: InputConfig) -> None:
        """Start empty."""
        self._topic = pose_topic(config)
        self._config = config
        self._max_wait_ns = round(config.max_wait_s * 1e9)
        self._buffer = PoseBuffer(config.max_pose_gap_s)
        self.child_frame = ""

    def add(self, stamp_ns: int, T_world_body: NDArray[np.float64]) -> None:
        """Append a pose whose stamp is later than that of every pose before."""
        self._buffer.add(stamp_ns, T_world_body)

    def body_frame(self, moment: Moment) -> str:
        """Return ``input.body_frame``, or the name in the odometry if that is empty."""
        return self._config.body_frame or self.child_frame

    def at(self, moment: Moment) -> NDArray[np.float64] | None:
        """Return T_world_body at an image's stamp; see :class:`PoseProvider`."""
        found = self._buffer.lookup(moment.stamp_ns)
        if not isinstance(found, PoseGap):
            return found
        if found is PoseGap.AFTER_LAST and moment.waited_ns <= self._max_wait_ns:
            return None
        if found is PoseGap.TOO_WIDE:
            raise FrameError(
                f"{self._topic}: poses around {seconds(moment.stamp_ns)} are more than"
                f" {self._config.max_pose_gap_s} s apart",
                reason="pose_gap",
            )
        first_ns, last_ns = self._buffer.first_ns, self._buffer.last_ns
        span = "none came" if first_ns is None or last_ns is None else f"they span {seconds(first_ns)} to {seconds(last_ns)}"
        raise FrameError(
            f"{moment.topic}: image at {seconds(moment.stamp_ns)} has no pose on {self._topic} ({span})", reason="no_pose"
        )

    def forget_before(self, stamp_ns: int) -> None:
        """Remove poses that no image of this stamp or later needs."""
        self._buffer.forget_before(stamp_ns)

    def clear(self) -> None:
        """Remove all poses."""
        self._buffer.clear()


class TransformPoses:
    """Poses of ``input.body_frame``, looked up in TF at the image's stamp; if that is empty, of the camera itself.

    Images wait for them up to ``input.tf_timeout_s``.
    """

    def __init__(self, config: InputConfig, transforms: TransformBuffer) -> None:
        """Use ``transforms`` for the lookups."""
        self._config = config
        self._transforms = transforms

    def body_frame(self, moment: Moment) -> str:
        """Return ``input.body_frame``, or the camera's own frame if that is empty."""
        return self._config.body_frame or moment.frame

    def at(self, moment: Moment) -> NDArray[np.float64] | None:
        """Return T_world_body at an image's stamp; see :class:`PoseProvider`."""
        return transform_at(self._transforms, self._config, self._config.map_frame, self.body_frame(moment), moment)

    def forget_before(self, stamp_ns: int) -> None:
        """Do nothing: the buffer bounds itself."""

    def clear(self) -> None:
        """Remove all moving transforms."""
        self._transforms.clear()


class Mounting:
    """The mounting of one camera: T_body_camera and T_rgb_depth, from parameters or from TF.

    TF is asked at each image's stamp, so a camera on a moving neck works as well as a fixed one.
    """

    def __init__(self, config: InputConfig, index: int, transforms: TransformBuffer | None) -> None:
        """Read the parameters.

        Args:
            config: The inputs.
            index: Number of the camera.
            transforms: TF, used if ``input.extrinsic_source`` is ``tf``.

        Raises:
            ConfigError: A parameter is not a pose; the message names it.
        """
        self._config = config
        self._transforms = transforms if config.extrinsic_source == "tf" else None
        self._T_body_camera = _pose_parameter("T_body_camera", config.T_body_camera, index)
        self._T_rgb_depth = _pose_parameter("T_rgb_depth", config.T_rgb_depth, index)

    def body_camera(self, moment: Moment, body_frame: str) -> NDArray[np.float64] | None:
        """Return T_body_camera, (4, 4) float64, or None while it may still come.

        Raises:
            FrameError: As :meth:`PoseProvider.at`.
        """
        if self._transforms is None:
            return self._T_body_camera
        return transform_at(self._transforms, self._config, body_frame, moment.frame, moment)

    def rgb_depth(self, moment: Moment, depth_frame: str) -> NDArray[np.float64] | None:
        """Return T_rgb_depth, (4, 4) float64, or None while it may still come.

        Raises:
            FrameError: As :meth:`PoseProvider.at`.
        """
        if self._transforms is None:
            return self._T_rgb_depth
        return transform_at(self._transforms, self._config, moment.frame, depth_frame, moment)


def transform_at(
    transforms: TransformBuffer, config: InputConfig, target_frame: str, source_frame: str, moment: Moment
) -> NDArray[np.float64] | None:
    """Return T_target_source at an image's stamp, or None while it may still come within ``input.tf_timeout_s``.

    Raises:
        FrameError: As :meth:`PoseProvider.at`; the message names both frames.
    """
    if not target_frame or not source_frame:
        raise FrameError(
            f"{moment.topic}: image at {seconds(moment.stamp_ns)} cannot be looked up in TF: a message names no frame; set"
            " 'input.camera_frame' or 'input.body_frame'",
            reason="tf_unknown_frame",
        )
    if target_frame.lstrip("/") == source_frame.lstrip("/"):
        return np.eye(4)
    found = transforms.lookup(target_frame, source_frame, moment.stamp_ns)
    if not isinstance(found, NoTransform):
        return found
    if found.gap not in _FINAL and moment.waited_ns <= round(config.tf_timeout_s * 1e9):
        return None
    raise FrameError(
        f"{moment.topic}: image at {seconds(moment.stamp_ns)} has no transform from '{source_frame}' to '{target_frame}':"
        f" {found.detail}",
        reason=_REASONS[found.gap],
    )


def _pose_parameter(name: str, values: list[float], index: int) -> NDArray[np.float64]:
    own = values if len(values) == 7 else values[7 * index : 7 * index + 7]
    try:
        return transform_from(own)
    except FrameError as error:
        raise ConfigError(f"parameter 'input.{name}': {error}") from None
