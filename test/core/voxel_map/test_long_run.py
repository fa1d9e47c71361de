"""Millions of insertions and deletions: no index is ever in use twice, and memory follows what is alive."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from reference.agreement import assert_same_map, engine_of, reference_of
from reference.steps import Setting, dense_step, proposal_step
from reference.variants import BACKEND_IDS, BACKENDS, DTYPES, kernels_of

from fus3dmaps_core.voxel_map.kernels.keys import pack
from fus3dmaps_core.voxel_map.rows.row_pool import RowPool
from fus3dmaps_core.voxel_map.voxel_hash import VoxelHash

MOST_ALIVE = 40_000


def turns_of(backend: str) -> int:
    """Batches of some twenty thousand: four million insertions and as many deletions in compiled loops."""
    return 200 if backend == "compiled" else 40


@pytest.mark.parametrize(("backend", "device"), BACKENDS, ids=BACKEND_IDS)
def test_slots_of_the_hash_under_churn(backend: str, device: str):
    rng = np.random.default_rng(1)
    where = torch.device(device)
    table = VoxelHash(kernels_of(backend, device), where)
    # Voxels are numbered; the reference is an array from number to slot, and one from slot to number.
    side = 64
    numbers = np.arange(side**3)
    keys = pack(torch.tensor(np.stack([numbers // side**2, numbers // side % side, numbers % side], 1) * 1000 - 17)).to(
        where
    )
    slot_of, number_in = np.full(len(numbers), -1), np.full(MOST_ALIVE, -1)
    inserted = removed = 0
    sizes: set[int] = set()
    for turn in range(turns_of(backend)):
        room = MOST_ALIVE - np.count_nonzero(slot_of >= 0)
        asked = rng.permutation(len(numbers))[: int(rng.integers(room // 2, room + 1))]
        slots = table.find_or_insert(keys[torch.tensor(asked, device=where)]).cpu().numpy()
        known = slot_of[asked] >= 0
        np.testing.assert_array_equal(slots[known], slot_of[asked[known]])
        fresh, taken = asked[~known], slots[~known]
        assert len(np.unique(taken)) == len(taken)
        assert taken.max(initial=0) < MOST_ALIVE, "slots go beyond the most that were alive"
        assert (number_in[taken] == -1).all(), "a slot in use was given again"
        slot_of[fresh], number_in[taken] = taken, fresh
        inserted += len(fresh)

        np.testing.assert_array_equal(table.find(keys).cpu().numpy(), slot_of)
        alive = np.flatnonzero(slot_of >= 0)
        gone = rng.permutation(alive)[: int(rng.integers(len(alive) // 4, len(alive) + 1))]
        table.remove(torch.tensor(slot_of[gone], device=where))
        number_in[slot_of[gone]] = -1
        slot_of[gone] = -1
        removed += len(gone)
        assert len(table) == np.count_nonzero(slot_of >= 0)
        if turn >= turns_of(backend) // 2:
            sizes.add(table.nbytes)
    np.testing.assert_array_equal(table.find(keys).cpu().numpy(), slot_of)
    np.testing.assert_array_equal(table.live().cpu().numpy(), np.flatnonzero(number_in >= 0))
    assert min(inserted, removed) > 15_000 * turns_of(backend)
    assert table.high_water <= MOST_ALIVE
    assert len(sizes) == 1, "memory grows with churn"
    # Cells of 12 bytes at a load of a quarter or more, keys and free slots of 12 bytes, each with room to double.
    assert sizes.pop() < MOST_ALIVE * 2 * (4 * 12 + 12)


@pytest.mark.parametrize("dtype", DTYPES)
def test_rows_of_a_pool_under_churn(dtype: str):
    rng = np.random.default_rng(2)
    pool = RowPool(2, getattr(torch, dtype), torch.device("cpu"))
    owner, mark = np.full(MOST_ALIVE, -1), 0
    allocated, sizes = 0, set()
    for turn in range(100):
        room = MOST_ALIVE - np.count_nonzero(owner >= 0)
        rows = pool.allocate(int(rng.integers(room // 2, room + 1)))
        taken = rows.numpy()
        assert len(np.unique(taken)) == len(taken)
        assert taken.max(initial=0) < MOST_ALIVE
        assert (owner[taken] == -1).all(), "a row in use was given again"
        owner[taken] = np.arange(mark, mark + len(taken)) % 100
        mark += len(taken)
        # A hundredth of the owner's number and one: the largest value of a row is stored exactly.
        values = torch.tensor(np.stack([np.ones(len(taken)), owner[taken] / 128.0], 1), dtype=torch.float32)
        pool.write(rows, values, rows)
        allocated += len(taken)
        alive = np.flatnonzero(owner >= 0)
        read = pool.read(torch.tensor(alive)).numpy()
        np.testing.assert_allclose(read[:, 1], owner[alive] / 128.0, atol=1 / 112)
        gone = rng.permutation(alive)[: int(rng.integers(len(alive) // 4, len(alive) + 1))]
        pool.free(torch.tensor(gone))
        owner[gone] = -1
        assert len(pool) == len(alive) - len(gone)
        if turn >= 50:
            sizes.add(pool.nbytes)
    assert allocated > 1_500_000
    assert pool.high_water <= MOST_ALIVE
    assert len(sizes) == 1


class Corridor:
    """A map of few hypotheses through which objects come and go: what is made in front is removed behind."""

    def __init__(self, backend: str, device: str) -> None:
        self.setting = Setting(max_hypotheses=1, dimension=2, dtype="float16", backend=backend, device=device)
        self.engine = engine_of(self.setting)
        self._rng = np.random.default_rng(3)
        self._at = 0

    def go(self, objects: int, voxels: int) -> np.ndarray:
        """Show new objects side by side, remove those of the turn before; returns the new ids."""
        x = np.arange(self._at, self._at + voxels)
        cells = np.stack(np.broadcast_arrays(x[None], np.arange(objects)[:, None], 0), axis=2).reshape(-1, 3)
        points_m = (cells + 0.5) * self.setting.voxel_size_m
        behind_m = points_m - [voxels * self.setting.voxel_size_m, 0, 0]
        self._at += voxels
        embeddings = self._rng.normal(size=(objects, 2))
        patches = np.repeat(np.arange(objects), voxels)
        self.engine.integrate_dense(points_m, patches, embeddings, np.ones(objects), np.zeros((len(cells), 3), np.uint8))
        ids = self.engine.integrate_proposals(points_m, patches, embeddings)
        self.engine.remove_voxels(behind_m)
        return ids


@pytest.mark.parametrize(("backend", "device"), BACKENDS, ids=BACKEND_IDS)
def test_a_map_through_which_objects_come_and_go(backend: str, device: str):
    corridor = Corridor(backend, device)
    turns, objects, voxels = (250, 400, 20) if backend == "compiled" else (20, 100, 20)
    given, sizes = 0, set()
    for turn in range(turns):
        ids = corridor.go(objects, voxels)
        assert ids.tolist() == list(range(given, given + objects)), "an id was given twice"
        given += objects
        assert corridor.engine.instance_count == objects
        assert corridor.engine.voxel_count == corridor.engine.dense_voxel_count == objects * voxels
        if turn % 10 == 0:
            corridor.engine.fuse()
        if turn >= 2:
            sizes.add(sum(corridor.engine.nbytes().values()))
    assert len(sizes) == 1, "memory grows with churn"
    corridor.engine.fuse()
    state = corridor.engine.export_state()
    assert state["instance_id"].tolist() == list(range(given - objects, given))
    assert int(state["next_instance_id"]) == given
    assert sorted(set(state["hypothesis_id"].ravel().tolist())) == state["instance_id"].tolist()
    # Each object was seen once by either layer, in as many voxels, by the same embedding.
    assert state["hypothesis_count"].tolist() == [[1]] * (objects * voxels)
    assert state["dense_weight"].tolist() == [1.0] * (objects * voxels)
    assert state["instance_weight"].tolist() == [float(voxels)] * objects
    assert state["fused_evidence"].tolist() == [2.0 * voxels] * objects
    np.testing.assert_allclose(state["fused_embedding"], state["instance_embedding"], atol=2.0**-11)
    lengths = np.linalg.norm(state["instance_embedding"], axis=1)
    np.testing.assert_allclose(lengths, 1.0, atol=1e-6)


@pytest.mark.parametrize(("backend", "device"), BACKENDS, ids=BACKEND_IDS)
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("window_radius_m", [0.0, 50.0])
def test_nothing_of_what_was_removed_shows_through(dtype: str, backend: str, device: str, window_radius_m: float):
    setting = Setting(dimension=4, dtype=dtype, backend=backend, device=device, window_radius_m=window_radius_m)
    engine, reference = engine_of(setting), reference_of(setting)
    rng = np.random.default_rng(9)
    old = [(x, y, 0) for x in range(20) for y in range(10)]
    for each in (engine, reference):
        rng = np.random.default_rng(9)
        dense_step(old * 3, setting, rng, weightless=False).apply(each)
        proposal_step([old[:70], old[70:150], old[150:]], setting, rng).apply(each)
        each.fuse()
    everything_m = (np.array(old) + 0.5) * setting.voxel_size_m
    assert engine.remove_voxels(everything_m) == reference.remove_voxels(everything_m) == 200
    assert (engine.voxel_count, engine.dense_voxel_count, engine.instance_count) == (0, 0, 0)
    before = engine.nbytes()

    # As many voxels elsewhere, in the slots and rows of the old ones: some seen by one layer only.
    new = [(x, y, 5) for x in range(20) for y in range(10)]
    proposal_step([new[:90]], setting, np.random.default_rng(4)).apply(engine)
    proposal_step([new[:90]], setting, np.random.default_rng(4)).apply(reference)
    state = engine.export_state()
    assert (state["voxel_colors"] == 128).all()
    assert len(state["dense_slot"]) == 0
    assert state["instance_id"].tolist() == [3]
    assert state["fused_evidence"].tolist() == [0.0]
    np.testing.assert_array_equal(state["fused_embedding"], state["instance_embedding"])
    dense_step(new[80:], setting, np.random.default_rng(5), weightless=False).apply(engine)
    dense_step(new[80:], setting, np.random.default_rng(5), weightless=False).apply(reference)
    assert_same_map(engine, reference, setting)
    engine.fuse()
    reference.fuse()
    assert_same_map(engine, reference, setting)
    assert engine.nbytes() == before
