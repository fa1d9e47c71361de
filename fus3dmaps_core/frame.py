"""What flows through the pipeline: a camera model and a posed RGB-D frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fus3dmaps_core.errors import FrameError

_ROTATION_TOLERANCE = 1e-3  # KinectFusion-like pose files carry about seven digits; anything worse is not a rotation.


@dataclass(frozen=True)
class Intrinsics:
    """Pinhole camera model, pixel centres at integer coordinates.

    Attributes:
        fx: Focal length along x, pixels.
        fy: Focal length along y, pixels.
        cx: Principal point x, pixels.
        cy: Principal point y, pixels.
        width: Image width, pixels.
        height: Image height, pixels.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int

    def __post_init__(self) -> None:
        """Raise FrameError (reason ``bad_intrinsics``) unless sizes and focal lengths are positive and all is finite."""
        values = (self.fx, self.fy, self.cx, self.cy)
        if not np.all(np.isfinite(values)) or self.fx <= 0 or self.fy <= 0 or self.width <= 0 or self.height <= 0:
            raise FrameError(f"camera intrinsics are not usable: {self}", reason="bad_intrinsics")

    @property
    def matrix(self) -> NDArray[np.float64]:
        """The 3x3 camera matrix K."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]], dtype=np.float64)

    def resized(self, width: int, height: int) -> Intrinsics:
        """Return the camera model of the image resized to ``width`` x ``height`` pixels."""
        sx, sy = width / self.width, height / self.height
        # Pixel centres are integers, so it is x + 0.5 that scales.
        return Intrinsics(self.fx * sx, self.fy * sy, (self.cx + 0.5) * sx - 0.5, (self.cy + 0.5) * sy - 0.5, width, height)


@dataclass(frozen=True, repr=False)
class PosedFrame:
    """One RGB-D image with the pose of its camera.

    Colour and depth may differ in size: both cover the same field of view and ``intrinsics`` describes the colour image.

    Attributes:
        stamp_ns: Time of the image, nanoseconds.
        rgb: (H, W, 3) uint8.
        depth_m: (h, w) float32 metres along the optical axis; 0, NaN or inf where there is no reading.
        intrinsics: Camera model of the colour image.
        T_world_camera: (4, 4) float64, pose of the optical frame (REP-103: x right, y down, z forward) in the map frame.
    """

    stamp_ns: int
    rgb: NDArray[np.uint8]
    depth_m: NDArray[np.float32]
    intrinsics: Intrinsics
    T_world_camera: NDArray[np.float64]

    def __post_init__(self) -> None:
        """Raise FrameError unless the arrays are what the attributes say.

        Raises:
            FrameError: Reasons ``bad_image``, ``bad_depth``, ``size_mismatch`` or ``bad_pose``.
        """
        for name, reason in (("rgb", "bad_image"), ("depth_m", "bad_depth"), ("T_world_camera", "bad_pose")):
            if not isinstance(getattr(self, name), np.ndarray):
                raise FrameError(f"{name} must be a numpy array, is a {type(getattr(self, name)).__name__}", reason=reason)
        if self.rgb.ndim != 3 or self.rgb.shape[2] != 3 or self.rgb.dtype != np.uint8 or self.rgb.size == 0:
            raise FrameError(f"rgb image must be (H, W, 3) uint8, got {self.rgb.shape} {self.rgb.dtype}", reason="bad_image")
        if self.depth_m.ndim != 2 or self.depth_m.dtype != np.float32 or self.depth_m.size == 0:
            raise FrameError(
                f"depth image must be (h, w) float32, got {self.depth_m.shape} {self.depth_m.dtype}", reason="bad_depth"
            )
        height, width = self.rgb.shape[:2]
        if (width, height) != (self.intrinsics.width, self.intrinsics.height):
            raise FrameError(
                f"rgb image is {width}x{height} but camera_info says {self.intrinsics.width}x{self.intrinsics.height}",
                reason="size_mismatch",
            )
        check_pose(self.T_world_camera)

    def __repr__(self) -> str:
        """Say when and where the frame was taken, and how large its images are."""
        (height, width), (depth_height, depth_width) = self.rgb.shape[:2], self.depth_m.shape
        x, y, z = self.T_world_camera[:3, 3]
        images = f"colour {width}x{height}, depth {depth_width}x{depth_height}"
        return f"PosedFrame({self.stamp_ns} ns, {images}, camera at ({x:.2f}, {y:.2f}, {z:.2f}) m)"


def check_pose(T: NDArray[np.float64]) -> None:
    """Raise FrameError (reason ``bad_pose``) unless ``T`` is a finite (4, 4) rigid transform."""
    if T.shape != (4, 4) or not np.all(np.isfinite(T)):
        raise FrameError(f"pose must be a finite 4x4 matrix, got shape {T.shape}:\n{T}", reason="bad_pose")
    R = T[:3, :3]
    if (
        np.abs(R @ R.T - np.eye(3)).max() > _ROTATION_TOLERANCE
        or np.linalg.det(R) < 0
        or np.abs(T[3] - (0, 0, 0, 1)).max() > _ROTATION_TOLERANCE
    ):
        raise FrameError(f"pose is not a rigid transform:\n{T}", reason="bad_pose")
