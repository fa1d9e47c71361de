"""Axis-aligned boxes whose faces run through known voxels: their voxels, points on them, and rays against them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

VOXEL_SIZE_M = 0.05
"""Edge of a voxel, metres."""

_FACE_OFFSET = 0.5  # Faces run through the middle of voxels: neither rounding nor noise pushes a point into the next one.


@dataclass(frozen=True)
class Box:
    """A box between two voxels, both included.

    Attributes:
        lower: (3,) index of the lowest voxel that its faces touch.
        upper: (3,) index of the highest one.
        label: Number of the box's first face; the six faces (x-, x+, y-, y+, z-, z+) are label .. label + 5 where
            ``is_room``, a piece of furniture has one label for all.
        is_room: Whether the box is seen from inside.
    """

    lower: tuple[int, int, int]
    upper: tuple[int, int, int]
    label: int
    is_room: bool = False

    @property
    def bounds_m(self) -> NDArray[np.float64]:
        """(2, 3) lowest and highest corner of the faces, metres."""
        return surface_points(np.array([self.lower, self.upper]))

    def voxels(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Voxels that the faces run through.

        Returns:
            (n, 3) int64 distinct indices and (n,) int64 labels; an edge belongs to the first of its faces.
        """
        shape = np.array(self.upper) - self.lower + 1
        grid = np.indices(tuple(shape)).reshape(3, -1).T
        on_face = np.stack([side for axis in range(3) for side in (grid[:, axis] == 0, grid[:, axis] == shape[axis] - 1)], 1)
        kept = on_face.any(axis=1)
        labels = self.label + (on_face[kept].argmax(axis=1) if self.is_room else np.zeros(int(kept.sum()), np.int64))
        return grid[kept] + np.array(self.lower), labels


def surface_points(voxels: NDArray[np.int64]) -> NDArray[np.float64]:
    """Pick a point on the surface in each of a box's voxels: (n, 3) metres."""
    return np.asarray((voxels + _FACE_OFFSET) * VOXEL_SIZE_M, np.float64)


def voxels_of(points_m: NDArray[np.float64]) -> NDArray[np.int64]:
    """Compute the voxel of each point (n, 3): floor(p / size) per axis."""
    return np.floor(points_m / VOXEL_SIZE_M).astype(np.int64)


def cast_rays(
    boxes: list[Box], origin_m: NDArray[np.float64], directions: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Find the first hit of each ray.

    Args:
        boxes: What can be hit; the origin lies inside every room among them and outside all else.
        origin_m: (3,) metres.
        directions: (n, 3) of any length but 0.

    Returns:
        (n,) distance in lengths of the direction, infinite without a hit, and (n,) label of the face, -1 without one.
    """
    nearest = np.full(len(directions), np.inf)
    labels = np.full(len(directions), -1, np.int64)
    with np.errstate(divide="ignore"):
        inverse = 1.0 / directions
    for box in boxes:
        low, high = box.bounds_m
        with np.errstate(invalid="ignore"):
            to_low, to_high = (low - origin_m) * inverse, (high - origin_m) * inverse
        near, far = np.fmin(to_low, to_high), np.fmax(to_low, to_high)
        entry, exit_ = near.max(axis=1), far.min(axis=1)
        if box.is_room:
            axis = far.argmin(axis=1)
            distance = exit_
            face = 2 * axis + (directions[np.arange(len(directions)), axis] > 0)
            hit = (exit_ > 0) & (exit_ < nearest)
        else:
            distance = entry
            face = np.zeros(len(directions), np.int64)
            hit = (entry > 0) & (entry <= exit_) & (entry < nearest)
        nearest[hit] = distance[hit]
        labels[hit] = box.label + face[hit]
    return nearest, labels
