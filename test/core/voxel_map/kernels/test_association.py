"""Association, hypotheses and merging, on every backend, against dictionaries."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from reference.columns import columns
from reference.variants import BACKEND_IDS, BACKENDS, kernels_of

from fus3dmaps_core.voxel_map.kernels.protocols import GroupedCounts

_seeds = st.integers(0, 2**32 - 1)
MAX_COUNT = 2**31 - 1


@pytest.fixture(scope="module", params=BACKENDS, ids=BACKEND_IDS)
def backend(request):
    """Kernels and their device."""
    return kernels_of(*request.param), torch.device(request.param[1])


class PlainAssociation:
    """The method's association in dictionaries of ids."""

    def __init__(self, held: list[dict[int, int]], places: int, next_id: int, threshold: float, visible: set[int]) -> None:
        self.held, self.places, self.next_id, self.threshold = held, places, next_id, threshold
        self.visible = visible
        self.changed: set[int] = set()

    def take(self, hits: dict[int, int]) -> int:
        overlap = {}
        for each in {each for slot in hits for each in self.held[slot]}:
            members = {slot for slot, of_voxel in enumerate(self.held) if each in of_voxel}
            overlap[each] = len(members & hits.keys()) / len(members & self.visible | hits.keys())
        best = max(overlap.values(), default=0.0)
        if best > self.threshold:
            matched = min(each for each, value in overlap.items() if value == best)
        else:
            matched, self.next_id = self.next_id, self.next_id + 1
        self.changed.add(matched)
        for slot, points in hits.items():
            of_voxel = self.held[slot]
            if matched not in of_voxel and len(of_voxel) == self.places:
                loser = min(of_voxel, key=lambda each: (of_voxel[each], each))
                self.changed.add(loser)
                del of_voxel[loser]
            of_voxel[matched] = min(of_voxel.get(matched, 0) + points, MAX_COUNT)
        return matched


def test_proposals_are_associated_counted_and_displace_as_in_dictionaries(backend):
    kernels, device = backend

    @settings(max_examples=120)
    @given(_seeds, st.integers(1, 4), st.sampled_from([0.0, 0.2, 0.5]), st.integers(1, 14), st.integers(0, 6), st.booleans())
    def check(seed, places, threshold, slots, proposals, all_count):
        rng = np.random.default_rng(seed)
        # Rows of instances in an order that is not that of their ids, with rows of none between them.
        ids = rng.choice(40, 6, replace=False).tolist()
        by_id = [
            {
                int(each): int(rng.choice([1, 2, 3, MAX_COUNT - 1]))
                for each in rng.permutation(ids)[: rng.integers(0, places + 1)]
            }
            for _ in range(slots)
        ]
        alive = {each for of_voxel in by_id for each in of_voxel}
        row_of_id = dict(
            zip(sorted(alive, key=lambda each: each * 7 % 11), rng.permutation(20)[: len(alive)].tolist(), strict=True)
        )
        id_of_row = [next((each for each, row in row_of_id.items() if row == number), -1) for number in range(20)]
        held = columns(
            [{row_of_id[each]: count for each, count in of_voxel.items()} for of_voxel in by_id],
            places,
            id_of_row,
            device,
            rng,
        )
        hits = [
            {int(slot): int(rng.integers(1, 4)) for slot in rng.permutation(slots)[: rng.integers(0, slots + 1)]}
            for _ in range(proposals)
        ]
        groups = GroupedCounts(
            *(
                torch.tensor(np.array(each, np.int64), device=device)
                for each in (
                    np.cumsum([0, *map(len, hits)]),
                    [slot for each in hits for slot in each],
                    [count for each in hits for count in each.values()],
                )
            )
        )
        spare = [row for row in range(20) if id_of_row[row] < 0][:proposals]
        visible = {slot for slot in range(slots) if all_count or rng.random() < 0.3}
        visible |= {slot for each in hits for slot in each}
        hidden = [
            sum(each in of_voxel for slot, of_voxel in enumerate(by_id) if slot not in visible) if each >= 0 else 0
            for each in id_of_row
        ]
        rule = (threshold,) if all_count else (threshold, torch.tensor(hidden, dtype=torch.int32, device=device))
        outcome = kernels.associate(held, groups, torch.tensor(spare, dtype=torch.int64, device=device), 100, *rule)

        plain = PlainAssociation([dict(of_voxel) for of_voxel in by_id], places, 100, threshold, visible)
        expected = [plain.take(each) if each else -1 for each in hits]
        assert outcome.ids.tolist() == expected
        assert outcome.created == plain.next_id - 100
        born = {100 + number: spare[number] for number in range(outcome.created)}
        row_of_id |= born
        assert outcome.rows.tolist() == [row_of_id.get(each, -1) for each in expected]
        left = {each for of_voxel in plain.held for each in of_voxel}
        died = (alive | born.keys()) - left
        assert sorted(outcome.dead.tolist()) == sorted(row_of_id[each] for each in died)

        rows, counts = held.held_row.tolist(), held.held_count.tolist()
        id_now = held.id_of_row.tolist()
        for slot, of_voxel in enumerate(plain.held):
            got = {id_now[row]: count for row, count in zip(rows[slot], counts[slot], strict=True) if row >= 0}
            assert got == of_voxel
            assert sum(row >= 0 for row in rows[slot]) == len(of_voxel)
        assert {row: each for row, each in enumerate(id_now) if each >= 0} == {row_of_id[each]: each for each in left}
        for each in left:
            members = [of_voxel[each] for of_voxel in plain.held if each in of_voxel]
            assert held.voxels_of_row[row_of_id[each]] == len(members)
            assert held.observations_of_row[row_of_id[each]] == sum(members)
        changed = {row for row, flag in enumerate(held.changed.tolist()) if flag}
        assert {id_now[row] for row in changed if id_now[row] >= 0} == plain.changed & left

    check()


def some_voxels(seed: int, places: int, slots: int) -> tuple[list[dict[int, int]], np.random.Generator]:
    """Voxels that hold some of twelve rows, each by a small or by the largest count."""
    rng = np.random.default_rng(seed)
    rows = [rng.permutation(12)[: rng.integers(0, places + 1)].tolist() for _ in range(slots)]
    return [{row: int(rng.choice([1, 2, 5, MAX_COUNT])) for row in each} for each in rows], rng


def test_voxels_of_instances_are_found_and_the_shared_ones_are_those_that_hold_both(backend):
    kernels, device = backend

    @settings(max_examples=60)
    @given(_seeds, st.integers(1, 4), st.integers(0, 20), st.integers(0, 12))
    def check(seed, places, slots, count):
        voxels, rng = some_voxels(seed, places, slots)
        held = columns(voxels, places, list(range(12)), device, rng)
        rows = rng.permutation(12)[:count]
        shared = kernels.shared_voxels(held.held_row, torch.tensor(rows, device=device), 12)
        assert shared.dtype == torch.int64
        assert shared.shape == (count, count)
        expected = [[sum(a in each and b in each for each in voxels) for b in rows] for a in rows]
        assert shared.tolist() == expected
        holding = kernels.holders(held.held_row, torch.tensor(rows, device=device), 12)
        assert holding.dtype == torch.int64
        assert holding.tolist() == [slot for slot, each in enumerate(voxels) if not each.keys().isdisjoint(rows)]

    check()


def test_merging_adds_counts_and_renames_hypotheses_as_in_dictionaries(backend):
    kernels, device = backend

    @settings(max_examples=100)
    @given(_seeds, st.integers(1, 4), st.integers(1, 20), st.integers(0, 4))
    def check(seed, places, slots, merges):
        voxels, rng = some_voxels(seed, places, slots)
        ids = rng.permutation(40)[:12].tolist()
        held = columns(voxels, places, ids, device, rng)
        order = rng.permutation(12)
        gone, into = order[:merges], rng.choice(order[merges : merges + 3], merges)
        touched = {slot for slot, each in enumerate(voxels) if not each.keys().isdisjoint(gone)}
        given = rng.permutation([slot for slot in range(slots) if slot in touched or rng.random() < 0.5]).astype(np.int64)
        kernels.merge(held, *(torch.tensor(each, device=device) for each in (given, gone, into)))

        target = dict(zip(gone.tolist(), into.tolist(), strict=True))
        expected: list[dict[int, int]] = []
        for of_voxel in voxels:
            merged: dict[int, int] = {}
            for row, count in of_voxel.items():
                kept = target.get(row, row)
                merged[kept] = min(merged.get(kept, 0) + count, MAX_COUNT)
            expected.append(merged)
        for of_voxel, rows, counts in zip(expected, held.held_row.tolist(), held.held_count.tolist(), strict=True):
            assert {row: count for row, count in zip(rows, counts, strict=True) if row >= 0} == of_voxel
            assert sum(row >= 0 for row in rows) == len(of_voxel)
            assert all(count == 0 for row, count in zip(rows, counts, strict=True) if row < 0)
        assert held.id_of_row.tolist() == [-1 if row in target else ids[row] for row in range(12)]
        found = [[each[row] for each in expected if row in each] for row in range(12)]
        assert held.voxels_of_row.tolist() == [len(each) for each in found]
        assert held.observations_of_row.tolist() == [sum(each) for each in found]
        assert {row for row, flag in enumerate(held.changed.tolist()) if flag} == set(target.values())

    check()


def test_the_top_hypothesis_has_the_highest_count_and_of_equal_ones_the_lowest_id(backend):
    kernels, device = backend

    @settings(max_examples=60)
    @given(_seeds, st.integers(1, 4), st.integers(1, 12))
    def check(seed, places, slots):
        rng = np.random.default_rng(seed)
        id_of_row = rng.permutation([-1, 0, 3, 8, 2**31 - 2]).tolist()
        usable = [row for row in range(5) if id_of_row[row] >= 0]
        counts = [1, 1, 2, MAX_COUNT, MAX_COUNT]
        voxels = [
            {int(row): int(rng.choice(counts)) for row in rng.permutation(usable)[: rng.integers(0, places + 1)]}
            for _ in range(slots)
        ]
        held = columns(voxels, places, id_of_row, device, rng)
        asked = rng.integers(0, slots, 2 * slots)
        rows, found = kernels.top_hypotheses(held, torch.tensor(asked, device=device))
        best = [
            min(voxels[slot].items(), key=lambda pair: (-pair[1], id_of_row[pair[0]]), default=(-1, 0)) for slot in asked
        ]
        assert rows.dtype == found.dtype == torch.int64
        assert list(zip(rows.tolist(), found.tolist(), strict=True)) == best

    check()


def test_without_any_instance_no_voxel_has_a_top_hypothesis(backend):
    kernels, device = backend
    held = columns([{}, {}, {}], 3, [], device, np.random.default_rng(0))
    rows, counts = kernels.top_hypotheses(held, torch.tensor([2, 0], device=device))
    assert (rows.tolist(), counts.tolist()) == ([-1, -1], [0, 0])
