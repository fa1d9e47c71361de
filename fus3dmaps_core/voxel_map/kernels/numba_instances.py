"""Compiled loops over proposals and hypotheses: association, counting, displacement and merging."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from fus3dmaps_core.voxel_map.kernels.compile_cache import njit
from fus3dmaps_core.voxel_map.kernels.protocols import MAX_COUNT

_OPTIONS: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy"}


@njit(**_OPTIONS)
def _best_match(
    proposal: int,
    slots: NDArray[np.int64],
    held_row: NDArray[np.int32],
    id_of_row: NDArray[np.int64],
    voxels_of_row: NDArray[np.int32],
    hidden_of_row: NDArray[np.int32],
    iou_threshold: float,
    seen_by: NDArray[np.int32],
    shared: NDArray[np.int32],
    candidates: NDArray[np.int32],
) -> int:
    """Find the row of the instance with the largest IoU above the threshold (ties: the lowest id), -1 without one."""
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
        union = len(slots) + voxels_of_row[row] - shared[row]
        if len(hidden_of_row):
            union -= hidden_of_row[row]
        iou = np.float64(shared[row]) / np.float64(union)
        if iou > best or (best_row >= 0 and iou == best and id_of_row[row] < id_of_row[best_row]):
            best_row, best = row, iou
    return best_row


@njit(**_OPTIONS)
def associate(
    offsets: NDArray[np.int64],
    slots: NDArray[np.int64],
    counts: NDArray[np.int64],
    spare_rows: NDArray[np.int64],
    next_id: int,
    iou_threshold: float,
    hidden_of_row: NDArray[np.int32],
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
        hidden_of_row: How many of an instance's voxels do not count in the IoU's union; empty where all count.
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
        known = (held_row, id_of_row, voxels_of_row, hidden_of_row)
        row = _best_match(proposal, own, *known, iou_threshold, seen_by, shared, candidates)
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


@njit(**_OPTIONS)
def holders(
    held_row: NDArray[np.int32], rows: NDArray[np.int64], is_wanted: NDArray[np.bool_], slots: NDArray[np.int64]
) -> int:
    """Find the slots that hold any of some instances.

    Args:
        held_row: (slots, K) rows of the hypotheses, -1 where empty.
        rows: (m,) rows of the instances.
        is_wanted: False everywhere; written: True for them.
        slots: Written: the slots, ascending.

    Returns:
        How many there are.
    """
    found = 0
    for row in rows:
        is_wanted[row] = True
    for slot in range(len(held_row) if len(rows) else 0):
        for k in range(held_row.shape[1]):
            row = held_row[slot, k]
            if row >= 0 and is_wanted[row]:
                slots[found] = slot
                found += 1
                break
    return found


@njit(**_OPTIONS)
def shared_voxels(
    held_row: NDArray[np.int32], rows: NDArray[np.int64], place_of_row: NDArray[np.int32], shared: NDArray[np.int64]
) -> None:
    """Count the voxels that each two of some instances share.

    Args:
        held_row: (slots, K) rows of the hypotheses, -1 where empty.
        rows: (m,) rows of the instances.
        place_of_row: -1 everywhere; written: place of each of them.
        shared: (m, m) zeros; written, on the diagonal how many voxels each has.
    """
    for place in range(len(rows)):
        place_of_row[rows[place]] = place
    places = held_row.shape[1]
    for slot in range(len(held_row)):
        for k in range(places):
            row = held_row[slot, k]
            place = place_of_row[row] if row >= 0 else -1
            if place < 0:
                continue
            shared[place, place] += 1
            for j in range(k):
                other_row = held_row[slot, j]
                other = place_of_row[other_row] if other_row >= 0 else -1
                if other >= 0:
                    shared[place, other] += 1
                    shared[other, place] += 1


@njit(**_OPTIONS)
def merge(
    slots: NDArray[np.int64],
    gone: NDArray[np.int64],
    into: NDArray[np.int64],
    target_of_row: NDArray[np.int32],
    held_row: NDArray[np.int32],
    held_count: NDArray[np.int32],
    id_of_row: NDArray[np.int64],
    voxels_of_row: NDArray[np.int32],
    observations_of_row: NDArray[np.int64],
    changed: NDArray[np.bool_],
) -> None:
    """Let instances take in others.

    Args:
        slots: Distinct slots, those that hold any of the instances that are taken in among them.
        gone: (n,) rows of the instances that are taken in.
        into: (n,) rows of those that take them in, none of them gone.
        target_of_row: -1 everywhere; written: where each row that is gone goes.
        held_row: (slots, K) rows of the hypotheses, -1 where empty; changed.
        held_count: (slots, K) their counts; changed.
        id_of_row: Ids; -1 for those that are gone.
        voxels_of_row: |V_id|; changed.
        observations_of_row: Sum of counts over V_id; changed.
        changed: Set for instances that took another in.
    """
    for i in range(len(gone)):
        target_of_row[gone[i]] = into[i]
        id_of_row[gone[i]] = -1
        voxels_of_row[gone[i]] = observations_of_row[gone[i]] = 0
        changed[into[i]] = True
    places = held_row.shape[1]
    for slot in slots:
        for k in range(places):
            row = held_row[slot, k]
            target = target_of_row[row] if row >= 0 else -1
            if target < 0:
                continue
            own = -1
            for j in range(places):
                if held_row[slot, j] == target:
                    own = j
            arrived = np.int64(held_count[slot, k])
            if own < 0:
                held_row[slot, k] = target
                voxels_of_row[target] += 1
                observations_of_row[target] += arrived
                continue
            before = np.int64(held_count[slot, own])
            after = min(before + arrived, np.int64(MAX_COUNT))
            held_count[slot, own] = after
            observations_of_row[target] += after - before
            held_row[slot, k] = -1
            held_count[slot, k] = 0
