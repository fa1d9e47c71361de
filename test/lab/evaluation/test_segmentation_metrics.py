"""Segmentation scores against scikit-learn and by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sklearn.metrics import accuracy_score, confusion_matrix, jaccard_score, recall_score

from fus3dmaps_core.errors import MapError
from fus3dmaps_lab.evaluation.segmentation_metrics import confusion, score_segmentation, without_background

CLASSES = 5
labels = st.integers(0, CLASSES)
pairs = st.lists(st.tuples(labels, labels), max_size=60).map(lambda rows: np.array(rows, np.int32).reshape(-1, 2).T)


@given(pairs)
def test_confusion_agrees_with_scikit_learn(both):
    true, predicted = both
    expected = confusion_matrix(true, predicted, labels=range(CLASSES + 1)) if len(true) else np.zeros((6, 6))
    np.testing.assert_array_equal(confusion(true, predicted, CLASSES), expected)


@given(pairs)
def test_scores_agree_with_scikit_learn(both):
    true, predicted = both
    scores = score_segmentation(true, predicted, CLASSES)
    judged = true > 0
    true, predicted = true[judged], predicted[judged]
    present = sorted(set(true.tolist()))
    assert np.flatnonzero(np.isfinite(scores.iou)).tolist() == [each - 1 for each in present]
    if not present:
        assert all(math.isnan(each) for each in (scores.miou, scores.f_miou, scores.accuracy, scores.mean_accuracy))
        return
    options = {"labels": present, "zero_division": 0.0}
    np.testing.assert_allclose(
        scores.iou[np.array(present) - 1], jaccard_score(true, predicted, average=None, **options), rtol=0, atol=1e-12
    )
    assert scores.miou == pytest.approx(jaccard_score(true, predicted, average="macro", **options), abs=1e-12)
    assert scores.f_miou == pytest.approx(jaccard_score(true, predicted, average="weighted", **options), abs=1e-12)
    assert scores.accuracy == pytest.approx(accuracy_score(true, predicted), abs=1e-12)
    assert scores.mean_accuracy == pytest.approx(recall_score(true, predicted, average="macro", **options), abs=1e-12)


def test_by_hand():
    true = np.array([0, 1, 1, 1, 1, 2, 2, 0])
    predicted = np.array([1, 1, 1, 2, 0, 2, 3, 0])
    scores = score_segmentation(true, predicted, 3)
    # Class 1: 2 right, 2 missed; class 2: 1 right, 1 missed, 1 too many; class 3 does not occur.
    np.testing.assert_array_equal(scores.iou, [2 / 4, 1 / 3, np.nan])
    assert scores.miou == pytest.approx((2 / 4 + 1 / 3) / 2)
    assert scores.f_miou == pytest.approx((4 * 2 / 4 + 2 * 1 / 3) / 6)
    assert scores.accuracy == pytest.approx(3 / 6)
    assert scores.mean_accuracy == pytest.approx((2 / 4 + 1 / 2) / 2)


def test_classes_are_counted_anew_without_the_background():
    subset = without_background(("", "wall", "chair", "floor", "mug"), {1, 3})
    assert subset.names == ("chair", "mug")
    assert subset.old_numbers.tolist() == [2, 4]
    assert subset.new_numbers.tolist() == [0, 0, 1, 0, 2]
    everything = without_background(("", "wall", "chair"), ())
    assert (everything.names, everything.new_numbers.tolist()) == (("wall", "chair"), [0, 1, 2])


@pytest.mark.parametrize(
    ("names", "background", "named"),
    [(("", "wall"), {2}, "background"), (("", "wall"), {0}, "background"), (("", "wall"), {1}, "no class is left")],
)
def test_odd_subsets_are_refused(names, background, named):
    with pytest.raises(MapError, match=named):
        without_background(names, background)


@pytest.mark.parametrize(
    ("true", "predicted", "named"),
    [([1], [1, 2], "of one length"), ([1, 4], [1, 2], "true: classes"), ([1, 1], [1, -1], "predicted: classes")],
)
def test_odd_classes_are_refused(true, predicted, named):
    with pytest.raises(MapError, match=named):
        score_segmentation(np.array(true), np.array(predicted), 3)
