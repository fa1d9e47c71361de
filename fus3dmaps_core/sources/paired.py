"""A colour and a depth image that belong together, and their conversion to a posed frame."""

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
        distortion: Distortion of its lens, None if there is none to undo.
    """

    intrinsics: Intrinsics
    distortion: Distortion | None
    _rectifiers: dict[tuple[int, int], Rectifier] = field(default_factory=dict, init=False, repr=False, compare=False)

    def rectified_color(self, rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Remove the lens distortion from an (H, W, 3) colour image."""
        rectifier = self._rectifier(*rgb.shape[:2])
        return rgb if rectifier is None else rectifier.color(rgb)

    def rectified_depth(self, depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
        """Remove the lens distortion from an (h, w) depth image in metres, of the same view at any resolution."""
        rectifier = self._rectifier(*depth_m.shape)
        return depth_m if rectifier is None else rectifier.depth(depth_m)

    def _rectifier(self, height: int, width: int) -> Rectifier | None:
        if self.distortion is None:
            return None
        if (width, height) not in self._rectifiers:
            # Coefficients apply to normalised coordinates, so they hold at any resolution.
            self._rectifiers[width, height] = Rectifier(self.intrinsics.resized(width, height), self.distortion)
        return self._rectifiers[width, height]


@dataclass(frozen=True)
class UnregisteredDepth:
    """The camera of a depth image that was not taken by the colour camera.

    Attributes:
        model: The camera.
        T_rgb_depth: (4, 4) float64, its pose in the colour camera's optical frame.
    """

    model: CameraModel
    T_rgb_depth: NDArray[np.float64]


@dataclass(frozen=True)
class PairedMessages:
    """A colour and a depth image, not yet decoded, with their pose and camera model.

    Attributes:
        stamp_ns: Stamp of the colour image, nanoseconds.
        T_world_camera: (4, 4) float64, pose of the optical frame in the map frame at that stamp.
        model: Camera of the colour image.
        rgb: The colour image message.
        depth: The depth image message.
        rgb_topic: Topic of the colour image, for error messages.
        depth_topic: Topic of the depth image, for error messages.
        unregistered: Camera of the depth image, None if the image is registered to colour.
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
        """Decode both images, rectify them and register depth to colour.

        Both images keep the resolution of their message; depth that has to be registered takes that of colour.

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
