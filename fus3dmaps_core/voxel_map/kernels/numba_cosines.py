"""Compiled cosines of embedding rows with texts: of single rows, and of rows fused with those of instances."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from fus3dmaps_core.voxel_map.kernels.compile_cache import njit
from fus3dmaps_core.voxel_map.kernels.numba_values import CACHE_LINE, FLOAT, prefetch, value_at
from fus3dmaps_core.voxel_map.rows.rounding import TINY

_OPTIONS: dict[str, Any] = {
    "cache": True,
    "nogil": True,
    "error_model": "numpy",
    "fastmath": {"reassoc", "contract", "nsz"},  # Lets the compiler use vector instructions for sums.
}
_TINY = np.float32(TINY)
_AHEAD = 8
_CANCELLED = np.float32(0.1)


@njit(**_OPTIONS)
def _dots(values: NDArray[np.float32], texts: NDArray[np.float32], scale: np.float32, found: NDArray[np.float32]) -> None:
    """Write the products of one vector with each text, times a scale; the vector is read once for four texts."""
    width, whole = len(values), len(texts) // 4 * 4
    for p in range(0, whole, 4):
        a, b, c, d = texts[p], texts[p + 1], texts[p + 2], texts[p + 3]
        to_a = to_b = to_c = to_d = np.float32(0.0)
        for j in range(width):
            to_a += values[j] * a[j]
            to_b += values[j] * b[j]
            to_c += values[j] * c[j]
            to_d += values[j] * d[j]
        found[p], found[p + 1], found[p + 2], found[p + 3] = to_a * scale, to_b * scale, to_c * scale, to_d * scale
    for p in range(whole, len(texts)):
        a, to_a = texts[p], np.float32(0.0)
        for j in range(width):
            to_a += values[j] * a[j]
        found[p] = to_a * scale


@njit(inline="always")
def _fetch(addresses: NDArray[np.int64], shift: int, row_bytes: int, row: np.int64) -> None:
    """Begin to read a row: short ones end before the processor has seen by itself what comes next."""
    address = addresses[row >> shift] + row_bytes * (row & ((1 << shift) - 1))
    for line in range(0, row_bytes, CACHE_LINE):
        prefetch(address + line)


@njit(**_OPTIONS)
def cosines(
    tag: Any,
    size: int,
    addresses: NDArray[np.int64],
    shift: int,
    rows: NDArray[Any],
    texts: NDArray[np.float32],
    found: NDArray[np.float32],
    start: int,
    stop: int,
) -> None:
    """Write the cosines (n, p) of rows with unit vectors (p, d), for i in [start, stop)."""
    width, mask = texts.shape[1], (1 << shift) - 1
    text = texts.ctypes.data
    values = np.empty(width, np.float32)
    for i in range(start, stop):
        if i + _AHEAD < stop:
            _fetch(addresses, shift, size * width, np.int64(rows[i + _AHEAD]))
        row = np.int64(rows[i])
        address = addresses[row >> shift] + size * width * (row & mask)
        squares, dot = np.float32(0.0), np.float32(0.0)
        if len(texts) == 1:  # What most queries ask: one loop, without a copy of the row.
            for c in range(width):
                value = value_at(tag, address, c)
                squares += value * value
                dot += value * value_at(FLOAT, text, c)
            found[i, 0] = dot / max(np.sqrt(squares), _TINY)
        else:
            for c in range(width):
                value = value_at(tag, address, c)
                values[c] = value
                squares += value * value
            _dots(values, texts, np.float32(1.0) / max(np.sqrt(squares), _TINY), found[i])


@njit(**_OPTIONS)
def fused_cosines(
    tag: Any,
    size: int,
    addresses: NDArray[np.int64],
    shift: int,
    scales: NDArray[np.float32],
    weight_of_row: NDArray[np.float32],
    own_addresses: NDArray[np.int64],
    own_shift: int,
    variance_ratio: np.float32,
    picked: NDArray[np.int32],
    dense_rows: NDArray[np.int32],
    top_row: NDArray[np.int32],
    top_count: NDArray[np.int32],
    texts: NDArray[np.float32],
    found: NDArray[np.float32],
) -> None:
    """Write the cosines of (w f + lambda c g) / (w + lambda c), of voxels with either f or g or both.

    With one text only dot products of the row are needed: |s f + r g|^2 = s^2 ff + 2 s r fg + r^2 gg. Where that would lose
    digits, because f and g nearly cancel out, the sum itself is computed.
    """
    width, mask, own_mask = texts.shape[1], (1 << shift) - 1, (1 << own_shift) - 1
    text, fused, nothing = texts.ctypes.data, np.empty(width, np.float32), np.zeros(width, np.float32)
    compared = np.int64(-2)
    own, own_dot, own_squares = nothing.ctypes.data, np.float32(0.0), np.float32(0.0)
    for i in range(len(found)):
        if i + _AHEAD < len(found) and dense_rows[picked[i + _AHEAD]] >= 0:
            _fetch(addresses, shift, size * width, np.int64(dense_rows[picked[i + _AHEAD]]))
        place = picked[i]
        row, own_row = np.int64(dense_rows[place]), np.int64(top_row[place])
        if own_row != compared:  # Neighbouring voxels mostly belong to one object.
            compared = own_row
            own = nothing.ctypes.data
            if own_row >= 0:
                own = own_addresses[own_row >> own_shift] + 4 * width * (own_row & own_mask)
            own_dot, own_squares = np.float32(0.0), np.float32(0.0)
            for c in range(width):
                value = value_at(FLOAT, own, c)
                own_dot += value * value_at(FLOAT, text, c)
                own_squares += value * value
        share, rest, address = np.float32(0.0), np.float32(1.0), np.int64(0)
        if row >= 0:
            address = addresses[row >> shift] + size * width * (row & mask)
            weight = weight_of_row[row]
            own_weight = variance_ratio * np.float32(top_count[place]) if own_row >= 0 else np.float32(0.0)
            scale = scales[row] if size == 1 else np.float32(1.0)
            share, rest = scale * (weight / (weight + own_weight)), own_weight / (weight + own_weight)
        if len(texts) == 1:
            dot, squares, both = np.float32(0.0), np.float32(0.0), np.float32(0.0)
            if row >= 0:
                for c in range(width):
                    value = value_at(tag, address, c)
                    dot += value * value_at(FLOAT, text, c)
                    squares += value * value
                    both += value * value_at(FLOAT, own, c)
            apart = share * share * squares + rest * rest * own_squares
            together = apart + np.float32(2.0) * share * rest * both
            if together > _CANCELLED * apart:
                found[i, 0] = (share * dot + rest * own_dot) / max(np.sqrt(together), _TINY)
                continue
        squares = np.float32(0.0)
        if row >= 0:
            for c in range(width):
                value = share * value_at(tag, address, c) + rest * value_at(FLOAT, own, c)
                fused[c] = value
                squares += value * value
        else:
            for c in range(width):
                fused[c] = value_at(FLOAT, own, c)
            squares = own_squares
        _dots(fused, texts, np.float32(1.0) / max(np.sqrt(squares), _TINY), found[i])
