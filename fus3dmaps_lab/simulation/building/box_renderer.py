"""Rendering of colour, depth and parts of a world of boxes by ray casting; a view takes a few milliseconds."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import open3d as o3d
from numpy.typing import NDArray

from fus3dmaps_core.frame import Intrinsics
from fus3dmaps_lab.simulation.building.box_world import BoxWorld

_FACES = ((0, 4, 6, 2), (1, 3, 7, 5), (0, 1, 5, 4), (2, 6, 7, 3), (0, 2, 3, 1), (4, 5, 7, 6))  # -x, x, -y, y, -z, z
_LIGHT = np.array([0.78, 0.86, 0.70, 0.92, 0.55, 1.0], np.float32)
_TRIANGLES_A_BOX = 12


@dataclass(frozen=True)
class BoxView:
    """One noise-free view.

    Attributes:
        rgb: (H, W, 3) uint8.
        depth_m: (H, W) float32 metres along the optical axis; 0 where a ray leaves the world.
        parts: (H, W) int32, 0 where there is nothing.
        incidence_cos: (H, W) float32, cosine between the viewing ray and the surface normal; 0 where there is nothing.
    """

    rgb: NDArray[np.uint8]
    depth_m: NDArray[np.float32]
    parts: NDArray[np.int32]
    incidence_cos: NDArray[np.float32]


class BoxRenderer:
    """Renders views of one world; equal inputs give equal bits."""

    def __init__(self, world: BoxWorld) -> None:
        """Prepare ray casting."""
        self._world = world
        low, high = world.low_m, world.high_m
        # Corners are numbered by their bits xyz; x is the lowest.
        chosen = np.array([[(corner >> axis) & 1 for axis in range(3)] for corner in range(8)], bool)
        corners = np.where(chosen[None], high[:, None], low[:, None]).astype(np.float32)
        faces = np.array([[(a, b, c), (a, c, d)] for a, b, c, d in _FACES], np.uint32).reshape(1, _TRIANGLES_A_BOX, 3)
        triangles = faces + 8 * np.arange(len(low), dtype=np.uint32)[:, None, None]
        self._caster = o3d.t.geometry.RaycastingScene()
        self._caster.add_triangles(o3d.core.Tensor(corners.reshape(-1, 3)), o3d.core.Tensor(triangles.reshape(-1, 3)))

    def render(self, intrinsics: Intrinsics, T_world_camera: NDArray[np.float64]) -> BoxView:
        """Render a view.

        Args:
            intrinsics: Camera model.
            T_world_camera: (4, 4) pose of the optical frame.
        """
        shape = (intrinsics.height, intrinsics.width)
        directions = _directions(intrinsics)
        rays = np.empty((len(directions), 6), np.float32)
        rays[:, :3] = T_world_camera[:3, 3]
        rays[:, 3:] = directions @ T_world_camera[:3, :3].T.astype(np.float32)
        hits = self._caster.cast_rays(o3d.core.Tensor(rays))
        depth = hits["t_hit"].numpy()
        triangle = hits["primitive_ids"].numpy()
        found = np.isfinite(depth)
        box = np.where(found, triangle // _TRIANGLES_A_BOX, 0).astype(np.intp)
        face = np.where(found, (triangle % _TRIANGLES_A_BOX) // 2, 0).astype(np.intp)
        along = np.abs(np.take_along_axis(rays[:, 3:], (face // 2)[:, None], axis=1)[:, 0])
        incidence = along / np.linalg.norm(directions, axis=1)
        color = self._world.color[box] * _LIGHT[face][:, None] * (0.75 + 0.25 * incidence)[:, None]
        return BoxView(
            np.where(found[:, None], color, 0).astype(np.uint8).reshape(*shape, 3),
            np.where(found, depth, np.float32(0)).astype(np.float32).reshape(shape),
            np.where(found, self._world.part[box], 0).astype(np.int32).reshape(shape),
            np.where(found, incidence, 0).astype(np.float32).reshape(shape),
        )


@lru_cache(maxsize=4)
def _directions(intrinsics: Intrinsics) -> NDArray[np.float32]:
    """Return (H W, 3) rays through the pixel centres. Their z is 1, so the ray's parameter is depth."""
    xs = (np.arange(intrinsics.width) - intrinsics.cx) / intrinsics.fx
    ys = (np.arange(intrinsics.height) - intrinsics.cy) / intrinsics.fy
    x, y = np.meshgrid(xs, ys)
    return np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3).astype(np.float32)
