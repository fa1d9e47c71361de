"""Light and soft shadows on the surfaces of a scene, computed once before rendering.

Every rectangle gets a coarse grid of brightness factors: direct light of the lamps, with shadow rays to points spread over
each lamp, plus ambient light that is dimmed where other surfaces are close (ambient occlusion).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import open3d as o3d
from numpy.typing import NDArray

from fus3dmaps_lab.simulation.room.scene import Panel

_TEXEL_M = 0.06
_OFFSET_M = 2e-3
_AMBIENT = 0.84
_OCCLUSION_M = 0.2
_AMBIENT_RAYS = 64
_LAMP_GRID = 4


def bake_light(panels: Sequence[Panel], caster: o3d.t.geometry.RaycastingScene) -> list[NDArray[np.float32]]:
    """Compute the brightness factors of every rectangle.

    Args:
        panels: All rectangles of the scene.
        caster: The same rectangles, ready for ray casting.

    Returns:
        One (rows, columns) float32 grid for each rectangle, its cells spread evenly over it in texture coordinates.
        At 1 a texture shows its own colours. Rectangles that are not lit have ones.
    """
    shapes = [_grid_shape(panel) if panel.material.lit else (1, 1) for panel in panels]
    lit = [index for index, panel in enumerate(panels) if panel.material.lit]
    grids = [np.ones(shape, np.float32) for shape in shapes]
    if not lit:
        return grids
    points, normals = [], []
    for index in lit:
        rows, columns = shapes[index]
        v, u = np.meshgrid((np.arange(rows) + 0.5) / rows, (np.arange(columns) + 0.5) / columns, indexing="ij")
        normal = panels[index].normal
        points.append(panels[index].point_m(u.ravel(), v.ravel()) + _OFFSET_M * normal)
        normals.append(np.broadcast_to(normal, points[-1].shape))
    point, normal = np.concatenate(points), np.concatenate(normals)
    light = _ambient(point, normal, caster)
    for panel in panels:
        if panel.material.emission > 0:
            light += _direct(point, normal, panel, caster)
    start = 0
    for index in lit:
        rows, columns = shapes[index]
        grids[index] = light[start : start + rows * columns].reshape(rows, columns).astype(np.float32)
        start += rows * columns
    return grids


def _grid_shape(panel: Panel) -> tuple[int, int]:
    width, height = panel.size_m
    return max(1, round(height / _TEXEL_M)), max(1, round(width / _TEXEL_M))


def _ambient(
    point: NDArray[np.float64], normal: NDArray[np.float64], caster: o3d.t.geometry.RaycastingScene
) -> NDArray[np.float64]:
    """Compute the ambient light times the cosine-weighted share of the surroundings that is not close by."""
    helper = np.where(np.abs(normal[:, 2:]) > 0.9, [[1.0, 0.0, 0.0]], [[0.0, 0.0, 1.0]])
    tangent = np.cross(helper, normal)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    bitangent = np.cross(normal, tangent)
    openness = np.zeros(len(point))
    for k in range(_AMBIENT_RAYS):  # A sunflower disc projected onto the hemisphere is cosine weighted.
        radius, angle = np.sqrt((k + 0.5) / _AMBIENT_RAYS), k * np.pi * (3 - np.sqrt(5))
        x, y, z = radius * np.cos(angle), radius * np.sin(angle), np.sqrt(1 - radius**2)
        rays = np.hstack([point, x * tangent + y * bitangent + z * normal]).astype(np.float32)
        distance = caster.cast_rays(o3d.core.Tensor(rays))["t_hit"].numpy()
        openness += 1.0 - np.exp(-distance / _OCCLUSION_M)
    return _AMBIENT * openness / _AMBIENT_RAYS


def _direct(
    point: NDArray[np.float64], normal: NDArray[np.float64], lamp: Panel, caster: o3d.t.geometry.RaycastingScene
) -> NDArray[np.float64]:
    """Compute the light that reaches the points directly from one lamp."""
    width, height = lamp.size_m
    share = lamp.material.emission * width * height / _LAMP_GRID**2 / np.pi
    total = np.zeros(len(point))
    for row in range(_LAMP_GRID):
        for column in range(_LAMP_GRID):
            source = lamp.point_m((column + 0.5) / _LAMP_GRID, (row + 0.5) / _LAMP_GRID) + _OFFSET_M * lamp.normal
            towards = source - point
            distance = np.linalg.norm(towards, axis=1)
            towards /= distance[:, None]
            gain = np.clip(np.sum(towards * normal, axis=1), 0, None) * np.clip(-towards @ lamp.normal, 0, None)
            rays = np.hstack([point, towards]).astype(np.float32)
            hit = caster.cast_rays(o3d.core.Tensor(rays))["t_hit"].numpy()
            total += share * gain / distance**2 * (hit > distance - 0.01)
    return total
