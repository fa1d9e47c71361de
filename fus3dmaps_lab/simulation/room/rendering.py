"""Rendering of colour, depth and labels of a scene by ray casting."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
import open3d as o3d
from numpy.typing import NDArray

from fus3dmaps_core.frame import Intrinsics
from fus3dmaps_lab.simulation.room.lighting import bake_light
from fus3dmaps_lab.simulation.room.scene import Scene
from fus3dmaps_lab.simulation.room.texture_atlas import MipAtlas, pack

_SUBPIXELS = np.array([(-0.375, -0.125), (0.125, -0.375), (0.375, 0.125), (-0.125, 0.375)], np.float32)

_BELOW_ONE = np.float32(1 - 2**-23)  # At 1 a repeating texture would begin again.


@dataclass(frozen=True)
class Rendering:
    """One noise-free view.

    Attributes:
        rgb: (H, W, 3) uint8.
        depth_m: (H, W) float32 metres along the optical axis; 0 where a ray leaves the scene.
        labels: (H, W) int32, 0 for the building and for nothing, else 1 + index of the object.
        incidence_cos: (H, W) float32, cosine between the viewing ray and the surface normal; 0 where there is nothing.
    """

    rgb: NDArray[np.uint8]
    depth_m: NDArray[np.float32]
    labels: NDArray[np.int32]
    incidence_cos: NDArray[np.float32]


class SceneRenderer:
    """Renders views of one scene; equal inputs give equal bits.

    Textures are sampled at the size of the pixel's footprint, and pixels on the edge of a surface average four rays.
    """

    def __init__(self, scene: Scene) -> None:
        """Prepare ray casting, textures and light; this takes a second for a furnished room."""
        panels = scene.panels
        corners = np.stack([panel.point_m([0, 1, 0, 1], [0, 0, 1, 1]) for panel in panels])
        # Barycentric coordinates of the first triangle are (u, v), of the second (1 - u, 1 - v).
        triangles = np.arange(len(panels), dtype=np.uint32)[:, None, None] * 4 + np.array([[0, 1, 2], [3, 2, 1]], np.uint32)
        self._caster = o3d.t.geometry.RaycastingScene()
        self._caster.add_triangles(
            o3d.core.Tensor(corners.reshape(-1, 3).astype(np.float32)), o3d.core.Tensor(triangles.reshape(-1, 3))
        )
        materials = list({id(panel.material): panel.material for panel in panels}.values())
        row = {id(material): index for index, material in enumerate(materials)}
        self._textures = MipAtlas([m.texture for m in materials], [m.tile_m is not None for m in materials])
        self._light = pack(bake_light(panels, self._caster), [False] * len(panels))
        self._texture = np.array([row[id(panel.material)] for panel in panels], np.int32)
        self._labels = np.array([panel.label for panel in panels], np.int32)
        self._normals = np.stack([panel.normal for panel in panels], axis=1)
        sizes = np.array([panel.size_m for panel in panels])
        tiles = np.array([panel.material.tile_m or np.nan for panel in panels])[:, None]
        repeats = np.where(np.isnan(tiles), 1.0, sizes / tiles)
        self._repeats = np.ascontiguousarray(repeats.T, dtype=np.float32)
        texels = np.array([panel.material.texture.shape[1::-1] for panel in panels]) * repeats
        self._half_log_density = (0.5 * np.log2(np.prod(texels / sizes, axis=1))).astype(np.float32)

    def render(self, intrinsics: Intrinsics, T_world_camera: NDArray[np.float64]) -> Rendering:
        """Render a view.

        Args:
            intrinsics: Camera model.
            T_world_camera: (4, 4) pose of the optical frame.
        """
        shape = (intrinsics.height, intrinsics.width)
        directions = _directions(intrinsics)
        color, depth, panel, slope = self._trace(directions, intrinsics, T_world_camera)
        edge = _edges(panel.reshape(shape)).reshape(-1)
        pixels = np.flatnonzero(edge)
        if len(pixels):
            jitter = _SUBPIXELS / np.array([intrinsics.fx, intrinsics.fy], np.float32)
            fan = np.repeat(directions[pixels], len(jitter), axis=0)
            fan[:, :2] += np.tile(jitter, (len(pixels), 1))
            samples = self._trace(fan, intrinsics, T_world_camera)[0].reshape(len(pixels), len(jitter), 3)
            color[pixels] = np.einsum("ijk->ik", samples) / np.float32(len(jitter))
        labels = np.where(panel >= 0, self._labels[panel], 0).astype(np.int32)
        return Rendering(
            cv2.convertScaleAbs(color).reshape(*shape, 3),
            depth.reshape(shape),
            labels.reshape(shape),
            (slope / np.linalg.norm(directions, axis=1)).astype(np.float32).reshape(shape),
        )

    def _trace(
        self, directions: NDArray[np.float32], intrinsics: Intrinsics, T_world_camera: NDArray[np.float64]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.int64], NDArray[np.float32]]:
        """Cast rays (x, y, 1) of the optical frame; return colour, depth, rectangle (-1: none) and |normal . direction|."""
        R = T_world_camera[:3, :3]
        rays = np.empty((len(directions), 6), np.float32)
        rays[:, :3] = T_world_camera[:3, 3]
        rays[:, 3:] = cv2.transform(directions[None], R)[0]
        hits = self._caster.cast_rays(o3d.core.Tensor(rays))
        depth = hits["t_hit"].numpy()
        triangle = hits["primitive_ids"].numpy()
        found = np.isfinite(depth)
        panel = np.where(found, triangle >> 1, 0).astype(np.intp)
        depth = np.where(found, depth, np.float32(0))
        u, v = hits["primitive_uvs"].numpy().T.copy()
        second = (triangle & 1).astype(bool)
        for coordinate in (u, v):
            np.subtract(1, coordinate, out=coordinate, where=second)
            np.clip(coordinate, 0, _BELOW_ONE, out=coordinate)
        normal = (R.T @ self._normals).astype(np.float32)
        slope = np.abs(
            normal[0][panel] * directions[:, 0] + normal[1][panel] * directions[:, 1] + normal[2][panel] * directions[:, 2]
        )
        # A pixel covers depth^2 / (fx fy |n.d|) square metres of the surface.
        focal = np.float32(intrinsics.fx * intrinsics.fy)
        level = np.log2(np.maximum(depth, 1e-6) / np.sqrt(np.maximum(slope, 1e-3) * focal)) + self._half_log_density[panel]
        color = self._textures.sample(
            self._texture[panel], _fraction(u * self._repeats[0][panel]), _fraction(v * self._repeats[1][panel]), level
        )
        color *= self._light.sample(panel, u, v)[:, None]
        color[~found] = 0
        return color, depth, np.where(found, panel, -1), np.where(found, slope, np.float32(0))


def _fraction(value: NDArray[np.float32]) -> NDArray[np.float32]:
    return value - np.floor(value)


def _edges(panel: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Find the pixels with another rectangle among their four neighbours."""
    index = panel.astype(np.float32)
    cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    edges: NDArray[np.bool_] = cv2.dilate(index, cross) != cv2.erode(index, cross)
    return edges


@lru_cache(maxsize=4)
def _directions(intrinsics: Intrinsics) -> NDArray[np.float32]:
    """Return the (H * W, 3) rays (x, y, 1) through the pixel centres, row by row."""
    y, x = np.mgrid[: intrinsics.height, : intrinsics.width]
    directions = np.stack(
        [(x - intrinsics.cx) / intrinsics.fx, (y - intrinsics.cy) / intrinsics.fy, np.ones_like(x)], axis=-1
    )
    directions = directions.reshape(-1, 3).astype(np.float32)
    directions.setflags(write=False)
    return directions
