"""From an RGB-D image to points in the map frame: resize, sample a fixed pattern per patch, unproject."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from fus3dmaps_core.config.schema import ImageConfig
from fus3dmaps_core.frame import Intrinsics, PosedFrame


@dataclass(frozen=True)
class WorkingFrame:
    """A frame at the working resolution.

    Attributes:
        rgb: (H, W, 3) uint8.
        depth_m: (H, W) float32 metres, 0 where there is no valid reading.
        intrinsics: Camera model of this resolution.
    """

    rgb: NDArray[np.uint8]
    depth_m: NDArray[np.float32]
    intrinsics: Intrinsics


def resize_frame(frame: PosedFrame, image: ImageConfig) -> WorkingFrame:
    """Bring a frame to the working resolution and blank depth that is not usable.

    Colour is resized by area or bilinearly, depth by nearest neighbour (means across an edge are points in the air), and
    the camera model with them. Depth that is 0, NaN, infinite or outside [depth_min_m, depth_max_m] becomes 0.
    """
    size = (image.width, image.height)
    rgb, depth = frame.rgb, frame.depth_m
    if (rgb.shape[1], rgb.shape[0]) != size:
        shrinks = rgb.shape[1] > size[0]
        rgb = cv2.resize(rgb, size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR).astype(np.uint8)
    if (depth.shape[1], depth.shape[0]) != size:
        depth = cv2.resize(depth, size, interpolation=cv2.INTER_NEAREST_EXACT).astype(np.float32)
    usable = np.isfinite(depth) & (depth > 0) & (depth >= image.depth_min_m) & (depth <= image.depth_max_m)
    return WorkingFrame(rgb, np.where(usable, depth, np.float32(0)), frame.intrinsics.resized(image.width, image.height))


def sample_pattern(count: int) -> NDArray[np.float64]:
    """Return where in a patch pixels are sampled: a fixed pattern, so that runs repeat bit for bit.

    Args:
        count: Pixels per patch. 5 gives a quincunx, a square number a regular grid, any other number the first points of
            the R2 low-discrepancy sequence.

    Returns:
        (count, 2) fractions of the patch's height and width in (0, 1).
    """
    if count == 5:
        return np.array([[0.25, 0.25], [0.25, 0.75], [0.5, 0.5], [0.75, 0.25], [0.75, 0.75]])
    side = round(count**0.5)
    if side * side == count:
        ticks = (np.arange(side) + 0.5) / side
        return np.stack(np.meshgrid(ticks, ticks, indexing="ij"), axis=-1).reshape(-1, 2)
    plastic = 1.32471795724474602596  # Real root of x^3 = x + 1, the two-dimensional golden ratio.
    steps = np.array([1.0 / plastic, 1.0 / plastic**2])
    return np.asarray((0.5 + np.arange(1, count + 1)[:, None] * steps) % 1.0)


@dataclass(frozen=True)
class PixelSamples:
    """Sampled pixels of an image and the patch each lies in.

    Attributes:
        ys: (n,) int64 pixel rows.
        xs: (n,) int64 pixel columns.
        patches: (n,) int64, row-major index of the patch in its grid.
    """

    ys: NDArray[np.int64]
    xs: NDArray[np.int64]
    patches: NDArray[np.int64]


@lru_cache(maxsize=16)
def sample_pixels(height: int, width: int, rows: int, columns: int, per_patch: int) -> PixelSamples:
    """Sample the pixels of an image that a grid of ``rows`` x ``columns`` patches covers.

    Patch (r, c) spans rows r H / rows to (r + 1) H / rows, so any image size goes with any grid.
    """
    pattern = sample_pattern(per_patch)
    r, c = np.divmod(np.arange(rows * columns), columns)
    ys = np.floor((r[:, None] + pattern[None, :, 0]) * (height / rows)).astype(np.int64).ravel()
    xs = np.floor((c[:, None] + pattern[None, :, 1]) * (width / columns)).astype(np.int64).ravel()
    samples = PixelSamples(ys, xs, np.repeat(np.arange(rows * columns), per_patch))
    for array in (samples.ys, samples.xs, samples.patches):
        array.flags.writeable = False  # The arrays are shared through the cache.
    return samples


def unproject(
    depth_m: NDArray[np.float32],
    ys: NDArray[np.int64],
    xs: NDArray[np.int64],
    intrinsics: Intrinsics,
    T_world_camera: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Turn pixels with valid depth into points in the map frame.

    Args:
        depth_m: (H, W) float32 metres along the optical axis.
        ys: (n,) pixel rows.
        xs: (n,) pixel columns.
        intrinsics: Camera model of the depth image.
        T_world_camera: (4, 4) pose of the optical frame in the map frame.

    Returns:
        (n, 3) float64 metres.
    """
    z = depth_m[ys, xs].astype(np.float64)
    x = (xs - intrinsics.cx) * z / intrinsics.fx
    y = (ys - intrinsics.cy) * z / intrinsics.fy
    points_camera = np.stack([x, y, z], axis=1)
    return np.asarray(points_camera @ T_world_camera[:3, :3].T + T_world_camera[:3, 3])
