"""Compiled loops over embedding rows: reading and writing every storage type, means, cosines and fusion sums.

Rows live in blocks whose addresses are handed over, so that a row is found without searching and a pool can grow without
moving. Storage types are told apart once a row; everything is computed in float32, and sums over blocks in float64.
Nothing here depends on another compiled module, for numba's cache notices changes of the file itself only.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir
from numba import carray, njit, types
from numba.extending import intrinsic
from numpy.typing import NDArray

from fus3dmaps_core.memory.rounding import FRESH_SCALE_STEPS, KEEP_SCALE_ABOVE, KEEP_SCALE_BELOW, TINY

FLOAT32, FLOAT16, INT8 = 0, 1, 2
"""How a pool stores its values."""

# Sums may be reordered, which lets the compiler use vector instructions. It also lets it take x - x for 0, so that isfinite
# is true of infinity here: values are compared with bounds instead.
_OPTIONS: dict[str, Any] = {
    "cache": True,
    "nogil": True,
    "error_model": "numpy",
    "fastmath": {"reassoc", "contract", "nsz"},
}
_TINY = np.float32(TINY)


def _pointer_to(element: Any) -> Callable[[int], Any]:
    @intrinsic
    def cast(typing_context: Any, address: Any) -> Any:
        signature = types.CPointer(element)(types.int64)

        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            return builder.inttoptr(arguments[0], context.get_value_type(signature.return_type))

        return signature, generate

    pointer: Callable[[int], Any] = cast
    return pointer


_float32_at = _pointer_to(types.float32)
_uint16_at = _pointer_to(types.uint16)
_int8_at = _pointer_to(types.int8)


@intrinsic
def _half_to_float(typing_context: Any, half: Any) -> Any:
    """A half's bits as the float of the same value: one instruction where the processor knows halves."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.fpext(builder.bitcast(arguments[0], ir.HalfType()), ir.FloatType())

    return types.float32(types.uint16), generate


@intrinsic
def _float_to_half(typing_context: Any, value: Any) -> Any:
    """A float as the bits of the nearest half."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.bitcast(builder.fptrunc(arguments[0], ir.HalfType()), ir.IntType(16))

    return types.uint16(types.float32), generate


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
    """32 random bits for a column of a row; the same as memory.rounding.dither."""
    bits = np.uint32(seed + np.uint32(np.uint32(column) * np.uint32(0x9E3779B9)))
    bits = np.uint32(bits ^ np.uint32(bits >> np.uint32(16)))
    bits = np.uint32(bits * np.uint32(0x7FEB352D))
    bits = np.uint32(bits ^ np.uint32(bits >> np.uint32(15)))
    bits = np.uint32(bits * np.uint32(0x846CA68B))
    return np.uint32(bits ^ np.uint32(bits >> np.uint32(16)))


@njit(**_OPTIONS)
def _address(kind: int, addresses: NDArray[np.int64], block_rows: int, width: int, row: int) -> int:
    """Address of a row's first value."""
    block = row // block_rows
    size = 4 if kind == FLOAT32 else 2 if kind == FLOAT16 else 1
    return addresses[block] + size * width * (row - block * block_rows)


@njit(**_OPTIONS)
def _load(kind: int, address: int, scale: np.float32, values: NDArray[np.float32]) -> np.float32:
    """Read len(values) stored values from an address on; returns the sum of their squares."""
    n = len(values)
    squares = np.float32(0.0)
    if kind == FLOAT32:
        floats = carray(_float32_at(address), (n,))
        for c in range(n):
            value = floats[c]
            values[c] = value
            squares += value * value
    elif kind == FLOAT16:
        halves = carray(_uint16_at(address), (n,))
        for c in range(n):
            value = _half_to_float(halves[c])
            values[c] = value
            squares += value * value
    else:
        steps = carray(_int8_at(address), (n,))
        for c in range(n):
            value = scale * np.float32(steps[c])
            values[c] = value
            squares += value * value
    return squares


@njit(**_OPTIONS)
def _store(kind: int, address: int, seed: np.uint32, scale: np.float32, values: NDArray[np.float32]) -> np.float32:
    """Write len(values) values from an address on, rounded as memory.rounding says; returns the row's scale."""
    n = len(values)
    if kind == FLOAT32:
        floats = carray(_float32_at(address), (n,))
        for c in range(n):
            floats[c] = values[c]
    elif kind == FLOAT16:
        halves = carray(_uint16_at(address), (n,))
        for c in range(n):
            bits = np.uint32(_float_bits(values[c]) + np.uint32(_dither(seed, c) & np.uint32(0x1FFF)))
            halves[c] = _float_to_half(_bits_float(np.uint32(bits & np.uint32(0xFFFFE000))))
    else:
        top = np.int32(0)  # Bits of positive floats order as integers, whose maximum the compiler vectorises.
        for c in range(n):
            top = max(top, np.int32(_float_bits(values[c]) & np.uint32(0x7FFFFFFF)))
        largest = max(_bits_float(np.uint32(top)), _TINY)
        if not (largest <= np.float32(KEEP_SCALE_BELOW) * scale and largest >= np.float32(KEEP_SCALE_ABOVE) * scale):
            scale = largest / np.float32(FRESH_SCALE_STEPS)
        inverse = np.float32(1.0) / scale
        steps = carray(_int8_at(address), (n,))
        for c in range(n):
            chance = (np.float32(np.int32(_dither(seed, c) >> np.uint32(20))) + np.float32(0.5)) * np.float32(2.0**-12)
            steps[c] = np.int8(max(min(np.floor(values[c] * inverse + chance), np.float32(127)), np.float32(-127)))
    return scale


@njit(**_OPTIONS)
def merge_means(
    kind: int,
    addresses: NDArray[np.int64],
    block_rows: int,
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
    """rows[i] <- (old[i] rows[i] + sum over its group of amounts embeddings[sources]) / new[i], for i in [start, stop)."""
    width = embeddings.shape[1]
    values = np.empty(width, np.float32)
    for i in range(start, stop):
        row, share = rows[i], old[i] / new[i]
        address = _address(kind, addresses, block_rows, width, row)
        scale = np.float32(0.0)
        if share > 0:  # A fresh row holds whatever its last owner left.
            scale = scales[row] if kind == INT8 else np.float32(0.0)
            _load(kind, address, scale, values)
            for c in range(width):
                values[c] *= share
        else:
            values[:] = 0.0
        for j in range(offsets[i], offsets[i + 1]):
            factor, source = amounts[j] / new[i], embeddings[sources[j]]
            for c in range(width):
                values[c] += factor * source[c]
        scale = _store(kind, address, np.uint32(seeds[i]), scale, values)
        if kind == INT8:
            scales[row] = scale


@njit(**_OPTIONS)
def _dots(
    values: NDArray[np.float32], squares: np.float32, texts: NDArray[np.float32], cosines: NDArray[np.float32]
) -> None:
    """Cosines of one vector, whose squares' sum is given, with unit vectors."""
    scale = np.float32(1.0) / max(np.sqrt(squares), _TINY)
    for p in range(len(texts)):
        text, dot = texts[p], np.float32(0.0)
        for c in range(len(values)):
            dot += values[c] * text[c]
        cosines[p] = dot * scale


@njit(**_OPTIONS)
def _cosine(kind: int, address: int, scale: np.float32, text: NDArray[np.float32]) -> np.float32:
    """Cosine of a stored row with one unit vector, in one loop without a copy of the row: what most queries ask."""
    n = len(text)
    squares, dot = np.float32(0.0), np.float32(0.0)
    if kind == FLOAT32:
        floats = carray(_float32_at(address), (n,))
        for c in range(n):
            squares += floats[c] * floats[c]
            dot += floats[c] * text[c]
    elif kind == FLOAT16:
        halves = carray(_uint16_at(address), (n,))
        for c in range(n):
            value = _half_to_float(halves[c])
            squares += value * value
            dot += value * text[c]
    else:
        steps = carray(_int8_at(address), (n,))
        for c in range(n):
            value = scale * np.float32(steps[c])
            squares += value * value
            dot += value * text[c]
    return dot / max(np.sqrt(squares), _TINY)


@njit(**_OPTIONS)
def cosines(
    kind: int,
    addresses: NDArray[np.int64],
    block_rows: int,
    scales: NDArray[np.float32],
    rows: NDArray[np.int64],
    texts: NDArray[np.float32],
    found: NDArray[np.float32],
    start: int,
    stop: int,
) -> None:
    """Write the cosines of rows with unit vectors (p, d), for i in [start, stop)."""
    width = texts.shape[1]
    values = np.empty(width, np.float32)
    for i in range(start, stop):
        scale = scales[rows[i]] if kind == INT8 else np.float32(0.0)
        address = _address(kind, addresses, block_rows, width, rows[i])
        if len(texts) == 1:
            found[i, 0] = _cosine(kind, address, scale, texts[0])
        else:
            squares = _load(kind, address, scale, values)
            _dots(values, squares, texts, found[i])


@njit(**_OPTIONS)
def fused_cosines(
    kind: int,
    addresses: NDArray[np.int64],
    block_rows: int,
    scales: NDArray[np.float32],
    rows: NDArray[np.int64],
    weights: NDArray[np.float32],
    own_addresses: NDArray[np.int64],
    own_block_rows: int,
    own_rows: NDArray[np.int64],
    own_weights: NDArray[np.float32],
    texts: NDArray[np.float32],
    found: NDArray[np.float32],
    start: int,
    stop: int,
) -> None:
    """Write the cosines of weighted sums of a row (-1: none) and an instance's row (float32; -1: none)."""
    width = texts.shape[1]
    values, own = np.empty(width, np.float32), np.empty(width, np.float32)
    loaded = np.int64(-1)
    for i in range(start, stop):
        row, own_row, squares = rows[i], own_rows[i], np.float32(0.0)
        if row >= 0:
            scale = scales[row] if kind == INT8 else np.float32(0.0)
            squares = _load(kind, _address(kind, addresses, block_rows, width, row), scale, values)
        if own_row >= 0:
            if own_row != loaded:  # Neighbouring voxels mostly belong to one object.
                _load(FLOAT32, _address(FLOAT32, own_addresses, own_block_rows, width, own_row), np.float32(0.0), own)
                loaded = own_row
            share, rest = np.float32(0.0), np.float32(1.0)
            if row >= 0:
                share = weights[i] / (weights[i] + own_weights[i])
                rest = own_weights[i] / (weights[i] + own_weights[i])
            else:
                values[:] = 0.0
            squares = np.float32(0.0)
            for c in range(width):
                value = share * values[c] + rest * own[c]
                values[c] = value
                squares += value * value
        _dots(values, squares, texts, found[i])


@njit(**_OPTIONS)
def weighted_sums(
    kind: int,
    addresses: NDArray[np.int64],
    block_rows: int,
    scales: NDArray[np.float32],
    slot_of_row: NDArray[np.int32],
    weight_of_row: NDArray[np.float32],
    held_row: NDArray[np.int32],
    place_of_instance: NDArray[np.int32],
    lane: int,
    lanes: int,
    sums: NDArray[np.float64],
    totals: NDArray[np.float64],
) -> None:
    """Add w f of the voxels' rows to the sums of the instances that they hold, and w to their totals.

    Args:
        kind: Storage type of the rows.
        addresses: Address of each block.
        block_rows: Rows of a block.
        scales: Scale of each int8 row.
        slot_of_row: Slot of each row, -1 for a free one.
        weight_of_row: w of each row.
        held_row: (slots, K) instances held, -1 where empty.
        place_of_instance: Which sum an instance's voxels go to, -1 for none.
        lane: Which blocks are visited: every ``lanes``-th from this one on, in order.
        lanes: Number of lanes, each with sums of its own, so that results do not depend on the number of threads.
        sums: (n, d) changed.
        totals: (n,) changed.
    """
    width, places = sums.shape[1], held_row.shape[1]
    values = np.empty(width, np.float32)
    # Sums of one block are in float32, half the work, and then added in float64: whose block ends where depends on no other.
    part_of_place = np.full(len(sums), -1, np.int32)
    place_of_part = np.empty(min(len(sums), places * block_rows), np.int32)
    parts = np.empty((len(place_of_part), width), np.float32)
    for begin in range(lane * block_rows, len(slot_of_row), lanes * block_rows):
        used = 0
        for row in range(begin, min(begin + block_rows, len(slot_of_row))):
            slot, weight = slot_of_row[row], weight_of_row[row]
            loaded = False
            for k in range(places if slot >= 0 else 0):
                place = place_of_instance[held_row[slot, k]] if held_row[slot, k] >= 0 else -1
                if place < 0:
                    continue
                if not loaded:
                    scale = scales[row] if kind == INT8 else np.float32(0.0)
                    _load(kind, _address(kind, addresses, block_rows, width, row), scale, values)
                    loaded = True
                if part_of_place[place] < 0:
                    part_of_place[place] = used
                    place_of_part[used] = place
                    parts[used] = 0.0
                    used += 1
                target = parts[part_of_place[place]]
                for c in range(width):
                    target[c] += weight * values[c]
                totals[place] += weight
        for part in range(used):
            source, target64 = parts[part], sums[place_of_part[part]]
            for c in range(width):
                target64[c] += np.float64(source[c])
            part_of_place[place_of_part[part]] = -1


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
