"""Compiled loops over embedding rows: reading and writing every storage type, and running means.

Rows lie in blocks, and a loop gets the addresses of the blocks. So it finds a row without searching, and a pool can grow
without moving. Everything is computed in float32.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic
from numpy.typing import NDArray

from fus3dmaps_core.voxel_map.kernels.compile_cache import njit
from fus3dmaps_core.voxel_map.kernels.numba_values import put_at, value_at
from fus3dmaps_core.voxel_map.rows.rounding import FRESH_SCALE_STEPS, KEEP_SCALE_ABOVE, KEEP_SCALE_BELOW, TINY

# Sums may be reordered, which lets the compiler use vector instructions. It also lets it take x - x for 0, so that isfinite
# is true of infinity here: values are compared with bounds instead.
_OPTIONS: dict[str, Any] = {
    "cache": True,
    "nogil": True,
    "error_model": "numpy",
    "fastmath": {"reassoc", "contract", "nsz"},
}
_TINY = np.float32(TINY)


@intrinsic
def _float_bits(typing_context: Any, value: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.bitcast(arguments[0], ir.IntType(32))

    return types.uint32(types.float32), generate


@intrinsic
def _bits_float(typing_context: Any, bits: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.bitcast(arguments[0], ir.FloatType())

    return types.float32(types.uint32), generate


@njit(inline="always")
def _dither(seed: Any, column: Any) -> Any:
    """Compute 32 random bits for a column of a row, the same as rows.rounding.dither."""
    bits = np.uint32(seed + np.uint32(np.uint32(column) * np.uint32(0x9E3779B9)))
    bits = np.uint32(bits ^ np.uint32(bits >> np.uint32(16)))
    bits = np.uint32(bits * np.uint32(0x7FEB352D))
    bits = np.uint32(bits ^ np.uint32(bits >> np.uint32(15)))
    bits = np.uint32(bits * np.uint32(0x846CA68B))
    return np.uint32(bits ^ np.uint32(bits >> np.uint32(16)))


@njit(**_OPTIONS)
def _store(tag: Any, size: int, address: int, seed: np.uint32, scale: np.float32, values: NDArray[np.float32]) -> np.float32:
    """Write len(values) values from an address on, rounded as in rows.rounding; returns the row's scale."""
    n = np.int64(len(values))
    if size == 4:
        for c in range(n):
            put_at(tag, address, c, values[c])
    elif size == 2:
        for c in range(n):
            bits = np.uint32(_float_bits(values[c]) + np.uint32(_dither(seed, c) & np.uint32(0x1FFF)))
            put_at(tag, address, c, _bits_float(np.uint32(bits & np.uint32(0xFFFFE000))))
    else:
        top = np.int32(0)  # Bits of positive floats order as integers, whose maximum the compiler vectorises.
        for c in range(n):
            top = max(top, np.int32(_float_bits(values[c]) & np.uint32(0x7FFFFFFF)))
        largest = max(_bits_float(np.uint32(top)), _TINY)
        if not (largest <= np.float32(KEEP_SCALE_BELOW) * scale and largest >= np.float32(KEEP_SCALE_ABOVE) * scale):
            scale = largest / np.float32(FRESH_SCALE_STEPS)
        inverse = np.float32(1.0) / scale
        for c in range(n):
            chance = (np.float32(np.int32(_dither(seed, c) >> np.uint32(20))) + np.float32(0.5)) * np.float32(2.0**-12)
            put_at(tag, address, c, max(min(np.floor(values[c] * inverse + chance), np.float32(127)), np.float32(-127)))
    return scale


@njit(**_OPTIONS)
def merge_means(
    tag: Any,
    size: int,
    addresses: NDArray[np.int64],
    shift: int,
    scales: NDArray[np.float32],
    rows: NDArray[np.int64],
    old: NDArray[np.float32],
    new: NDArray[np.float32],
    seeds: NDArray[np.int64],
    offsets: NDArray[np.int64],
    sources: NDArray[np.int64],
    amounts: NDArray[np.float32],
    embeddings: NDArray[np.float32],
    start: int,
    stop: int,
) -> None:
    """Write rows[i] <- (old[i] rows[i] + sum over its group of amounts embeddings[sources]) / new[i], i in [start, stop)."""
    width, mask = np.int64(embeddings.shape[1]), np.int64((1 << shift) - 1)
    values = np.empty(width, np.float32)
    for i in range(start, stop):
        row, share = rows[i], old[i] / new[i]
        address = addresses[row >> shift] + size * width * (row & mask)
        scale = np.float32(0.0)
        if share > 0:  # A fresh row holds whatever its last owner left.
            scale = scales[row] if size == 1 else np.float32(1.0)
            factor = share * scale
            for c in range(width):
                values[c] = factor * value_at(tag, address, c)
        else:
            values[:] = 0.0
        for j in range(offsets[i], offsets[i + 1]):
            factor, source = amounts[j] / new[i], embeddings[sources[j]]
            for c in range(width):
                values[c] += factor * source[c]
        scale = _store(tag, size, address, np.uint32(seeds[i]), scale, values)
        if size == 1:
            scales[row] = scale


@njit(**_OPTIONS)
def unit_rows(values: NDArray[Any], units: NDArray[np.float32], start: int, stop: int) -> int:
    """Write rows scaled to unit length; returns 1 if one is not finite, 2 if one has length 0, else 0."""
    width = values.shape[1]
    for i in range(start, stop):
        squares = 0.0
        for c in range(width):
            squares += np.float64(values[i, c]) * np.float64(values[i, c])
        lift = 1.0
        if not (squares > 1e-280 and squares < 1e300):
            largest = 0.0
            for c in range(width):
                if not abs(np.float64(values[i, c])) <= 1.7976931348623157e308:
                    return 1
                largest = max(largest, abs(np.float64(values[i, c])))
            if largest == 0.0:
                return 2
            # Lengths whose squares overflow or vanish are brought to where they do neither.
            lift = 2.0**600 if largest < 1.0 else 2.0**-600
            squares = 0.0
            for c in range(width):
                squares += (np.float64(values[i, c]) * lift) ** 2
        factor = 1.0 / np.sqrt(squares)
        for c in range(width):
            units[i, c] = np.float32(np.float64(values[i, c]) * lift * factor)
    return 0
