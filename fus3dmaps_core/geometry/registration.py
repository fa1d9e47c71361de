"""Depth of one camera as another one would have measured it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fus3dmaps_core.errors import FrameError
from fus3dmaps_core.frame import Intrinsics, check_pose

_MARGIN_PX = 0.1  # Neighbours on a slanted surface move apart by a little more than they cover; else thin cracks show.
_MAX_APPROACH = 4.0  # A surface this much nearer to the colour camera spreads no wider: bounds the work of hostile input.


def register_depth(
    depth_m: NDArray[np.float32], depth_intrinsics: Intrinsics, rgb_intrinsics: Intrinsics, T_rgb_depth: NDArray[np.float64]
) -> NDArray[np.float32]:
    """Move a depth image into the pixel grid of the colour camera.

    Each reading is a patch that faces the depth camera and fills its pixel. It is drawn over all colour pixels whose centres
    the patch covers, at least over the nearest one; of several readings the nearest to the camera stays. Readings that are
    not finite and positive, and those behind the colour camera, are left out. The result does not depend on any order.

    Args:
        depth_m: (h, w) float32 metres along the axis of the depth camera.
        depth_intrinsics: Camera model of the depth image, without distortion.
        rgb_intrinsics: Camera model of the colour image, W x H pixels, without distortion.
        T_rgb_depth: (4, 4) rigid transform of points from the depth camera's to the colour camera's optical frame.

    Returns:
        (H, W) float32 metres along the axis of the colour camera, 0 where no reading falls.

    Raises:
        FrameError: Reasons ``size_mismatch`` (the depth image is not of its camera model's size) or ``bad_pose``.
    """
    if depth_m.shape != (depth_intrinsics.height, depth_intrinsics.width):
        raise FrameError(
            f"depth image is {depth_m.shape[1]}x{depth_m.shape[0]}, its camera model "
            f"{depth_intrinsics.width}x{depth_intrinsics.height}",
            reason="size_mismatch",
        )
    check_pose(T_rgb_depth)
    rows, columns = np.nonzero(np.isfinite(depth_m) & (depth_m > 0))
    z_depth = depth_m[rows, columns].astype(np.float64)
    rays = ((columns - depth_intrinsics.cx) / depth_intrinsics.fx, (rows - depth_intrinsics.cy) / depth_intrinsics.fy)
    R, t = T_rgb_depth[:3, :3], T_rgb_depth[:3, 3]
    x, y, z = (z_depth * (R[i, 0] * rays[0] + R[i, 1] * rays[1] + R[i, 2]) + t[i] for i in range(3))
    with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
        z_rgb = z.astype(np.float32)
        seen = np.isfinite(z_rgb) & (z_rgb > 0)
        slopes = np.stack([x, y])[:, seen] / z[seen]
    z_rgb = z_rgb[seen]
    approach = np.minimum(z_depth[seen] / z[seen], _MAX_APPROACH)

    pixel_size = (1 / depth_intrinsics.fx, 1 / depth_intrinsics.fy)
    columns_from_to = _covered(
        slopes[0], approach, R, 0, pixel_size, rgb_intrinsics.fx, rgb_intrinsics.cx, rgb_intrinsics.width
    )
    rows_from_to = _covered(
        slopes[1], approach, R, 1, pixel_size, rgb_intrinsics.fy, rgb_intrinsics.cy, rgb_intrinsics.height
    )
    return _nearest(z_rgb, columns_from_to, rows_from_to, rgb_intrinsics.width, rgb_intrinsics.height)


def _covered(
    slopes: NDArray[np.float64],
    approach: NDArray[np.float64],
    R: NDArray[np.float64],
    axis: int,
    pixel_size: tuple[float, float],
    focal: float,
    center: float,
    size: int,
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Find the first pixel that each patch covers along an axis of the colour image, and the one after the last.

    Args:
        slopes: Coordinate of the patch's centre along the axis over its depth, in the colour camera.
        approach: Its depth in the depth camera over that in the colour camera.
        R: (3, 3) rotation from the depth to the colour camera.
        axis: 0 along rows, 1 along columns.
        pixel_size: Size of the depth camera's pixels at depth 1, along both axes.
        focal: Focal length of the colour camera along the axis, pixels.
        center: Its principal point, pixels.
        size: Its image, pixels.
    """
    # Derivative of the projection: the patch turns with R, and what comes nearer grows. In view, a slope is bounded.
    in_view = np.clip(slopes, (-1 - center) / focal, (size - center) / focal)
    spread = sum(np.abs(R[axis, k] - in_view * R[2, k]) * pixel_size[k] for k in range(2))
    reach = np.maximum(0.5 * focal * approach * spread, 0.5) + _MARGIN_PX / 2
    middle = np.clip(focal * slopes + center, -1e9, 1e9)
    first = np.maximum(np.ceil(middle - reach), 0).astype(np.int64)
    return first, np.minimum(np.ceil(middle + reach), size).astype(np.int64)


def _nearest(
    z_m: NDArray[np.float32],
    columns: tuple[NDArray[np.int64], NDArray[np.int64]],
    rows: tuple[NDArray[np.int64], NDArray[np.int64]],
    width: int,
    height: int,
) -> NDArray[np.float32]:
    """Keep the least of the depths drawn over each pixel: (height, width), 0 where there is none."""
    buffer = np.full(width * height, np.inf, np.float32)
    columns_each, rows_each = columns[1] - columns[0], rows[1] - rows[0]
    inside = np.flatnonzero((columns_each > 0) & (rows_each > 0))
    starts = rows[0][inside] * width + columns[0][inside]
    columns_each, rows_each, z_m = columns_each[inside], rows_each[inside], z_m[inside]
    # Patches of one shape at a time: there are few shapes, and one shape's pixels are one array of offsets.
    shapes = columns_each * (height + 1) + rows_each
    order = np.argsort(shapes, kind="stable")
    for group in np.split(order, np.flatnonzero(np.diff(shapes[order])) + 1):
        if len(group):
            across, down = np.arange(columns_each[group[0]]), np.arange(rows_each[group[0]])
            offsets = (down[:, None] * width + across).ravel()
            places = starts[group, None] + offsets
            np.minimum.at(buffer, places.ravel(), np.repeat(z_m[group], len(offsets)))
    buffer[np.isinf(buffer)] = 0
    return buffer.reshape(height, width)
