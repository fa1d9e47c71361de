"""The compiled pass over voxels: what instances occupy, and how the voxels of a layer compare with texts.

Every voxel is visited once, a few thousand at a time. So their data stays in the processor's cache between one loop and
the next. Sums over an instance's voxels stay in registers while neighbours have the same top hypothesis, and then go into a
table of the few instances of these voxels. Loops index by unsigned numbers and write out the three axes, which made them
three times as fast.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fus3dmaps_core.voxel_map.kernels.compile_cache import njit
from fus3dmaps_core.voxel_map.kernels.keys import BITS, HALF
from fus3dmaps_core.voxel_map.kernels.numba_cosines import cosines, fused_cosines
from fus3dmaps_core.voxel_map.kernels.numba_values import FLOAT
from fus3dmaps_core.voxel_map.kernels.protocols import SCORE_UNIT

NOTHING, DENSE, FUSED, INSTANCES = 0, 1, 2, 3
"""What is asked of the voxels."""

EXTENT_COLUMNS = 11
"""Voxels, their counts, sums of count times coordinate, lowest and highest coordinates."""

_OPTIONS: dict[str, Any] = {
    "cache": True,
    "nogil": True,
    "error_model": "numpy",
    "fastmath": {"reassoc", "contract", "nsz"},  # Lets the compiler use vector instructions for sums.
}
_UNIT = np.float32(SCORE_UNIT)
_MASK = (1 << BITS) - 1
_FAR = np.int64(2**62)
_SLOTS, _LEAST_SLOTS = 4096, 256  # Looked at together: what is known of them stays in a cache.
_COSINES = 2**18


class Voxels(NamedTuple):
    """Consecutive slots.

    Attributes:
        first: Number of the first slot.
        keys: (n,) keys of the slots, negative where there is no voxel.
        dense_rows: (n,) dense rows, -1 for none.
        voxel_size_m: Edge of a voxel, metres.
    """

    first: int
    keys: NDArray[np.int64]
    dense_rows: NDArray[np.int32]
    voxel_size_m: float


class Held(NamedTuple):
    """Hypotheses of all slots.

    Attributes:
        rows: (slots, K) rows of the instances, -1 where empty.
        counts: (slots, K) their counts, 0 where empty.
        id_of_row: Ids of the instances.
    """

    rows: NDArray[np.int32]
    counts: NDArray[np.int32]
    id_of_row: NDArray[np.int64]


class Asked(NamedTuple):
    """A layer and what it is compared with. What a layer does not have is empty.

    Attributes:
        layer: NOTHING, or which layer is compared.
        tag: How dense rows are stored.
        size: Bytes of a stored value.
        addresses: Addresses of the dense rows' blocks.
        shift: log2 of the rows of a block.
        scales: Scale of each int8 row.
        weight_of_row: w of each dense row.
        own_addresses: Addresses of the blocks of the instances' rows, which are float32.
        own_shift: log2 of the rows of such a block.
        variance_ratio: lambda.
        texts: (p + q, d) unit vectors: prompts, then negatives.
        prompts: p.
        logit_scale: Factor of cosines where there are negatives.
        scores_of_row: (rows, p) scores of instances, for the layer INSTANCES.
    """

    layer: int = NOTHING
    tag: Any = FLOAT
    size: int = 4
    addresses: NDArray[np.int64] = np.empty(0, np.int64)
    shift: int = 0
    scales: NDArray[np.float32] = np.empty(0, np.float32)
    weight_of_row: NDArray[np.float32] = np.empty(0, np.float32)
    own_addresses: NDArray[np.int64] = np.empty(0, np.int64)
    own_shift: int = 0
    variance_ratio: np.float32 = np.float32(0)
    texts: NDArray[np.float32] = np.empty((0, 0), np.float32)
    prompts: int = 0
    logit_scale: float = 0.0
    scores_of_row: NDArray[np.float32] = np.empty((0, 0), np.float32)


class Table(NamedTuple):
    """What instances occupy of some voxels, and their scores.

    Attributes:
        part_of_row: (rows,) -1 everywhere before and after a scan.
        row_of_part: (m,) rows of the instances, m being enough for all that occupy one of the voxels.
        extents: (m, EXTENT_COLUMNS) what they occupy.
        sums: (m, p + 1) their voxels' scores in steps of 1 / SCORE_UNIT, and how many voxels have the layer.
    """

    part_of_row: NDArray[np.int32]
    row_of_part: NDArray[np.int32]
    extents: NDArray[np.int64]
    sums: NDArray[np.int64]


class Room(NamedTuple):
    """Room for the voxels that are kept.

    Attributes:
        centers_m: (n, 3) centres, metres.
        best: (n,) best scores.
        which: (n,) the first prompt that has the best score; (0,) where it is not needed.
    """

    centers_m: NDArray[np.float32]
    best: NDArray[np.float32]
    which: NDArray[np.int32]


@njit(**_OPTIONS)
def top_hypotheses(
    slots: NDArray[np.int64],
    held_row: NDArray[np.int32],
    held_count: NDArray[np.int32],
    id_of_row: NDArray[np.int64],
    top_row: NDArray[np.int32],
    top_count: NDArray[np.int32],
) -> None:
    """Write the row with the highest count (ties: the lowest id; -1 without one) and that count."""
    places = np.uint64(held_row.shape[1])
    rows, counts = held_row.reshape(-1), held_count.reshape(-1)
    for i in range(len(slots)):
        first = np.uint64(slots[i]) * places
        best_row, best_count = rows[first], counts[first]
        for k in range(first + np.uint64(1), first + places):
            row, count = rows[k], counts[k]  # An empty place has row -1 and count 0.
            if count == best_count and count > 0 and id_of_row[np.uint32(row)] < id_of_row[np.uint32(best_row)]:
                best_row = row
            best_row = row if count > best_count else best_row
            best_count = max(count, best_count)
        top_row[i], top_count[i] = best_row, best_count


@njit(inline="always")
def _coordinates(key: np.int64) -> tuple[np.int64, np.int64, np.int64]:
    return (key >> (2 * BITS)) - HALF, ((key >> BITS) & _MASK) - HALF, (key & _MASK) - HALF


@njit(**_OPTIONS)
def _add_extents(
    keys: NDArray[np.int64],
    top_row: NDArray[np.int32],
    top_count: NDArray[np.int32],
    part_of_row: NDArray[np.int32],
    row_of_part: NDArray[np.int32],
    extents: NDArray[np.int64],
    parts: int,
) -> int:
    """Add voxels to what their top hypotheses occupy; returns how many instances the table has then."""
    run = np.int32(-1)
    voxels = counts = x_sum = y_sum = z_sum = np.int64(0)
    x_low = y_low = z_low = _FAR
    x_high = y_high = z_high = -_FAR
    for i in range(len(keys) + 1):
        row = top_row[i] if i < len(keys) else np.int32(-1)
        if row != run:
            if run >= 0:
                part = part_of_row[np.uint32(run)]
                if part < 0:
                    part = np.int32(parts)
                    part_of_row[np.uint32(run)], row_of_part[parts] = part, run
                    extents[parts, :5], extents[parts, 5:8], extents[parts, 8:] = 0, _FAR, -_FAR
                    parts += 1
                part = np.uint32(part)
                extents[part, 0] += voxels
                extents[part, 1] += counts
                extents[part, 2] += x_sum
                extents[part, 3] += y_sum
                extents[part, 4] += z_sum
                extents[part, 5], extents[part, 8] = min(extents[part, 5], x_low), max(extents[part, 8], x_high)
                extents[part, 6], extents[part, 9] = min(extents[part, 6], y_low), max(extents[part, 9], y_high)
                extents[part, 7], extents[part, 10] = min(extents[part, 7], z_low), max(extents[part, 10], z_high)
            voxels = counts = x_sum = y_sum = z_sum = np.int64(0)
            x_low = y_low = z_low = _FAR
            x_high = y_high = z_high = -_FAR
            run = row
        if row >= 0:
            count = np.int64(top_count[i])
            x, y, z = _coordinates(keys[i])
            voxels += 1
            counts += count
            x_sum += count * x
            y_sum += count * y
            z_sum += count * z
            x_low, x_high = min(x_low, x), max(x_high, x)
            y_low, y_high = min(y_low, y), max(y_high, y)
            z_low, z_high = min(z_low, z), max(z_high, z)
    return parts


@njit(**_OPTIONS)
def _pick(layer: int, dense_rows: NDArray[np.int32], top_row: NDArray[np.int32], picked: NDArray[np.int32]) -> int:
    """Write which voxels have the layer; returns how many do."""
    with_dense, with_instance = layer != INSTANCES, layer != DENSE
    found = np.uint64(0)
    for i in range(len(top_row)):
        picked[found] = i
        found += np.uint64((with_dense and dense_rows[i] >= 0) or (with_instance and top_row[i] >= 0))
    return int(found)


@njit(**_OPTIONS)
def _against_negatives(cosines: NDArray[np.float32], prompts: int, logit_scale: float, scores: NDArray[np.float32]) -> None:
    """Write the relevancy (n, p) of each prompt against the strongest negative, from cosines with both."""
    for i in range(len(cosines)):
        negative = cosines[i, prompts]
        for p in range(prompts + 1, cosines.shape[1]):
            negative = max(negative, cosines[i, p])
        for p in range(prompts):
            margin = logit_scale * (np.float64(cosines[i, p]) - np.float64(negative))
            scores[i, p] = np.float32(0.5 * (1.0 + np.tanh(0.5 * margin)))


@njit(**_OPTIONS)
def _add_scores(
    scores: NDArray[np.float32],
    picked: NDArray[np.int32],
    top_row: NDArray[np.int32],
    part_of_row: NDArray[np.int32],
    sums: NDArray[np.int64],
) -> None:
    """Add voxels' scores to those of their top hypotheses, which are in the table; the last column counts voxels."""
    prompts = np.uint64(scores.shape[1])
    run, begin = np.int32(-1), 0
    for i in range(len(scores) + 1):
        row = top_row[picked[i]] if i < len(scores) else np.int32(-1)
        if row == run:
            continue
        if run >= 0:
            part = np.uint64(part_of_row[np.uint32(run)])
            sums[part, prompts] += i - begin
            for p in range(prompts):
                total = np.int64(0)
                for j in range(begin, i):
                    total += np.int64(scores[j, p] * _UNIT)
                sums[part, p] += total
        run, begin = row, i


@njit(**_OPTIONS)
def _keep(
    keys: NDArray[np.int64],
    voxel_size_m: float,
    picked: NDArray[np.int32],
    scores: NDArray[np.float32],
    threshold: float,
    centers_m: NDArray[np.float32],
    best: NDArray[np.float32],
    which: NDArray[np.int32],
) -> int:
    """Write centre, best score and its prompt of the voxels that reach a threshold; returns how many do."""
    kept = np.uint64(0)
    for i in range(len(scores)):
        score = scores[i, 0]
        for p in range(1, scores.shape[1]):
            score = max(score, scores[i, p])
        if score >= threshold:
            if len(which) > 0:
                prompt = 0
                while scores[i, prompt] < score:
                    prompt += 1
                which[kept] = prompt
            x, y, z = _coordinates(keys[picked[i]])
            centers_m[kept, 0] = np.float32((np.float64(x) + 0.5) * voxel_size_m)
            centers_m[kept, 1] = np.float32((np.float64(y) + 0.5) * voxel_size_m)
            centers_m[kept, 2] = np.float32((np.float64(z) + 0.5) * voxel_size_m)
            best[kept] = score
            kept += np.uint64(1)
    return int(kept)


@njit(**_OPTIONS)
def scan(voxels: Voxels, held: Held, asked: Asked, threshold: float, table: Table, room: Room) -> tuple[int, int, int]:
    """Scan consecutive slots.

    Args:
        voxels: The slots.
        held: Hypotheses of all slots.
        asked: What the voxels are compared with.
        threshold: Voxels that score less are not written; -inf for none.
        table: Written: what instances occupy of these voxels, and their scores.
        room: Written from the front: the voxels that are kept.

    Returns:
        How many instances were written, how many voxels have the layer, and how many of these were kept.
    """
    texts, prompts = asked.texts, asked.prompts
    step = max(min(_SLOTS, _COSINES // max(len(texts), prompts, 1)), _LEAST_SLOTS)
    parts = found = kept = 0
    for begin in range(0, len(voxels.keys), step):
        here, rows = voxels.keys[begin : begin + step], voxels.dense_rows[begin : begin + step]
        count = len(here)
        top_row, top_count = np.empty(count, np.int32), np.empty(count, np.int32)
        slots = np.arange(voxels.first + begin, voxels.first + begin + count)
        top_hypotheses(slots, held.rows, held.counts, held.id_of_row, top_row, top_count)
        before = parts
        parts = _add_extents(here, top_row, top_count, table.part_of_row, table.row_of_part, table.extents, parts)
        if asked.layer == NOTHING:
            continue
        table.sums[before:parts] = 0
        place = np.empty(count + 1, np.int32)
        picked = place[: _pick(asked.layer, rows, top_row, place)]
        scores = np.empty((len(picked), len(texts) if asked.layer != INSTANCES else prompts), np.float32)
        if asked.layer == INSTANCES:
            for i in range(len(picked)):
                for p in range(prompts):
                    scores[i, p] = asked.scores_of_row[np.uint32(top_row[picked[i]]), p]
        elif asked.layer == DENSE:
            cosines(asked.tag, asked.size, asked.addresses, asked.shift, rows[picked], texts, scores, 0, len(picked))
        else:
            pool = (asked.tag, asked.size, asked.addresses, asked.shift, asked.scales, asked.weight_of_row)
            own = (asked.own_addresses, asked.own_shift, asked.variance_ratio)
            fused_cosines(*pool, *own, picked, rows, top_row, top_count, texts, scores)
        if asked.layer != INSTANCES and prompts < len(texts):
            relevancy = np.empty((len(picked), prompts), np.float32)
            _against_negatives(scores, prompts, asked.logit_scale, relevancy)
            scores = relevancy
        _add_scores(scores, picked, top_row, table.part_of_row, table.sums)
        found += len(picked)
        rest = (room.centers_m[kept:], room.best[kept:], room.which[kept:])
        kept += _keep(here, voxels.voxel_size_m, picked, scores, threshold, *rest)
    for part in range(parts):
        table.part_of_row[table.row_of_part[part]] = -1
    return parts, found, kept


@njit(**_OPTIONS)
def add_parts(
    row_of_part: NDArray[np.int32],
    extents: NDArray[np.int64],
    sums: NDArray[np.int64],
    voxels: NDArray[np.int64],
    counts: NDArray[np.int64],
    weighted: NDArray[np.int64],
    low: NDArray[np.int64],
    high: NDArray[np.int64],
    members: NDArray[np.int64],
    totals: NDArray[np.int64],
) -> None:
    """Add extents and sums of some voxels to those of the whole map. The last two may be empty, for none."""
    for part in range(len(row_of_part)):
        row = row_of_part[part]
        voxels[row] += extents[part, 0]
        counts[row] += extents[part, 1]
        for axis in range(3):
            weighted[row, axis] += extents[part, 2 + axis]
            low[row, axis] = min(low[row, axis], extents[part, 5 + axis])
            high[row, axis] = max(high[row, axis], extents[part, 8 + axis])
        if len(members) > 0:
            for p in range(totals.shape[1]):
                totals[row, p] += sums[part, p]
            members[row] += sums[part, totals.shape[1]]
