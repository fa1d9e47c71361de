"""Motion gates: which frames are keyframes."""

from __future__ import annotations

import math

import numpy as np


def moved_m(T_a: np.ndarray, T_b: np.ndarray) -> float:
    """Distance between two camera positions."""
    return math.dist(T_a[:3, 3], T_b[:3, 3])


def turned_rad(T_a: np.ndarray, T_b: np.ndarray) -> float:
    """Angle of the rotation from one camera to the other, from its skew part and trace (good at 0 and at pi)."""
    R = T_a[:3, :3].T @ T_b[:3, :3]
    sine = 0.5 * math.hypot(R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1])
    cosine = 0.5 * (R[0, 0] + R[1, 1] + R[2, 2] - 1.0)
    return math.atan2(sine, cosine)


def keyframes(poses: list[np.ndarray], translation_m: float, rotation_rad: float) -> list[bool]:
    """For each pose of a walk, whether its frame is a keyframe."""
    wanted: list[bool] = []
    last: np.ndarray | None = None
    for T in poses:
        is_keyframe = last is None or moved_m(last, T) >= translation_m or turned_rad(last, T) >= rotation_rad
        wanted.append(is_keyframe)
        if is_keyframe:
            last = T
    return wanted
