"""Loops over points and keys, on every backend, against Python's own integers and dictionaries."""

from __future__ import annotations

import math
from collections import Counter

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from reference.variants import BACKEND_IDS, BACKENDS, kernels_of

from fus3dmaps_core.voxel_map.kernels.keys import MAX_COORDINATE, pack, unpack
from fus3dmaps_core.voxel_map.kernels.protocols import DELETED, EMPTY, HashTable

SIZES_M = (0.05, 0.07, 0.25, 0.5)

_coordinate = st.one_of(
    st.integers(-3, 3),
    st.integers(-MAX_COORDINATE, MAX_COORDINATE),
    st.sampled_from([-MAX_COORDINATE, MAX_COORDINATE]),
)
_coordinates = st.lists(st.tuples(_coordinate, _coordinate, _coordinate), max_size=40)


@pytest.fixture(scope="module", params=BACKENDS, ids=BACKEND_IDS)
def backend(request):
    """Kernels and their device."""
    return kernels_of(*request.param), torch.device(request.param[1])


def integers(values, device: torch.device) -> torch.Tensor:
    return torch.tensor(np.asarray(values, dtype=np.int64), device=device)


def points_tensor(points_m, dtype, device: torch.device) -> torch.Tensor:
    return torch.tensor(np.asarray(points_m, dtype).reshape(-1, 3), device=device)


@given(_coordinates)
def test_packing_is_one_to_one_and_never_negative(coordinates):
    keys = pack(torch.tensor(np.asarray(coordinates, np.int64).reshape(-1, 3)))
    assert unpack(keys).tolist() == [list(each) for each in coordinates]
    assert len(set(keys.tolist())) == len(set(coordinates))
    assert (keys >= 0).all()


def test_the_grid_is_at_least_fifty_kilometres_wide_either_way_at_five_centimetres():
    assert MAX_COORDINATE * 0.05 > 50_000


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_points_get_the_key_of_their_voxel(backend, dtype):
    kernels, device = backend
    axis = st.one_of(
        st.floats(-2, 2, width=32),
        st.floats(-50_000, 50_000, width=32),
        st.sampled_from([0.0, -0.0, 0.05, -0.05, 0.5, -0.5, 1e-30, -1e-30, 1.15, 0.35]),
    )

    @settings(max_examples=60)
    @given(st.lists(st.tuples(axis, axis, axis), max_size=30), st.sampled_from(SIZES_M))
    def check(points, size_m):
        points = np.asarray(points, dtype).reshape(-1, 3)
        cells = [[math.floor(float(value) / size_m) for value in point] for point in points]
        keys, largest = kernels.voxel_keys(points_tensor(points, dtype, device), size_m)
        assert keys.dtype == torch.int64
        assert keys.tolist() == pack(integers(np.reshape(cells, (-1, 3)), device)).tolist()
        assert largest == max((abs(value) for cell in cells for value in cell), default=0)

    check()


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_points_that_are_not_finite_are_told(backend, value: float, axis: int, dtype):
    kernels, device = backend
    points = np.full((50, 3), 1.0, dtype)
    points[33, axis] = value
    points[40, 0] = 2e6
    assert not math.isfinite(kernels.voxel_keys(points_tensor(points, dtype, device), 0.05)[1])


@pytest.mark.parametrize("far_m", [2.0**20 * 0.5, -(2.0**20) * 0.5, 1e9, -1e18, 1e300])
def test_points_beyond_the_grid_are_told_by_their_coordinate(backend, far_m: float):
    kernels, device = backend
    points = np.full((5, 3), 1.0)
    points[3, 1] = far_m
    largest = kernels.voxel_keys(points_tensor(points, np.float64, device), 0.5)[1]
    assert largest == abs(np.floor(far_m / 0.5)) > MAX_COORDINATE
    points[3, 1] = MAX_COORDINATE * 0.5 + 0.2
    keys, largest = kernels.voxel_keys(points_tensor(points, np.float64, device), 0.5)
    assert largest == MAX_COORDINATE
    assert unpack(keys)[3].tolist() == [2, MAX_COORDINATE, 2]


def test_centres_are_where_the_voxels_are(backend):
    kernels, device = backend

    @settings(max_examples=40)
    @given(_coordinates, st.sampled_from(SIZES_M))
    def check(coordinates, size_m):
        expected = [[(value + 0.5) * size_m for value in each] for each in coordinates]
        got = kernels.centers(pack(integers(np.reshape(coordinates, (-1, 3)), device)), size_m)
        assert got.dtype == torch.float32
        np.testing.assert_array_equal(got.cpu().numpy(), np.array(expected, np.float32).reshape(-1, 3))

    check()


def test_voxels_are_farther_by_their_centres(backend):
    kernels, device = backend

    @settings(max_examples=40)
    @given(_coordinates, st.sampled_from(SIZES_M), st.sampled_from([0.0, 0.1, 3.0, 30_000.0]))
    def check(coordinates, size_m, radius_m):
        point = (0.123, -1.7, 0.5)
        keys = pack(integers(np.reshape(coordinates, (-1, 3)), device))
        got = kernels.farther(keys, size_m, torch.tensor(point, dtype=torch.float64, device=device), radius_m)
        far = [math.dist([(value + 0.5) * size_m for value in each], point) > radius_m for each in coordinates]
        assert got.dtype == torch.int64
        assert got.tolist() == np.flatnonzero(far).tolist()

    check()


def test_distinct_keys_are_numbered_and_counted(backend):
    kernels, device = backend

    @settings(max_examples=60)
    @given(st.lists(st.one_of(st.integers(0, 5), st.integers(0, 2**63 - 1), st.integers(0, 9).map(lambda x: x << 42))))
    def check(values):
        unique, inverse, counts = (each.cpu() for each in kernels.distinct(integers(values, device)))
        assert unique.dtype == inverse.dtype == counts.dtype == torch.int64
        assert unique[inverse].tolist() == values
        assert dict(zip(unique.tolist(), counts.tolist(), strict=True)) == Counter(values)
        assert len(unique) == len(set(values))

    check()


def test_pairs_are_counted_by_group(backend):
    kernels, device = backend

    @settings(max_examples=60)
    @given(st.integers(1, 6), st.integers(1, 6), st.data())
    def check(groups, partners, data):
        pairs = data.draw(st.lists(st.tuples(st.integers(0, groups - 1), st.integers(0, partners - 1)), max_size=40))
        first, second = (integers([pair[axis] for pair in pairs], device) for axis in (0, 1))
        got = kernels.count_pairs(first, second, groups, partners)
        offsets, found, counts = (each.cpu().tolist() for each in (got.offsets, got.partners, got.counts))
        assert len(offsets) == groups + 1
        assert (offsets[0], offsets[-1]) == (0, len(found))
        assert got.partners.dtype == got.counts.dtype == got.offsets.dtype == torch.int64
        expected = Counter(pairs)
        rows = {}
        for group in range(groups):
            for place in range(offsets[group], offsets[group + 1]):
                rows[group, found[place]] = counts[place]
        assert rows == expected
        assert len(found) == len(expected)

    check()


def test_no_groups_and_no_pairs(backend):
    kernels, device = backend
    none = integers([], device)
    for groups in (0, 3):
        got = kernels.count_pairs(none, none, groups, 0)
        assert got.offsets.tolist() == [0] * (groups + 1)
        assert (len(got.partners), len(got.counts)) == (0, 0)


def test_a_table_finds_what_was_put_into_it_and_not_what_was_taken_out(backend):
    """A table as full as it can be, so that most keys collide, and deleted cells lie on the way."""
    kernels, device = backend
    key = st.one_of(st.integers(0, 30), st.integers(0, 2**62), st.integers(0, 30).map(lambda number: number << 42))

    @settings(max_examples=80)
    @given(st.lists(st.tuples(st.booleans(), st.lists(key, unique=True, max_size=8)), max_size=8))
    def check(batches):
        cells, used = 32, 0
        table = HashTable(
            torch.full((cells,), EMPTY, dtype=torch.int64, device=device),
            torch.full((cells,), -1, dtype=torch.int32, device=device),
        )
        plain: dict[int, int] = {}
        asked: set[int] = set()
        for insert, keys in batches:
            asked.update(keys)
            if insert:
                fresh = [each for each in keys if each not in plain][: cells - 1 - used]
                slots = list(range(1000 + used, 1000 + used + len(fresh)))
                kernels.place(table, integers(fresh, device), integers(slots, device))
                plain.update(zip(fresh, slots, strict=True))
                used += len(fresh)
            else:
                gone = [each for each in keys if each in plain]
                kernels.mark_deleted(table, integers(gone, device))
                for each in gone:
                    del plain[each]
            everything = sorted(asked) * 2
            got = kernels.find(table, integers(everything, device))
            assert got.dtype == torch.int64
            assert got.tolist() == [plain.get(each, -1) for each in everything]
            held = table.keys.tolist()
            assert sorted(each for each in held if each >= 0) == sorted(plain)
            assert held.count(EMPTY) == cells - used
            assert held.count(DELETED) == used - len(plain)

    check()
