"""An endless furnished building: rooms on a square grid, numbered outwards from the first."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from benchmarks.boxes import Box

LABELS_PER_ROOM = 32
"""Labels of room i are 32 i .. 32 i + 31: six faces, then furniture."""

_ROOM_VOXELS = (80, 70, 50)  # 4.0 x 3.5 x 2.5 m
_WALL_VOXELS = 4
_FURNITURE = 10
_FURNITURE_DEPTH_VOXELS = 12  # Stands along the walls and leaves the middle of the room to the robot.


@dataclass(frozen=True)
class Room:
    """One room.

    Attributes:
        boxes: The room itself, seen from inside, and its furniture.
    """

    boxes: list[Box]

    def voxels(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """List the distinct voxels of all surfaces, (n, 3) int64 ordered by index, and the label of each, (n,) int64."""
        parts = [box.voxels() for box in self.boxes]
        voxels, first = np.unique(np.concatenate([part[0] for part in parts]), axis=0, return_index=True)
        return voxels, np.concatenate([part[1] for part in parts])[first]


@lru_cache(maxsize=4)
def _places(rooms: int) -> NDArray[np.int64]:
    side = int(np.ceil(np.sqrt(rooms))) | 1
    grid = np.indices((side, side)).reshape(2, -1).T - side // 2
    return grid[np.argsort(np.abs(grid).max(axis=1), kind="stable")]


def make_room(number: int, seed: int) -> Room:
    """Make room ``number`` of the building that the seed stands for; room 0 has a corner at the origin."""
    rng = np.random.default_rng([seed, number])
    column, row = _places((2 * int(np.ceil(np.sqrt(number + 1))) + 1) ** 2)[number]
    size = np.array(_ROOM_VOXELS)
    corner = np.array([column, row, 0]) * (size + _WALL_VOXELS)
    first_label = LABELS_PER_ROOM * number
    boxes = [_box(corner, corner + size, first_label, is_room=True)]
    for piece in range(_FURNITURE):
        extent = rng.integers((8, 6, 6), (20, _FURNITURE_DEPTH_VOXELS + 1, 24))
        place = rng.integers(1, size - extent)
        place[1] = 1 if piece % 2 else size[1] - 1 - extent[1]
        if piece == 0:
            place[:2] = size[0] - 1 - extent[0], (size[1] - extent[1]) // 2  # One stands before the wall ahead.
        place[2] = 1
        boxes.append(_box(corner + place, corner + place + extent, first_label + 6 + piece))
    return Room(boxes)


def _box(lower: NDArray[np.int64], upper: NDArray[np.int64], label: int, is_room: bool = False) -> Box:
    x0, y0, z0, x1, y1, z1 = (int(value) for value in (*lower, *upper))
    return Box((x0, y0, z0), (x1, y1, z1), label, is_room)
