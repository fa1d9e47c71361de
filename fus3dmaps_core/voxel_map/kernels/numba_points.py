"""Compiled loops over points and keys: voxelising, grouping, and the probing of the voxel hash."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from fus3dmaps_core.voxel_map.kernels.compile_cache import njit

_OPTIONS: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy"}
_MULTIPLIER = np.int64(-7046029254386353131)  # 2^64 / golden ratio, as in the hash.


@njit(**_OPTIONS)
def voxel_keys(points: NDArray[Any], voxel_size_m: float, half: int, bits: int, keys: NDArray[np.int64]) -> float:
    """Write the packed key of each point; returns the largest coordinate's size, NaN if a point is not finite."""
    largest = 0.0
    for i in range(len(points)):
        key = np.int64(0)
        for axis in range(3):
            cell = np.floor(np.float64(points[i, axis]) / voxel_size_m)
            if not np.isfinite(cell):
                return np.nan
            largest = max(largest, abs(cell))
            if abs(cell) < half:
                key = (key << bits) | (np.int64(cell) + half)
        keys[i] = key
    return largest


@njit(**_OPTIONS)
def centers(keys: NDArray[np.int64], voxel_size_m: float, half: int, bits: int, found: NDArray[np.float32]) -> None:
    """Write the centre of each key's voxel, metres."""
    mask = (1 << bits) - 1
    for i in range(len(keys)):
        for axis in range(3):
            coordinate = ((keys[i] >> ((2 - axis) * bits)) & mask) - half
            found[i, axis] = np.float32((np.float64(coordinate) + 0.5) * voxel_size_m)


@njit(**_OPTIONS)
def farther(
    keys: NDArray[np.int64],
    voxel_size_m: float,
    half: int,
    bits: int,
    point: NDArray[np.float64],
    radius_m: float,
    places: NDArray[np.int64],
) -> int:
    """Write the places of keys whose voxel's centre is farther than a radius from a point; returns how many there are."""
    mask = (1 << bits) - 1
    found = 0
    for i in range(len(keys)):
        squares = 0.0
        for axis in range(3):
            coordinate = ((keys[i] >> ((2 - axis) * bits)) & mask) - half
            offset = (np.float64(coordinate) + 0.5) * voxel_size_m - point[axis]
            squares += offset * offset
        if np.sqrt(squares) > radius_m:
            places[found] = i
            found += 1
    return found


@njit(**_OPTIONS)
def distinct(
    keys: NDArray[np.int64], unique: NDArray[np.int64], inverse: NDArray[np.int64], counts: NDArray[np.int64]
) -> int:
    """Write the distinct keys and their counts in the order of first appearance; returns how many there are."""
    capacity = 16
    while capacity < 2 * len(keys):
        capacity *= 2
    shift = 64
    while (1 << (64 - shift)) < capacity:
        shift -= 1
    table = np.full(capacity, -1, np.int32)
    found = 0
    for i in range(len(keys)):
        cell = ((keys[i] * _MULTIPLIER) >> shift) & (capacity - 1)
        while table[cell] >= 0 and unique[table[cell]] != keys[i]:
            cell = (cell + 1) & (capacity - 1)
        if table[cell] < 0:
            table[cell] = found
            unique[found] = keys[i]
            counts[found] = 0
            found += 1
        inverse[i] = table[cell]
        counts[table[cell]] += 1
    return found


@njit(**_OPTIONS)
def count_pairs(
    first: NDArray[np.int64],
    second: NDArray[np.int64],
    seconds: int,
    offsets: NDArray[np.int64],
    partners: NDArray[np.int64],
    counts: NDArray[np.int64],
) -> None:
    """Count equal (first, second) pairs, grouped by first; groups keep the order in which partners appear.

    Args:
        first: (n,) group of each point, in [0, len(offsets) - 1).
        second: (n,) partner of each point, in [0, seconds).
        seconds: Number of possible partners.
        offsets: Written: where each group begins in the other two, and where the last one ends.
        partners: Written up to offsets[-1]: partners of the groups.
        counts: Written up to offsets[-1]: how often each pair occurs.
    """
    groups = len(offsets) - 1
    starts = np.zeros(groups + 1, np.int64)
    for i in range(len(first)):
        starts[first[i] + 1] += 1
    for group in range(groups):
        starts[group + 1] += starts[group]
    ordered = np.empty(len(first), np.int64)
    cursor = starts[:-1].copy()
    for i in range(len(first)):
        ordered[cursor[first[i]]] = second[i]
        cursor[first[i]] += 1
    seen_in = np.full(seconds, -1, np.int64)
    seen_at = np.empty(seconds, np.int64)
    end = 0
    for group in range(groups):
        offsets[group] = end
        for i in range(starts[group], starts[group + 1]):
            partner = ordered[i]
            if seen_in[partner] == group:
                counts[seen_at[partner]] += 1
            else:
                seen_in[partner] = group
                seen_at[partner] = end
                partners[end] = partner
                counts[end] = 1
                end += 1
    offsets[groups] = end


@njit(**_OPTIONS)
def find(
    table_keys: NDArray[np.int64],
    table_slots: NDArray[np.int32],
    shift: int,
    empty: int,
    keys: NDArray[np.int64],
    slots: NDArray[np.int64],
) -> None:
    """Write the slot of each key, -1 for those that the table lacks."""
    mask = len(table_keys) - 1
    for i in range(len(keys)):
        cell = ((keys[i] * _MULTIPLIER) >> shift) & mask
        while table_keys[cell] != empty and table_keys[cell] != keys[i]:
            cell = (cell + 1) & mask
        slots[i] = table_slots[cell] if table_keys[cell] == keys[i] else -1


@njit(**_OPTIONS)
def place(
    table_keys: NDArray[np.int64],
    table_slots: NDArray[np.int32],
    shift: int,
    empty: int,
    keys: NDArray[np.int64],
    slots: NDArray[np.int64],
) -> None:
    """Put distinct keys that the table lacks into it."""
    mask = len(table_keys) - 1
    for i in range(len(keys)):
        cell = ((keys[i] * _MULTIPLIER) >> shift) & mask
        while table_keys[cell] != empty:
            cell = (cell + 1) & mask
        table_keys[cell] = keys[i]
        table_slots[cell] = slots[i]


@njit(**_OPTIONS)
def mark_deleted(table_keys: NDArray[np.int64], shift: int, deleted: int, keys: NDArray[np.int64]) -> None:
    """Mark the cells of keys that are in the table as deleted: probing goes on past them."""
    mask = len(table_keys) - 1
    for i in range(len(keys)):
        cell = ((keys[i] * _MULTIPLIER) >> shift) & mask
        while table_keys[cell] != keys[i]:
            cell = (cell + 1) & mask
        table_keys[cell] = deleted
