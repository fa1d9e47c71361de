"""The voxel hash against a dictionary."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from fus3dmaps_core.errors import MapError
from fus3dmaps_core.voxels.hash import MAX_COORDINATE, VoxelHash, pack, unpack

CPU = torch.device("cpu")

_axis = st.one_of(
    st.integers(-3, 3),
    st.integers(-40, 40).map(lambda number: number * 20_000),
    st.sampled_from([-MAX_COORDINATE, MAX_COORDINATE, -1, 0]),
    st.integers(-MAX_COORDINATE, MAX_COORDINATE),
)
_coordinates = st.tuples(_axis, _axis, _axis)
_batches = st.lists(st.tuples(st.booleans(), st.lists(_coordinates, unique=True, max_size=40)), max_size=10)


def tensor(coordinates) -> torch.Tensor:
    return torch.tensor(np.asarray(coordinates, dtype=np.int64).reshape(-1, 3))


@given(_batches)
def test_finds_and_inserts_as_a_dictionary_does(batches):
    table, plain = VoxelHash(CPU), {}
    for insert, coordinates in batches:
        keys = pack(tensor(coordinates))
        if insert:
            got = table.find_or_insert(keys).tolist()
            for each in coordinates:
                plain.setdefault(each, len(plain))
        else:
            got = table.find(keys).tolist()
        assert got == [plain.get(each, -1) for each in coordinates]
        assert table.coordinates().tolist() == [list(each) for each in plain]
        assert unpack(table.keys()).tolist() == [list(each) for each in plain]
    slots = torch.arange(len(plain)).flip(0)
    assert table.coordinates(slots).tolist() == [list(each) for each in reversed(plain)]


@given(st.lists(_coordinates, max_size=50))
def test_finding_the_same_voxel_several_times_at_once(coordinates):
    table = VoxelHash(CPU)
    known = list(dict.fromkeys(coordinates))[::2]
    table.find_or_insert(pack(tensor(known)))
    got = table.find(pack(tensor(coordinates + coordinates))).tolist()
    assert got == [known.index(each) if each in known else -1 for each in coordinates + coordinates]


@given(st.lists(_coordinates, max_size=60))
def test_packing_is_one_to_one_and_never_negative(coordinates):
    keys = pack(tensor(coordinates))
    assert unpack(keys).tolist() == [list(each) for each in coordinates]
    assert len(set(keys.tolist())) == len(set(coordinates))
    assert (keys >= 0).all()


@settings(max_examples=5)
@given(st.integers(0, 2**32 - 1), st.sampled_from(["room", "corridor", "scattered"]))
def test_slots_stay_through_growth(seed: int, shape: str):
    """Tens of thousands of voxels in batches, as a solid room, a line of kilometres, or anywhere."""
    rng = np.random.default_rng(seed)
    low, high = {"room": (-16, 16), "corridor": (0, 1), "scattered": (-MAX_COORDINATE, MAX_COORDINATE)}[shape]
    coordinates = rng.integers(low, high, (30_000, 3))
    if shape == "corridor":
        coordinates[:, 0] = np.arange(-15_000, 15_000) * 16  # Steps of a power of two are hard on a poor hash.
    table, plain = VoxelHash(CPU), {}
    for batch in np.split(coordinates, [1, 5, 40, 3_000, 3_001, 20_000]):
        distinct = rng.permutation(np.unique(batch, axis=0))
        slots = table.find_or_insert(pack(tensor(distinct))).tolist()
        for each, slot in zip(map(tuple, distinct.tolist()), slots, strict=True):
            assert plain.setdefault(each, len(plain)) == slot
    everything = list(plain)
    assert table.find(pack(tensor(everything))).tolist() == list(range(len(everything)))
    absent = [(x, y, z + 2_000_000 // 3) for x, y, z in everything[:500] if abs(z) < 1_000]
    assert table.find(pack(tensor(absent))).tolist() == [plain.get(each, -1) for each in absent]
    np.testing.assert_array_equal(table.coordinates().numpy(), np.array(everything))


def test_an_empty_hash_and_empty_batches():
    table = VoxelHash(CPU)
    none = pack(tensor([]))
    assert table.find(none).tolist() == []
    assert table.find_or_insert(none).tolist() == []
    assert table.find(pack(tensor([(0, 0, 0)]))).tolist() == [-1]
    assert table.coordinates().shape == (0, 3)


def test_looking_for_a_voxel_does_not_add_it():
    table = VoxelHash(CPU)
    for _ in range(2):
        assert table.find(pack(tensor([(1, 2, 3)]))).tolist() == [-1]
    assert len(table.keys()) == 0


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("value", [MAX_COORDINATE + 1, -MAX_COORDINATE - 1, 2**40, -(2**62)])
def test_coordinates_beyond_the_grid_are_refused(axis: int, value: int):
    coordinates = np.zeros((2, 3), np.int64)
    coordinates[1, axis] = value
    with pytest.raises(MapError):
        pack(torch.tensor(coordinates))


def test_the_grid_is_at_least_fifty_kilometres_wide_either_way_at_five_centimetres():
    assert MAX_COORDINATE * 0.05 > 50_000
