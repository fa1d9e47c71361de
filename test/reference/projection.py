"""From pixels to points: patches of pixels, and pixels with depth to the world."""

from __future__ import annotations

import numpy as np


def patch_of_pixel(u: int, v: int, width: int, height: int, columns: int, rows: int) -> int:
    """Patch (row-major) of a regular grid over the image in which the centre of pixel (u, v) lies."""
    column = int((u + 0.5) * columns / width)
    row = int((v + 0.5) * rows / height)
    return row * columns + column


def unproject_pixel(u: float, v: float, depth_m: float, K: np.ndarray, T_world_camera: np.ndarray) -> np.ndarray:
    """World point of a pixel: along the ray K^-1 [u, v, 1] to the given depth, then through the pose."""
    x, y, _ = np.linalg.solve(K.astype(np.float64), np.array([u, v, 1.0]))
    camera = np.array([x * depth_m, y * depth_m, depth_m, 1.0])
    return (T_world_camera.astype(np.float64) @ camera)[:3]


def project_point(point_m: np.ndarray, K: np.ndarray, T_world_camera: np.ndarray) -> tuple[float, float, float]:
    """Pixel coordinates and depth of a world point."""
    camera = np.linalg.inv(T_world_camera) @ np.append(point_m, 1.0)
    u, v, w = K @ camera[:3]
    return u / w, v / w, float(camera[2])


def valid_depth(depth_m: float, minimum_m: float, maximum_m: float) -> bool:
    """Whether a depth reading gives a point."""
    return bool(np.isfinite(depth_m)) and depth_m > 0 and minimum_m <= depth_m <= maximum_m
