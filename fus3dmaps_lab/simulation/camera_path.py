"""Smooth camera paths past things to look at, at the even pace of a robot."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicSpline

UP = np.array([0.0, 0.0, 1.0])
_RESOLUTION = 2000


@dataclass(frozen=True)
class Viewpoint:
    """A point of the path with the camera's viewing direction there.

    Attributes:
        position_m: Position of the camera.
        target_m: Point that it looks at.
    """

    position_m: tuple[float, float, float]
    target_m: tuple[float, float, float]


def look_at(position_m: ArrayLike, target_m: ArrayLike) -> NDArray[np.float64]:
    """Return the (4, 4) pose of an upright optical frame (x right, y down, z forward) that looks at a target.

    Raises:
        ValueError: The points coincide or lie above one another.
    """
    position = np.asarray(position_m, np.float64)
    forward = np.asarray(target_m, np.float64) - position
    right = np.cross(forward, UP)
    if np.linalg.norm(right) < 1e-9:
        raise ValueError(f"no upright view from {position_m!r} towards {target_m!r}")
    forward /= np.linalg.norm(forward)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    pose[:3, 3] = position
    return pose


class CameraPath:
    """A closed path through viewpoints, on which the camera moves and turns at an even speed.

    Positions and viewing directions follow periodic cubic splines (C2), which pass exactly through the viewpoints.
    """

    def __init__(self, viewpoints: Sequence[Viewpoint], metres_per_radian: float = 1.0) -> None:
        """Lay the path.

        Args:
            viewpoints: At least three, in order; the path returns to the first.
            metres_per_radian: Metres of travel that take as long as one radian of turning.

        Raises:
            ValueError: There are fewer than three viewpoints.
        """
        if len(viewpoints) < 3:
            raise ValueError(f"a closed path needs three viewpoints, got {len(viewpoints)}")
        loop = [*viewpoints, viewpoints[0]]
        positions = np.array([view.position_m for view in loop], np.float64)
        gaze = np.array([view.target_m for view in loop], np.float64) - positions
        gaze /= np.linalg.norm(gaze, axis=1, keepdims=True)
        pace = np.linalg.norm(np.diff(positions, axis=0), axis=1) + metres_per_radian * _angle(gaze[:-1], gaze[1:])
        knots = np.concatenate([[0.0], np.cumsum(np.maximum(pace, 1e-6))])
        self._position = CubicSpline(knots, positions, bc_type="periodic")
        self._gaze = CubicSpline(knots, gaze, bc_type="periodic")
        parameter = np.linspace(0.0, knots[-1], _RESOLUTION + 1)
        gazes = self._gaze(parameter)
        gazes /= np.linalg.norm(gazes, axis=1, keepdims=True)
        step = np.hypot(
            np.linalg.norm(np.diff(self._position(parameter), axis=0), axis=1),
            metres_per_radian * _angle(gazes[:-1], gazes[1:]),
        )
        self._parameter = parameter
        self._progress = np.concatenate([[0.0], np.cumsum(step)]) / step.sum()

    def pose(self, progress: float) -> NDArray[np.float64]:
        """Return the (4, 4) pose of the optical frame after a share of the path; 0 and 1 are the same place."""
        at = np.interp(progress, self._progress, self._parameter)
        position = self._position(at)
        return look_at(position, position + self._gaze(at))


def _angle(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    angle: NDArray[np.float64] = np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), np.sum(a * b, axis=1))
    return angle
