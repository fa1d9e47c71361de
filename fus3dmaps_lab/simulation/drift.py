"""Simulation of odometry: the estimated pose drifts away from the true one as the robot moves and turns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Drift:
    """A random walk of the pose.

    Attributes:
        position_sigma_m: Standard deviation along each axis of the world after one metre; it grows with the square root of
            the distance.
        yaw_sigma_rad: Standard deviation of the heading, which grows with the square root of metres plus radians turned.
        seed: Seed of the random walk.
    """

    position_sigma_m: float = 0.005
    yaw_sigma_rad: float = 0.002
    seed: int = 0

    def believed(self, poses: NDArray[np.float64]) -> NDArray[np.float64]:
        """Add drift to true poses; the first pose stays as it is.

        Args:
            poses: (n, 4, 4) true poses T_world_camera in order of time.

        Returns:
            (n, 4, 4) poses that the robot believes.
        """
        rng = np.random.default_rng((self.seed, 0xD81F7))
        believed = poses.copy()
        for place in range(1, len(poses)):
            step = np.linalg.inv(poses[place - 1]) @ poses[place]
            way_m = float(np.linalg.norm(step[:3, 3]))
            turn_rad = float(np.arccos(np.clip((np.trace(step[:3, :3]) - 1) / 2, -1, 1)))
            shift = rng.normal(0.0, self.position_sigma_m, 3) * np.sqrt(way_m)
            yaw = rng.normal(0.0, self.yaw_sigma_rad) * np.sqrt(way_m + turn_rad)
            moved = believed[place - 1] @ step
            cosine, sine = np.cos(yaw), np.sin(yaw)
            turned = np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]]) @ moved[:3, :3]
            moved[:3, :3] = turned
            moved[:3, 3] += shift
            believed[place] = moved
        return believed
