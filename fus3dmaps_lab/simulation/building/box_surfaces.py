"""Sampling of the surfaces that can be seen from inside a world of boxes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fus3dmaps_lab.simulation.building.box_world import BoxWorld
from fus3dmaps_lab.simulation.truth import SurfacePoints

_OUTWARD_M = 0.008
"""Free space needed in front of a surface point."""


def surface_points(world: BoxWorld, insides_m: NDArray[np.float64], spacing_m: float) -> SurfacePoints:
    """Sample every face of every box on a grid; leave out points that touch another box or lie outside the building.

    Args:
        world: The boxes.
        insides_m: (n, 2, 3) lower and upper corners of the spaces inside the building.
        spacing_m: Spacing of the grid, metres.
    """
    points, parts = [], []
    low, high = world.low_m, world.high_m
    for axis in range(3):
        others = [other for other in range(3) if other != axis]
        for sign in (-1, 1):
            face_low, face_high = low.copy(), high.copy()
            at = (high if sign > 0 else low)[:, axis]
            face_low[:, axis] = face_high[:, axis] = at + sign * _OUTWARD_M
            for box in range(len(low)):
                grid = _grid(face_low[box, others], face_high[box, others], spacing_m)
                front = np.empty((len(grid), 3))
                front[:, others] = grid
                front[:, axis] = face_low[box, axis]
                near = np.flatnonzero(np.all(low < face_high[box], axis=1) & np.all(face_low[box] < high, axis=1))
                rooms = insides_m[
                    np.all(insides_m[:, 0] < face_high[box], axis=1) & np.all(face_low[box] < insides_m[:, 1], axis=1)
                ]
                free = _within(front, rooms[:, 0], rooms[:, 1]) & ~_within(front, low[near], high[near])
                if free.any():
                    front[:, axis] = at[box]
                    points.append(front[free])
                    parts.append(np.full(int(free.sum()), world.part[box], np.int32))
    if not points:
        return SurfacePoints(np.empty((0, 3)), np.empty(0, np.int32))
    return SurfacePoints(np.concatenate(points), np.concatenate(parts))


def _grid(low: NDArray[np.float64], high: NDArray[np.float64], spacing_m: float) -> NDArray[np.float64]:
    """Divide a rectangle into cells of about the given spacing and return their centres, (n, 2)."""
    counts = np.maximum(1, np.ceil((high - low) / spacing_m - 1e-6).astype(int))
    axes = [
        first + (np.arange(count) + 0.5) * (last - first) / count
        for first, last, count in zip(low, high, counts, strict=True)
    ]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)


def _within(points: NDArray[np.float64], low: NDArray[np.float64], high: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which points lie inside at least one box."""
    found = np.zeros(len(points), bool)
    for first, last in zip(low, high, strict=True):
        found |= np.all((points > first) & (points < last), axis=1)
    return found
