"""Keyframe gates: a frame is worth processing once the camera has moved or turned enough [sec: Implementation Details]."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def rotation_angle_rad(R: NDArray[np.float64]) -> float:
    """Compute the angle of a 3x3 rotation matrix, radians in [0, pi]."""
    # atan2 of both parts keeps small angles exact, where arccos of the trace alone loses half its digits.
    sine = np.linalg.norm([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]) / 2.0
    return float(np.arctan2(sine, (np.trace(R) - 1.0) / 2.0))


class KeyframeGate:
    """A gate that a pose passes if it moved or turned enough since the last accepted one; the first always passes."""

    def __init__(self, translation_m: float, rotation_rad: float) -> None:
        """Set both thresholds; reaching either of them suffices."""
        self._translation_m = translation_m
        self._rotation_rad = rotation_rad
        self._last: NDArray[np.float64] | None = None

    def wants(self, T_world_camera: NDArray[np.float64]) -> bool:
        """Tell whether the pose would be a keyframe; change nothing."""
        if self._last is None:
            return True
        moved_m = float(np.linalg.norm(T_world_camera[:3, 3] - self._last[:3, 3]))
        turned_rad = rotation_angle_rad(self._last[:3, :3].T @ T_world_camera[:3, :3])
        return moved_m >= self._translation_m or turned_rad >= self._rotation_rad

    def accept(self, T_world_camera: NDArray[np.float64]) -> None:
        """Make the pose the one that later poses are measured against."""
        self._last = T_world_camera.copy()

    def reset(self) -> None:
        """Forget the last keyframe."""
        self._last = None
