"""The compiled pass over dense rows that fuses instances with the voxels that they hold."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from fus3dmaps_core.voxel_map.kernels.compile_cache import njit
from fus3dmaps_core.voxel_map.kernels.numba_values import CACHE_LINE, FLOAT, prefetch, put_at, value_at

_OPTIONS: dict[str, Any] = {
    "cache": True,
    "nogil": True,
    "error_model": "numpy",
    "fastmath": {"reassoc", "contract", "nsz"},  # Lets the compiler multiply and add in one instruction.
}
_AHEAD = 8


@njit(**_OPTIONS)
def _add_row(tag: Any, row: int, factor: np.float32, part: int, parts: NDArray[np.float32]) -> None:
    # The part is named by its place, not cut out: to count who uses a slice takes as long as to add a short row.
    for c in range(parts.shape[1]):
        parts[part, c] += factor * value_at(tag, row, c)


@njit(**_OPTIONS)
def add_rows(
    tag: Any,
    size: int,
    addresses: NDArray[np.int64],
    shift: int,
    scales: NDArray[np.float32],
    slot_of_row: NDArray[np.int32],
    weight_of_row: NDArray[np.float32],
    held_row: NDArray[np.int32],
    place_of_instance: NDArray[np.int32],
    first_block: int,
    last_block: int,
    step: int,
    parts: NDArray[np.float32],
    sums: NDArray[np.float64],
    totals: NDArray[np.float64],
    known: NDArray[np.bool_],
) -> None:
    """Add w f of the voxels' rows to the sums of the instances that they hold, and w to their totals.

    Sums of one block are in float32, half the work, and then added in float64: where a block ends depends on no instance.

    Args:
        tag: How rows are stored.
        size: Bytes of a stored value.
        addresses: Address of each block.
        shift: log2 of the rows of a block.
        scales: Scale of each int8 row.
        slot_of_row: Slot of each row, -1 for a free one.
        weight_of_row: w of each row.
        held_row: (slots, K) instances held, -1 where empty.
        place_of_instance: Which sum an instance's voxels go to, -1 for none.
        first_block: First block that is visited.
        last_block: One more than the last.
        step: How many blocks further the next one is.
        parts: (m, d) room for the sums of one block: K rows of a block, or as many as there are sums if that is less.
        sums: (n, d) changed; a sum's first addend is written over whatever is there.
        totals: (n,) changed.
        known: (n,) changed: which sums have been written.
    """
    width, places, block_rows = sums.shape[1], held_row.shape[1], 1 << shift
    row_bytes = size * width
    part_of_place = np.full(len(sums), -1, np.int32)
    place_of_part = np.empty(len(parts), np.int32)
    hits = places * block_rows
    hit_row, hit_factor, hit_part = np.empty(hits, np.int64), np.empty(hits, np.float32), np.empty(hits, np.int32)
    for block in range(first_block, last_block, step):
        begin, used, hits = block * block_rows, 0, 0
        for row in range(begin, min(begin + block_rows, len(slot_of_row))):
            slot, weight = slot_of_row[row], weight_of_row[row]
            for k in range(places if slot >= 0 else 0):
                place = place_of_instance[held_row[slot, k]] if held_row[slot, k] >= 0 else -1
                if place < 0:
                    continue
                totals[place] += weight
                part = int(part_of_place[place])
                if part < 0:
                    part, used = used, used + 1
                    part_of_place[place], place_of_part[part] = part, place
                    for c in range(width):
                        parts[part, c] = 0.0
                hit_row[hits] = addresses[block] + row_bytes * (row - begin)
                hit_factor[hits] = weight * scales[row] if size == 1 else weight
                hit_part[hits] = part
                hits += 1
        for hit in range(hits):
            # Rows that nobody asks for lie between, so the processor does not see by itself what comes next.
            if hit + _AHEAD < hits and hit_row[hit + _AHEAD] != hit_row[hit + _AHEAD - 1]:
                for line in range(0, row_bytes, CACHE_LINE):
                    prefetch(hit_row[hit + _AHEAD] + line)
            _add_row(tag, hit_row[hit], hit_factor[hit], hit_part[hit], parts)
        for part in range(used):
            place = place_of_part[part]
            part_of_place[place] = -1
            if known[place]:
                for c in range(width):
                    sums[place, c] += np.float64(parts[part, c])
            else:
                known[place] = True
                for c in range(width):
                    sums[place, c] = np.float64(parts[part, c])


@njit(**_OPTIONS)
def write_fused(
    sums: NDArray[np.float64],
    totals: NDArray[np.float64],
    known: NDArray[np.bool_],
    rows: NDArray[np.int64],
    own_addresses: NDArray[np.int64],
    amounts: NDArray[np.float64],
    target_addresses: NDArray[np.int64],
    shift: int,
    bars: NDArray[np.float64],
    evidence: NDArray[np.float64],
    start: int,
    stop: int,
) -> None:
    """Write (sums + amounts own) / evidence into the rows whose evidence is above a bar, for i in [start, stop).

    Args:
        sums: (lanes, n, d) sums of w f.
        totals: (lanes, n) sums of w.
        known: (lanes, n) which sums there are.
        rows: (n,) rows of the instances.
        own_addresses: Addresses of the blocks of their own embeddings, float32.
        amounts: (n,) weight of their own embedding.
        target_addresses: Addresses of the blocks that are written, float32.
        shift: log2 of the rows of a block, of both.
        bars: (n,) what evidence has to exceed.
        evidence: (n,) written: totals + amounts.
        start: First instance.
        stop: One more than the last.
    """
    width, mask = sums.shape[2], (1 << shift) - 1
    fused = np.empty(width, np.float64)
    for i in range(start, stop):
        total = amounts[i]
        for lane in range(len(totals)):
            total += totals[lane, i]
        evidence[i] = total
        if not total > bars[i]:
            continue
        place = 4 * width * (rows[i] & mask)
        own = own_addresses[rows[i] >> shift] + place
        # Without lambda and dense evidence an instance has nothing to be fused from and keeps its own embedding.
        amount, factor = (amounts[i], 1.0 / total) if total > 0.0 else (1.0, 1.0)
        for c in range(width):
            fused[c] = amount * np.float64(value_at(FLOAT, own, c))
        for lane in range(len(sums)):
            if known[lane, i]:
                for c in range(width):
                    fused[c] += sums[lane, i, c]
        target = target_addresses[rows[i] >> shift] + place
        for c in range(width):
            put_at(FLOAT, target, c, np.float32(fused[c] * factor))
