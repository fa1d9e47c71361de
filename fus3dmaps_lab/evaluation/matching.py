"""Matching of the truth's voxels with the nearest voxels of a map, at any distance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from fus3dmaps_core.errors import MapError
from fus3dmaps_core.voxel_map.kernels.keys import pack

_BLOCK_ROWS = 2**14
_SPARE = 8  # Neighbours asked for beyond k, so that most ties at the last place are seen in one query.


@dataclass(frozen=True)
class Neighbours:
    """The nearest voxels of a map, nearest first; ties go to lower x, then y, then z.

    Attributes:
        places: (n, k) int64 places among the map's voxels; fewer columns if the map has fewer than k.
        distances: (n, k) float64 distances between centres, in voxels.
    """

    places: NDArray[np.int64]
    distances: NDArray[np.float64]


def nearest_voxels(
    positions: NDArray[np.number], predicted_keys: NDArray[np.integer], k: int, workers: int = -1
) -> Neighbours:
    """Find the k nearest voxels of a map for each position. The result does not depend on the order of voxels.

    Args:
        positions: (n, 3) on the map's grid, in voxels; whole or half numbers (:attr:`VoxelTruth.positions`).
        predicted_keys: (m, 3) voxel indices of the map, all different.
        k: Number of neighbours.
        workers: Number of threads; -1 takes all processors.

    Raises:
        MapError: A position is neither a whole nor a half number, or k is less than 1.
    """
    if k < 1:
        raise MapError(f"k: must be at least 1, got {k}")
    doubled = np.rint(2 * np.asarray(positions, np.float64))
    if not np.array_equal(doubled, 2 * np.asarray(positions, np.float64)):
        raise MapError("positions: must be whole or half numbers of voxels")
    count = min(k, len(predicted_keys))
    places = np.empty((len(doubled), count), np.int64)
    squares = np.empty((len(doubled), count), np.int64)
    if count and len(doubled):
        order = np.argsort(pack(torch.from_numpy(np.ascontiguousarray(predicted_keys, np.int64))).numpy())
        # Not balanced, because positions far outside the map are then looked up twice as fast.
        tree = cKDTree(2.0 * predicted_keys[order], balanced_tree=False)
        for first in range(0, len(doubled), _BLOCK_ROWS):
            rows = slice(first, first + _BLOCK_ROWS)
            squares[rows], ranks = _nearest(tree, doubled[rows], count, workers)
            places[rows] = order[ranks]
    return Neighbours(places, np.sqrt(squares) / 2)


def mode_of_neighbours(neighbours: Neighbours, predicted_classes: NDArray[np.integer]) -> NDArray[np.int32]:
    """Return the most frequent class among the neighbours, which may be none (0). Ties go to the lowest number.

    The result is that of ``torch.mode``, which the published protocol uses.

    Args:
        neighbours: Neighbours of n positions.
        predicted_classes: (m,) class of each voxel of the map.

    Returns:
        (n,) int32, 0 without neighbours.
    """
    mode = np.zeros(len(neighbours.places), np.int32)
    if not neighbours.places.shape[1]:
        return mode
    for first in range(0, len(mode), _BLOCK_ROWS):
        rows = slice(first, first + _BLOCK_ROWS)
        classes = np.sort(np.asarray(predicted_classes, np.int32)[neighbours.places[rows]], axis=1)
        frequency = np.zeros(classes.shape, np.int32)
        for column in range(classes.shape[1]):
            frequency += classes == classes[:, column, None]
        # Classes are sorted, so the first of the most frequent ones is the lowest.
        mode[rows] = classes[np.arange(len(classes)), frequency.argmax(axis=1)]
    return mode


def same_voxels(positions: NDArray[np.number], predicted_keys: NDArray[np.integer]) -> NDArray[np.int64]:
    """Find the place of each position among the map's voxels, -1 if the map does not have it.

    Args:
        positions: (n, 3) voxel indices.
        predicted_keys: (m, 3) voxel indices of the map, all different.

    Raises:
        MapError: A position is not a voxel of the grid.
    """
    keys = np.asarray(positions).astype(np.int64)
    if not np.array_equal(keys, positions):
        raise MapError("k: 0 needs a truth on the map's own grid, with the rounding 'floor'")
    if not len(predicted_keys):
        return np.full(len(keys), -1, np.int64)
    wanted, held = (pack(torch.from_numpy(np.ascontiguousarray(each, np.int64))).numpy() for each in (keys, predicted_keys))
    order = np.argsort(held)
    place = np.minimum(np.searchsorted(held, wanted, sorter=order), len(held) - 1)
    return np.where(held[order[place]] == wanted, order[place], -1)


def _nearest(
    tree: cKDTree, points: NDArray[np.float64], count: int, workers: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return squared distances and ranks of the nearest ``count`` points of the tree; ties go to the lowest ranks."""
    squares = np.empty((len(points), count), np.int64)
    ranks = np.empty((len(points), count), np.int64)
    left, asked = np.arange(len(points)), count + _SPARE
    while len(left):
        asked = min(asked, tree.n)
        distances, found = tree.query(points[left], k=np.arange(1, asked + 1), workers=workers)
        # Squares of whole numbers are exact once rounded: the error of the root is smaller than their spacing.
        exact = np.rint(distances**2).astype(np.int64)
        by_rank = np.argsort(found, axis=1)
        exact, found = (np.take_along_axis(each, by_rank, axis=1) for each in (exact, found))
        chosen = np.argsort(exact, axis=1, kind="stable")
        exact, found = (np.take_along_axis(each, chosen, axis=1) for each in (exact, found))
        squares[left], ranks[left] = exact[:, :count], found[:, :count]
        # If the last one seen is as near as the last one taken, others at that distance may be unseen.
        left = left[exact[:, -1] == exact[:, count - 1]] if asked < tree.n else left[:0]
        asked *= 2
    return squares, ranks
