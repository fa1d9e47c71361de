"""Lens distortion: the models that ROS names, and images as a camera without it would have taken them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from fus3dmaps_core.errors import FrameError
from fus3dmaps_core.frame import Intrinsics

_FISHEYE = "equidistant"
# The order is OpenCV's: k1, k2, p1, p2, k3 | k4, k5, k6 | s1 to s4 of a thin prism | two tilts. Drivers publish any prefix.
_COUNTS = {"plumb_bob": (4, 5), "rational_polynomial": (8, 12, 14), _FISHEYE: (4,)}
_PROFILE_SAMPLES = 4096  # Steps of the search for where a model folds: a fraction of a pixel each.
_OUTSIDE = np.float32(-1e4)  # No pixel of a source image, and none between pixels.


@dataclass(frozen=True)
class Distortion:
    """What a lens adds to the pinhole camera, as ``sensor_msgs/CameraInfo`` states it.

    Attributes:
        model: ``plumb_bob``, ``rational_polynomial`` or ``equidistant``.
        coefficients: 4 or 5, 8, 12 or 14, and 4 of them, in the order of ``CameraInfo.d``.
    """

    model: str
    coefficients: tuple[float, ...]

    def __post_init__(self) -> None:
        """Raise FrameError (reason ``bad_intrinsics``): an unknown model, a wrong number of coefficients, one not finite."""
        counts = _COUNTS.get(self.model)
        if counts is None:
            raise FrameError(
                f"unknown distortion model '{self.model}', known are {', '.join(_COUNTS)}", reason="bad_intrinsics"
            )
        if len(self.coefficients) not in counts or not np.all(np.isfinite(self.coefficients)):
            raise FrameError(
                f"distortion '{self.model}' takes {' or '.join(map(str, counts))} finite coefficients, "
                f"got {list(self.coefficients)}",
                reason="bad_intrinsics",
            )


class Rectifier:
    """The step from images of a camera with distortion to those of the pinhole camera with the same intrinsics.

    Focal lengths, principal point and size stay, so that the camera model of the images stays the one that came with them;
    what a wide lens saw beyond its edges is lost, and where the lens saw nothing is 0. Depth stays what it is, for it is
    measured along the axis, not along the ray. The maps are computed once. Immutable: threads may share it.
    """

    def __init__(self, intrinsics: Intrinsics, distortion: Distortion) -> None:
        """Compute where in the distorted image each pixel of the pinhole camera comes from.

        Args:
            intrinsics: Camera model of the images, before and after.
            distortion: Distortion of the lens.
        """
        self._size = (intrinsics.width, intrinsics.height)
        coefficients = np.array(distortion.coefficients)
        make_maps: Any = cv2.fisheye.initUndistortRectifyMap if _is_fisheye(distortion) else cv2.initUndistortRectifyMap
        K = intrinsics.matrix
        columns, rows = make_maps(K, coefficients, np.eye(3), K, self._size, cv2.CV_32FC1)
        radii = _radii(intrinsics)
        folded = radii >= _fold_radius(distortion, float(radii.max()))
        unknown = folded | ~np.isfinite(columns) | ~np.isfinite(rows)
        self._columns = np.where(unknown, _OUTSIDE, np.asarray(columns, np.float32))
        self._rows = np.where(unknown, _OUTSIDE, np.asarray(rows, np.float32))

    def color(self, rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Rectify a colour image bilinearly.

        Args:
            rgb: (H, W, 3) uint8 of the size of the intrinsics.

        Returns:
            (H, W, 3) uint8, black where the lens saw nothing.

        Raises:
            FrameError: Reason ``size_mismatch``.
        """
        return self._moved(rgb, cv2.INTER_LINEAR).astype(np.uint8, copy=False)

    def depth(self, depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
        """Rectify a depth image by nearest neighbour: means across an edge would be points in the air.

        Args:
            depth_m: (H, W) float32 metres along the optical axis, of the size of the intrinsics.

        Returns:
            (H, W) float32 metres, 0 where the lens saw nothing. Each value is one of the input's.

        Raises:
            FrameError: Reason ``size_mismatch``.
        """
        return self._moved(depth_m, cv2.INTER_NEAREST).astype(np.float32, copy=False)

    def _moved(self, image: NDArray[Any], interpolation: int) -> NDArray[Any]:
        if (image.shape[1], image.shape[0]) != self._size:
            width, height = self._size
            raise FrameError(
                f"image to rectify is {image.shape[1]}x{image.shape[0]}, its camera model {width}x{height}",
                reason="size_mismatch",
            )
        moved = cv2.remap(image, self._columns, self._rows, interpolation, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
        return np.asarray(moved)


def _is_fisheye(distortion: Distortion) -> bool:
    return distortion.model == _FISHEYE


def _radii(intrinsics: Intrinsics) -> NDArray[np.float64]:
    """Compute the distance of each pixel's ray from the axis, at depth 1, (H, W)."""
    x = (np.arange(intrinsics.width) - intrinsics.cx) / intrinsics.fx
    y = (np.arange(intrinsics.height) - intrinsics.cy) / intrinsics.fy
    radii: NDArray[np.float64] = np.hypot(x[None, :], y[:, None])
    return radii


def _fold_radius(distortion: Distortion, largest: float) -> float:
    """Find the radius at depth 1 up to which the distorted radius grows with it; infinite if it always does.

    Polynomials are fitted to what the lens sees. Beyond, they may turn back and show the image a second time, mirrored.
    """
    r = np.linspace(0, largest * (1 + 2 / _PROFILE_SAMPLES), _PROFILE_SAMPLES)
    k = np.array(distortion.coefficients)
    if _is_fisheye(distortion):
        theta = np.arctan(r)
        distorted = theta * np.polynomial.polynomial.polyval(theta**2, [1, *k])
    else:
        k3 = k[4] if len(k) > 4 else 0.0
        distorted = r * np.polynomial.polynomial.polyval(r**2, [1, k[0], k[1], k3])
        if len(k) > 5:
            with np.errstate(divide="ignore", invalid="ignore"):
                distorted = distorted / np.polynomial.polynomial.polyval(r**2, [1, *k[5:8]])
    turns = np.flatnonzero(~(np.diff(distorted) > 0))
    return float(r[turns[0]]) if len(turns) else np.inf
