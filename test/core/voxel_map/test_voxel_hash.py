"""The voxel hash against a dictionary."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from reference.variants import BACKEND_IDS, BACKENDS, kernels_of

from fus3dmaps_core.errors import MapError
from fus3dmaps_core.voxel_map.kernels.keys import MAX_COORDINATE, pack
from fus3dmaps_core.voxel_map.kernels.protocols import EMPTY
from fus3dmaps_core.voxel_map.rows import number_pool as numbers
from fus3dmaps_core.voxel_map.voxel_hash import VoxelHash

_axis = st.one_of(
    st.integers(-3, 3),
    st.integers(-40, 40).map(lambda number: number * 20_000),
    st.sampled_from([-MAX_COORDINATE, MAX_COORDINATE, -1, 0]),
    st.integers(-MAX_COORDINATE, MAX_COORDINATE),
)
_coordinates = st.tuples(_axis, _axis, _axis)
_near = st.tuples(st.integers(-2, 1), st.integers(-2, 1), st.integers(-1, 0))  # Few, so that they come again.
_batches = st.lists(
    st.tuples(
        st.sampled_from(["insert", "insert", "find", "remove"]),
        st.lists(st.one_of(_coordinates, _near), unique=True, max_size=40),
    ),
    max_size=12,
)


@pytest.fixture(scope="module", params=BACKENDS, ids=BACKEND_IDS)
def new_hash(request):
    """Makes an empty hash on each of the backends, and tensors of coordinates beside it."""
    backend, device = request.param

    def make() -> tuple[VoxelHash, torch.device]:
        return VoxelHash(kernels_of(backend, device), torch.device(device)), torch.device(device)

    return make


def keys_of(coordinates, device: torch.device) -> torch.Tensor:
    return pack(torch.tensor(np.asarray(coordinates, dtype=np.int64).reshape(-1, 3))).to(device)


class PlainHash:
    """What slots a hash should give: those given up last first, then new ones."""

    def __init__(self) -> None:
        self.slots: dict[tuple[int, ...], int] = {}
        self.free: list[int] = []
        self.high = 0

    def insert(self, coordinates) -> None:
        missing = [each for each in coordinates if each not in self.slots]
        reused = self.free[max(0, len(self.free) - len(missing)) :]
        del self.free[len(self.free) - len(reused) :]
        fresh = list(range(self.high, self.high + len(missing) - len(reused)))
        self.high += len(fresh)
        self.slots.update(zip(missing, reused + fresh, strict=True))

    def remove(self, coordinates) -> None:
        self.free += [self.slots.pop(each) for each in coordinates]


def test_finds_inserts_and_removes_as_a_dictionary_does(new_hash):
    @given(_batches)
    def check(batches):
        table, device = new_hash()
        plain = PlainHash()
        for action, coordinates in batches:
            if action == "remove":
                coordinates = [each for each in coordinates if each in plain.slots]
                table.remove(table.find(keys_of(coordinates, device)))
                plain.remove(coordinates)
                got = table.find(keys_of(coordinates, device)).tolist()
            elif action == "insert":
                got = table.find_or_insert(keys_of(coordinates, device)).tolist()
                plain.insert(coordinates)
            else:
                got = table.find(keys_of(coordinates, device)).tolist()
            assert got == [plain.slots.get(each, -1) for each in coordinates]
            assert len(table) == len(plain.slots)
            assert table.high_water == plain.high
            by_slot = sorted((slot, list(each)) for each, slot in plain.slots.items())
            live = table.live()
            assert live.tolist() == [slot for slot, _ in by_slot]
            assert table.coordinates(live).tolist() == [each for _, each in by_slot]
            assert (table.keys(torch.tensor(plain.free, dtype=torch.int64, device=device)) == EMPTY).all()

    check()


def test_finding_the_same_voxel_several_times_at_once(new_hash):
    @given(st.lists(_coordinates, max_size=50))
    def check(coordinates):
        table, device = new_hash()
        known = list(dict.fromkeys(coordinates))[::2]
        table.find_or_insert(keys_of(known, device))
        got = table.find(keys_of(coordinates + coordinates, device)).tolist()
        assert got == [known.index(each) if each in known else -1 for each in coordinates + coordinates]

    check()


def test_slots_stay_through_growth(new_hash):
    """Tens of thousands of voxels in batches, as a solid room, a line of kilometres, or anywhere."""

    @settings(max_examples=5)
    @given(st.integers(0, 2**32 - 1), st.sampled_from(["room", "corridor", "scattered"]))
    def check(seed: int, shape: str):
        rng = np.random.default_rng(seed)
        low, high = {"room": (-16, 16), "corridor": (0, 1), "scattered": (-MAX_COORDINATE, MAX_COORDINATE)}[shape]
        coordinates = rng.integers(low, high, (30_000, 3))
        if shape == "corridor":
            coordinates[:, 0] = np.arange(-15_000, 15_000) * 16  # Steps of a power of two are hard on a poor hash.
        table, device = new_hash()
        plain: dict[tuple[int, ...], int] = {}
        for batch in np.split(coordinates, [1, 5, 40, 3_000, 3_001, 20_000]):
            distinct = rng.permutation(np.unique(batch, axis=0))
            slots = table.find_or_insert(keys_of(distinct, device)).tolist()
            for each, slot in zip(map(tuple, distinct.tolist()), slots, strict=True):
                assert plain.setdefault(each, len(plain)) == slot
        everything = list(plain)
        assert table.find(keys_of(everything, device)).tolist() == list(range(len(everything)))
        absent = [(x, y, z + 2_000_000 // 3) for x, y, z in everything[:500] if abs(z) < 1_000]
        assert table.find(keys_of(absent, device)).tolist() == [plain.get(each, -1) for each in absent]
        np.testing.assert_array_equal(table.coordinates(table.live()).cpu().numpy(), np.array(everything))

    check()


def test_an_empty_hash_and_empty_batches(new_hash):
    table, device = new_hash()
    none = keys_of([], device)
    assert table.find(none).tolist() == []
    assert table.find_or_insert(none).tolist() == []
    table.remove(none)
    assert table.find(keys_of([(0, 0, 0)], device)).tolist() == [-1]
    assert table.coordinates(table.live()).shape == (0, 3)
    assert (len(table), table.high_water) == (0, 0)


def test_looking_for_a_voxel_does_not_add_it(new_hash):
    table, device = new_hash()
    for _ in range(2):
        assert table.find(keys_of([(1, 2, 3)], device)).tolist() == [-1]
    assert len(table) == 0


def test_more_voxels_than_slots_are_refused_before_anything_is_touched(new_hash, monkeypatch):
    monkeypatch.setattr(numbers, "_LIMIT", 5)
    table, device = new_hash()
    known = keys_of([(x, 0, 0) for x in range(4)], device)
    slots = table.find_or_insert(known)
    more = keys_of([(x, 0, 0) for x in range(2, 6)], device)
    with pytest.raises(MapError, match="4 voxels"):
        table.find_or_insert(more)
    assert (len(table), table.high_water) == (4, 4)
    assert table.find(more).tolist() == [2, 3, -1, -1]
    table.remove(slots[:1])
    assert table.find_or_insert(more).tolist() == [2, 3, 0, 4]


def test_what_fits_after_removals_is_not_refused(new_hash, monkeypatch):
    monkeypatch.setattr(numbers, "_LIMIT", 3)
    table, device = new_hash()
    for x in range(20):
        slots = table.find_or_insert(keys_of([(x, 0, 0), (x, 1, 0), (x, 2, 0)], device))
        assert sorted(slots.tolist()) == [0, 1, 2]
        table.remove(slots)
