"""A slanted wall seen by a camera that moves, for miniature folders of datasets; shares no code with the package."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

NORMAL = np.array([0.2, -0.1, 1.0]) / np.linalg.norm([0.2, -0.1, 1.0])
DISTANCE_M = 2.5  # The wall is NORMAL . p = DISTANCE_M in the world of the poses.


def pose(i: int) -> np.ndarray:
    """Pose of the optical frame of frame i in the world: it turns about all axes and moves along them."""
    a, b, c = 0.15 * i + 0.05, -0.1 * i, 0.08 * i + 0.1
    x = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
    y = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
    z = np.array([[np.cos(c), -np.sin(c), 0], [np.sin(c), np.cos(c), 0], [0, 0, 1]])
    T = np.eye(4)
    T[:3, :3] = z @ y @ x
    T[:3, 3] = [0.3 * i, -0.2 * i, 0.1 * i]
    return T


def rays(fx: float, fy: float, cx: float, cy: float, width: int, height: int) -> np.ndarray:
    """(H, W, 3) directions of the pixels in the optical frame, z = 1."""
    v, u = np.mgrid[:height, :width]
    return np.stack([(u - cx) / fx, (v - cy) / fy, np.ones((height, width))], axis=-1)


def wall_depth_m(i: int, *camera) -> np.ndarray:
    """(H, W) metres along the optical axis from frame i to the wall."""
    T = pose(i)
    return (DISTANCE_M - NORMAL @ T[:3, 3]) / (rays(*camera) @ T[:3, :3].T @ NORMAL)


def colors(i: int, width: int, height: int) -> np.ndarray:
    """(H, W, 3) smooth colours, red first, that differ from frame to frame; left of the middle is redder."""
    rgb = np.full((height, width, 3), [40 + 10 * i, 90, 200], np.uint8)
    rgb[:, : width // 2, 0] = 220
    return rgb


def write_color(path: Path, rgb: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), rgb[:, :, ::-1])


def write_gray(path: Path, image: np.ndarray, dtype: type) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image.astype(dtype))


def text_of(T: np.ndarray) -> str:
    """The matrix in one line, row by row."""
    return " ".join(f"{value:.18e}" for value in T.ravel())


def quaternion_of(R: np.ndarray) -> np.ndarray:
    """x, y, z, w by the eigenvector of the rotation and its trace."""
    w = np.sqrt(max(1 + np.trace(R), 0)) / 2
    return np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1], 4 * w * w]) / (4 * w)


def assert_on_wall(frame, i: int, tolerance_m: float) -> None:
    """The frame's pose is that of frame i, and every reading of it lies on the wall by its own intrinsics and pose."""
    np.testing.assert_allclose(frame.T_world_camera, pose(i), atol=2e-6)
    k = frame.intrinsics
    sx, sy = frame.depth_m.shape[1] / k.width, frame.depth_m.shape[0] / k.height
    height, width = frame.depth_m.shape
    directions = rays(k.fx * sx, k.fy * sy, (k.cx + 0.5) * sx - 0.5, (k.cy + 0.5) * sy - 0.5, width, height)
    known = frame.depth_m > 0
    assert known.mean() > 0.5
    points = (directions * frame.depth_m[:, :, None])[known] @ frame.T_world_camera[:3, :3].T + frame.T_world_camera[:3, 3]
    assert np.abs(points @ NORMAL - DISTANCE_M).max() < tolerance_m


def cut(path: Path) -> None:
    """Leave out the second half of a file."""
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
