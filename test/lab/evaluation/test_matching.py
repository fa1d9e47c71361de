"""Nearest voxels against brute force, and the mode against torch, for any order of voxels."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import example, given
from hypothesis import strategies as st

from fus3dmaps_core.errors import MapError
from fus3dmaps_lab.evaluation import matching
from fus3dmaps_lab.evaluation.ground_truth import VoxelTruth
from fus3dmaps_lab.evaluation.matching import Neighbours, mode_of_neighbours, nearest_voxels, same_voxels

small = st.integers(-3, 3)
voxel_sets = st.sets(st.tuples(small, small, small), max_size=40).map(sorted)
halves = st.integers(-10, 10).map(lambda number: number / 2)
positions = st.lists(st.tuples(halves, halves, halves), max_size=8)


def keys_of(voxels) -> np.ndarray:
    return np.array(voxels, np.int64).reshape(-1, 3)


def nearest_by_brute_force(position, voxels, k):
    """Return the k nearest voxels, of equally near ones the lexicographically lowest."""
    return sorted(voxels, key=lambda key: (sum((a - b) ** 2 for a, b in zip(position, key, strict=True)), key))[:k]


@given(positions, voxel_sets, st.integers(1, 9), st.randoms(use_true_random=False), st.sampled_from([1, 8]))
def test_nearest_voxels_agree_with_brute_force_in_any_order(wanted, voxels, k, random, spare):
    random.shuffle(voxels)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(matching, "_SPARE", spare)
        patch.setattr(matching, "_BLOCK_ROWS", 3)
        found = nearest_voxels(np.array(wanted).reshape(-1, 3), keys_of(voxels), k)
    assert found.places.shape == found.distances.shape == (len(wanted), min(k, len(voxels)))
    for position, places, distances in zip(wanted, found.places.tolist(), found.distances.tolist(), strict=True):
        expected = nearest_by_brute_force(position, voxels, k)
        assert [voxels[place] for place in places] == expected
        assert distances == pytest.approx([np.linalg.norm(np.subtract(position, each)) for each in expected], abs=1e-12)


def test_many_equally_near_voxels_are_all_considered():
    sphere = [
        (x, y, z) for x in range(-25, 26) for y in range(-25, 26) for z in range(-25, 26) if x * x + y * y + z * z == 425
    ]
    assert len(sphere) > 100
    found = nearest_voxels(np.zeros((1, 3)), keys_of(sphere[::-1]), 5)
    assert [sphere[::-1][place] for place in found.places[0]] == sorted(sphere)[:5]


@given(positions, voxel_sets, st.integers(1, 7), st.integers(0, 2**32 - 1))
def test_the_mode_is_the_one_of_torch(wanted, voxels, k, seed):
    classes = np.random.default_rng(seed).integers(0, 3, len(voxels)).astype(np.int32)
    matched = mode_of_neighbours(nearest_voxels(np.array(wanted).reshape(-1, 3), keys_of(voxels), k), classes)
    assert matched.dtype == np.int32
    by_voxel = dict(zip(voxels, classes.tolist(), strict=True))
    expected = [[by_voxel[each] for each in nearest_by_brute_force(position, voxels, k)] for position in wanted]
    assert matched.tolist() == [torch.tensor(each).mode().values.item() if each else 0 for each in expected]


@example([(3, 3), (1, 1), (2, 0)])
@given(st.lists(st.tuples(st.integers(0, 9), st.integers(0, 9)), max_size=9))
def test_of_equally_frequent_classes_the_lowest_wins(pairs):
    places = np.arange(2 * len(pairs)).reshape(-1, 2)
    classes = np.array(pairs, np.int32).ravel()
    mode = mode_of_neighbours(Neighbours(places, np.zeros(places.shape)), classes)
    assert mode.tolist() == [min(pair) for pair in pairs]


def test_however_far_the_nearest_voxels_speak():
    found = nearest_voxels(np.array([[1000, 0, 0]]), keys_of([(0, 0, 0)]), 5)
    assert mode_of_neighbours(found, np.array([4])).tolist() == [4]


@given(voxel_sets, voxel_sets, st.randoms(use_true_random=False))
def test_on_the_union_grid_a_voxel_is_found_or_known_to_be_missing(wanted, voxels, random):
    random.shuffle(voxels)
    held = {voxel: place for place, voxel in enumerate(voxels)}
    assert same_voxels(keys_of(wanted), keys_of(voxels)).tolist() == [held.get(each, -1) for each in wanted]


def test_a_truth_between_the_voxels_has_no_union_grid_and_odd_positions_are_refused():
    between = VoxelTruth(keys_of([(0, 0, 0)]), np.ones(1, np.int32), np.ones(1, np.int32), rounding="round").positions
    with pytest.raises(MapError, match="k: 0 needs a truth on the map's own grid"):
        same_voxels(between, keys_of([(0, 0, 0)]))
    with pytest.raises(MapError, match="positions: must be whole or half"):
        nearest_voxels(np.array([[0.25, 0, 0]]), keys_of([(0, 0, 0)]), 1)
    with pytest.raises(MapError, match="k: must be at least 1"):
        nearest_voxels(np.zeros((1, 3)), keys_of([(0, 0, 0)]), 0)
