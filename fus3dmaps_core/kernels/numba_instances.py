"""Compiled loops over proposals and hypotheses: association, counting and displacement.

Nothing here depends on another compiled module, for numba's cache notices changes of the file itself only.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from fus3dmaps_core.kernels.protocols import MAX_COUNT

_OPTIONS: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy"}


@njit(**_OPTIONS)
def _best_match(
    proposal: int,
    slots: NDArray[np.int64],
    held_row: NDArray[np.int32],
    id_of_row: NDArray[np.int64],
    voxels_of_row: NDArray[np.int32],
    iou_threshold: float,
    seen_by: NDArray[np.int32],
    shared: NDArray[np.int32],
    candidates: NDArray[np.int32],
) -> int:
    """Row of the instance with the largest IoU above the threshold (ties: the lowest id), -1 without one."""
    found = 0
    for slot in slots:
        for k in range(held_row.shape[1]):
            row = held_row[slot, k]
            if row < 0:
                continue
            if seen_by[row] != proposal:
                seen_by[row] = proposal
                shared[row] = 0
                candidates[found] = row
                found += 1
            shared[row] += 1
    best_row, best = -1, iou_threshold
    for row in candidates[:found]:
        # Correctly rounded float64 quotients: equal ratios compare equal, and 1/5 is not above 0.2.
        iou = np.float64(shared[row]) / np.float64(len(slots) + voxels_of_row[row] - shared[row])
        if iou > best or (best_row >= 0 and iou == best and id_of_row[row] < id_of_row[best_row]):
            best_row, best = row, iou
    return best_row


@njit(**_OPTIONS)
def integrate(
    offsets: NDArray[np.int64],
    slots: NDArray[np.int64],
    counts: NDArray[np.int64],
    spare_rows: NDArray[np.int64],
    next_id: int,
    iou_threshold: float,
    held_row: NDArray[np.int32],
    held_count: NDArray[np.int32],
    id_of_row: NDArray[np.int64],
    voxels_of_row: NDArray[np.int32],
    observations_of_row: NDArray[np.int64],
    changed: NDArray[np.bool_],
    matched: NDArray[np.int64],
    ids: NDArray[np.int64],
    dead: NDArray[np.int64],
) -> tuple[int, int]:
    """Associate proposals in order and count them, each against the map as the previous one left it.

    Args:
        offsets: (m + 1,) where each proposal begins in the next two.
        slots: Distinct slots of each proposal.
        counts: N_i, its points in each of them.
        spare_rows: (m,) rows for new instances, taken from the front.
        next_id: Id of the next new instance.
        iou_threshold: An IoU must be larger than this to match.
        held_row: (slots, K) rows of the hypotheses, -1 where empty; changed.
        held_count: (slots, K) their counts; changed.
        id_of_row: Ids; written for new instances, -1 for those that died.
        voxels_of_row: |V_id|; changed.
        observations_of_row: Sum of counts over V_id; changed.
        changed: Set for instances whose voxels or counts changed.
        matched: (m,) written: row of each proposal's instance, -1 for one without points.
        ids: (m,) written: its id.
        dead: Written: rows of the instances that lost their last voxel.

    Returns:
        How many instances were made and how many died.
    """
    created, died = 0, 0
    seen_by = np.full(len(id_of_row), -1, np.int32)
    shared = np.empty(len(id_of_row), np.int32)
    candidates = np.empty(len(id_of_row), np.int32)
    places = held_row.shape[1]
    for proposal in range(len(matched)):
        own = slots[offsets[proposal] : offsets[proposal + 1]]
        if len(own) == 0:
            matched[proposal] = ids[proposal] = -1
            continue
        row = _best_match(proposal, own, held_row, id_of_row, voxels_of_row, iou_threshold, seen_by, shared, candidates)
        if row < 0:
            row = spare_rows[created]
            id_of_row[row] = next_id + created
            created += 1
        matched[proposal], ids[proposal] = row, id_of_row[row]
        changed[row] = True
        first_dead = died
        for i in range(len(own)):
            slot, points = own[i], counts[offsets[proposal] + i]
            chosen, chosen_rank = 0, 3
            for k in range(places):
                # The instance's own place first, then an empty one, then the lowest count, then the oldest id.
                rank = 0 if held_row[slot, k] == row else 1 if held_row[slot, k] < 0 else 2
                weaker = (
                    rank == 2
                    and chosen_rank == 2
                    and (
                        held_count[slot, k] < held_count[slot, chosen]
                        or (
                            held_count[slot, k] == held_count[slot, chosen]
                            and id_of_row[held_row[slot, k]] < id_of_row[held_row[slot, chosen]]
                        )
                    )
                )
                if rank < chosen_rank or weaker:
                    chosen, chosen_rank = k, rank
            before = np.int64(held_count[slot, chosen]) if chosen_rank == 0 else np.int64(0)
            if chosen_rank == 2:
                loser = held_row[slot, chosen]
                voxels_of_row[loser] -= 1
                observations_of_row[loser] -= held_count[slot, chosen]
                changed[loser] = True
                if voxels_of_row[loser] == 0:
                    dead[died] = loser
                    died += 1
            after = min(before + points, np.int64(MAX_COUNT))
            held_row[slot, chosen] = row
            held_count[slot, chosen] = after
            observations_of_row[row] += after - before
            if chosen_rank != 0:
                voxels_of_row[row] += 1
        for i in range(first_dead, died):
            id_of_row[dead[i]] = -1
    return created, died
