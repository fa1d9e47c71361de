"""Rankings against plain ones, and retrieval scores by hand."""

from __future__ import annotations

import math
from collections import Counter

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sklearn.metrics import precision_score

from fus3dmaps_lab.evaluation.ground_truth import VoxelTruth
from fus3dmaps_lab.evaluation.retrieval import (
    NOWHERE,
    TrueObjects,
    instance_scores,
    majority_classes,
    score_retrieval,
    true_objects,
)

SIZE_M = 0.5
COUNT = 4
owners = st.lists(st.integers(-1, COUNT - 1), max_size=30)
small = st.integers(-3, 3)


@given(owners, st.integers(0, 3), st.integers(0, 2**32 - 1))
def test_the_score_of_an_instance_is_the_mean_over_its_voxels(owner, min_voxels, seed):
    cosines = np.random.default_rng(seed).uniform(-1, 1, (len(owner), 3)).astype(np.float32)
    scores = instance_scores(np.array(owner, np.int64), cosines, COUNT, min_voxels)
    for instance in range(COUNT):
        mine = [row for row, each in enumerate(owner) if each == instance]
        if len(mine) < max(min_voxels, 1):
            assert np.isnan(scores[instance]).all()
        else:
            np.testing.assert_allclose(scores[instance], cosines[mine].mean(axis=0, dtype=np.float64), rtol=0, atol=1e-9)


@given(st.lists(st.tuples(st.integers(-1, COUNT - 1), st.integers(0, 3)), max_size=30))
def test_the_class_of_an_instance_is_that_of_most_voxels(rows):
    table = np.array(rows, np.int64).reshape(-1, 2)
    found = majority_classes(table[:, 0], table[:, 1], COUNT)
    for instance in range(COUNT):
        labels = [label for owner, label in rows if owner == instance]
        known = Counter(label for label in labels if label)
        expected = min(known, key=lambda label: (-known[label], label)) if known else (0 if labels else NOWHERE)
        assert found[instance] == expected


@given(st.dictionaries(st.tuples(small, small, small), st.tuples(st.integers(1, 3), st.integers(0, 3)), max_size=30))
def test_true_objects_are_where_their_voxels_are(voxels):
    keys = np.array(list(voxels), np.int64).reshape(-1, 3)
    labels = np.array(list(voxels.values()), np.int32).reshape(-1, 2)
    objects = true_objects(VoxelTruth(keys, labels[:, 0], labels[:, 1], SIZE_M))
    assert objects.ids.tolist() == sorted(set(labels[:, 1].tolist()) - {0})
    for row, number in enumerate(objects.ids):
        mine = labels[:, 1] == number
        frequency = Counter(labels[mine, 0].tolist())
        assert objects.classes[row] == min(frequency, key=lambda label: (-frequency[label], label))
        np.testing.assert_allclose(objects.centroids_m[row], (keys[mine].mean(axis=0) + 0.5) * SIZE_M, rtol=0, atol=1e-12)
        np.testing.assert_allclose(objects.boxes_min_m[row], keys[mine].min(axis=0) * SIZE_M, rtol=0, atol=1e-12)
        np.testing.assert_allclose(objects.boxes_max_m[row], (keys[mine].max(axis=0) + 1) * SIZE_M, rtol=0, atol=1e-12)


def two_chairs_and_a_mug() -> TrueObjects:
    centroids_m = np.array([[0.0, 0, 0], [10, 0, 0], [5, 5, 0]])
    return TrueObjects(np.array([4, 5, 6]), np.array([1, 1, 3]), centroids_m, centroids_m - 0.5, centroids_m + 0.5)


def test_by_hand():
    # Four instances: a chair, a mug, something that is not there, something unknown.
    classes = np.array([1, 3, NOWHERE, 0])
    scores = np.array([[0.6, 0.0, 0.2], [0.3, 0.0, 0.5], [0.5, 0.0, 0.9], [0.9, 0.9, 0.95]])
    centroids_m = np.array([[9.6, 0.3, 0], [5, 4, 0], [5, 8, 0], [0, 0, 0]])
    found = score_retrieval(scores, classes, centroids_m, two_chairs_and_a_mug(), [1, 2, 3], (1, 2, 5))
    assert found.classes.tolist() == [1, 3]  # No true instance is of class 2.
    assert found.precision[1].tolist() == [1, 0]
    assert found.precision[2].tolist() == [1 / 2, 1 / 2]
    assert found.precision[5].tolist() == pytest.approx([1 / 3, 1 / 3])
    np.testing.assert_allclose(found.localisation_error_m, [0.5, 3.0])
    assert found.inside_box.tolist() == [1, 0]


def test_a_map_without_instances_finds_nothing():
    nothing = score_retrieval(np.empty((0, 3)), np.empty(0, int), np.empty((0, 3)), two_chairs_and_a_mug(), [1])
    assert {k: each.tolist() for k, each in nothing.precision.items()} == {1: [0], 3: [0], 5: [0]}
    assert math.isnan(nothing.localisation_error_m[0])
    assert nothing.inside_box.tolist() == [0]


@given(
    st.lists(st.tuples(st.sampled_from([NOWHERE, 0, 1, 3]), st.one_of(st.just(math.nan), st.integers(0, 3))), max_size=12),
    st.integers(1, 6),
)
def test_precision_is_that_of_the_best_ranked(instances, k):
    classes = np.array([label for label, _ in instances], np.int64)
    scores = np.array([score for _, score in instances], np.float64)[:, None]
    found = score_retrieval(scores, classes, np.zeros((len(instances), 3)), two_chairs_and_a_mug(), [1], (k,))
    ranked = sorted(
        (place for place, (label, score) in enumerate(instances) if label != 0 and not math.isnan(score)),
        key=lambda place: (-instances[place][1], place),
    )[:k]
    right = [instances[place][0] == 1 for place in ranked]
    expected = precision_score(right, [True] * len(right)) if right else 0.0
    assert found.precision[k].tolist() == pytest.approx([expected])
