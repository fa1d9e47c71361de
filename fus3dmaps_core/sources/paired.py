"""A colour and a depth image that belong together, and what it takes to make a posed frame of them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fus3dmaps_core.config.schema import ImageConfig
from fus3dmaps_core.errors import FrameError
from fus3dmaps_core.frame import Intrinsics, PosedFrame
from fus3dmaps_core.geometry.distortion import Distortion, Rectifier
from fus3dmaps_core.geometry.registration import register_depth
from fus3dmaps_core.messages.images import decode_color, decode_depth


@dataclass(frozen=True)
class CameraModel:
    """A camera as its ``camera_info`` describes it.

    Attributes:
        intrinsics: Pinhole model of the rectified image.
        distortion: Of its lens; None where there is none to undo.
    """

    intrinsics: Intrinsics
    distortion: Distortion | None
    _rectifiers: dict[tuple[int, int], Rectifier] = field(default_factory=dict, init=False, repr=False, compare=False)

    def rectified_color(self, rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """A colour image without the lens's distortion, (H, W, 3)."""
        rectifier = self._rectifier(*rgb.shape[:2])
        return rgb if rectifier is None else rectifier.color(rgb)

    def rectified_depth(self, depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
        """A depth image of the same view in any resolution without the lens's distortion, (h, w) metres."""
        rectifier = self._rectifier(*depth_m.shape)
        return depth_m if rectifier is None else rectifier.depth(depth_m)

    def _rectifier(self, height: int, width: int) -> Rectifier | None:
        if self.distortion is None:
            return None
        if (width, height) not in self._rectifiers:
            # Coefficients are those of normalised coordinates, so that they hold at any resolution.
            self._rectifiers[width, height] = Rectifier(self.intrinsics.resized(width, height), self.distortion)
        return self._rectifiers[width, height]


@dataclass(frozen=True)
class UnregisteredDepth:
    """Of the camera that took a depth image, where that is not the colour camera.

    Attributes:
        model: The camera.
        T_rgb_depth: (4, 4) float64, its pose in the colour camera's optical frame.
    """

    model: CameraModel
    T_rgb_depth: NDArray[np.float64]


@dataclass(frozen=True)
class PairedMessages:
    """A colour and a depth image with the pose and the camera model that belong to them, not yet decoded.

    Attributes:
        stamp_ns: Stamp of the colour image, nanoseconds.
        T_world_camera: (4, 4) float64, pose of the optical frame in the map frame at that stamp.
        model: Camera of the colour image.
        rgb: The colour image message.
        depth: The depth image message.
        rgb_topic: Topic of the colour image, for error messages.
        depth_topic: Topic of the depth image, for error messages.
        unregistered: Camera of the depth image, None where the image is registered to colour.
    """

    stamp_ns: int
    T_world_camera: NDArray[np.float64]
    model: CameraModel
    rgb: Any
    depth: Any
    rgb_topic: str
    depth_topic: str
    unregistered: UnregisteredDepth | None = None

    @property
    def intrinsics(self) -> Intrinsics:
        """Pinhole model of the colour image."""
        return self.model.intrinsics

    def decode(self, image: ImageConfig) -> PosedFrame:
        """The frame with its pixels, rectified, depth registered to colour.

        Colour is at the resolution of its message; so is depth, unless it had to be registered.

        Args:
            image: ``depth_unit_m`` scales 16-bit depth.

        Raises:
            FrameError: The images or the pose are not usable.
        """
        rgb = decode_color(self.rgb, self.rgb_topic)
        depth_m = decode_depth(self.depth, self.depth_topic, image.depth_unit_m)
        check_size((rgb.shape[1], rgb.shape[0]), self.intrinsics, self.rgb_topic, "its camera_info")
        if self.unregistered is None:
            depth_m = self.model.rectified_depth(depth_m)
        else:
            depth = self.unregistered
            size = (depth_m.shape[1], depth_m.shape[0])
            check_size(size, depth.model.intrinsics, self.depth_topic, "its camera_info")
            depth_m = register_depth(
                depth.model.rectified_depth(depth_m), depth.model.intrinsics, self.intrinsics, depth.T_rgb_depth
            )
        return PosedFrame(self.stamp_ns, self.model.rectified_color(rgb), depth_m, self.intrinsics, self.T_world_camera)


def check_size(size: tuple[int, int], intrinsics: Intrinsics, topic: str, camera_info: str) -> None:
    """Raise FrameError (reason ``size_mismatch``) unless an image's (width, height) is that of its camera model."""
    if size != (intrinsics.width, intrinsics.height):
        raise FrameError(
            f"{topic}: image is {size[0]}x{size[1]} but {camera_info} says {intrinsics.width}x{intrinsics.height}",
            reason="size_mismatch",
        )
