"""Overlaps against plain sets, average precision against scikit-learn and a plain matching, segmentation by hand."""

from __future__ import annotations

import math
from collections import Counter

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sklearn.metrics import average_precision_score

from fus3dmaps_core.errors import MapError
from fus3dmaps_lab.evaluation.instance_quality import average_precision, overlaps, partition

PREDICTED = 5
scenes = st.lists(st.tuples(st.sets(st.integers(0, PREDICTED - 1), max_size=2), st.sampled_from([0, 2, 3, 7])), max_size=40)


def overlap_of(scene):
    members = [(voxel, instance) for voxel, (held, _) in enumerate(scene) for instance in sorted(held)]
    table = np.array(members, np.int64).reshape(-1, 2)
    return overlaps(table[:, 0], table[:, 1], PREDICTED, np.array([true for _, true in scene], np.int32))


def sets_of(scene):
    predicted = [{voxel for voxel, (held, _) in enumerate(scene) if each in held} for each in range(PREDICTED)]
    numbers = sorted({true for _, true in scene if true})
    return predicted, {number: {voxel for voxel, (_, true) in enumerate(scene) if true == number} for number in numbers}


@given(scenes)
def test_overlaps_agree_with_plain_sets(scene):
    predicted, true = sets_of(scene)
    found = overlap_of(scene)
    assert found.predicted_sizes.tolist() == [len(each) for each in predicted]
    assert dict(zip(found.ids.tolist(), found.true_sizes.tolist(), strict=True)) == {
        n: len(each) for n, each in true.items()
    }
    pairs = zip(found.predicted.tolist(), found.ids[found.true].tolist(), strict=True)
    expected = {
        (p, n): (len(a & b), len(a & b) / len(a | b)) for p, a in enumerate(predicted) for n, b in true.items() if a & b
    }
    assert dict(zip(pairs, zip(found.shared.tolist(), found.iou.tolist(), strict=True), strict=True)) == expected


def matched_plainly(scene, scores, min_iou):
    """Return (score, right) of each predicted instance that counts, best first."""
    predicted, true = sets_of(scene)
    labelled = set().union(*true.values())
    free, found = dict(true), []
    for place in sorted(range(PREDICTED), key=lambda each: (-scores[each], each)):
        mine = predicted[place]
        ious = {number: len(mine & each) / len(mine | each) for number, each in free.items()}
        best = max(ious, key=lambda number: (ious[number], -number), default=None)
        if best is not None and ious[best] >= min_iou:
            del free[best]
            found.append((scores[place], True))
        elif 2 * len(mine & labelled) > len(mine):
            found.append((scores[place], False))
    return found, len(true)


@given(scenes, st.permutations(range(PREDICTED)), st.sampled_from([0.25, 0.5]))
def test_average_precision_agrees_with_scikit_learn(scene, scores, min_iou):
    matched, count = matched_plainly(scene, scores, min_iou)
    found = average_precision(overlap_of(scene), np.array(scores), min_iou)
    if not count:
        assert math.isnan(found)
        return
    right = [each for _, each in matched]
    # Of those found; what was not found at all has a precision of 0.
    expected = average_precision_score(right, [score for score, _ in matched]) if any(right) else 0.0
    assert found == pytest.approx(expected * sum(right) / count, abs=1e-12)


@given(scenes)
def test_of_equal_scores_the_lower_place_is_first(scene):
    overlap = overlap_of(scene)
    falling = average_precision(overlap, -np.arange(PREDICTED), 0.25)
    assert average_precision(overlap, np.zeros(PREDICTED), 0.25) == pytest.approx(falling, nan_ok=True)


@given(scenes)
def test_pieces_are_counted_as_defined(scene):
    predicted, true = sets_of(scene)
    pieces = Counter(n for a in predicted for n, b in true.items() if 2 * len(a & b) > len(a))
    stuck = Counter(p for p, a in enumerate(predicted) for b in true.values() if 2 * len(a & b) > len(b))
    found = partition(overlap_of(scene))
    for value, groups in ((found.over_segmentation, pieces), (found.under_segmentation, stuck)):
        expected = groups.total() / len(groups) if groups else math.nan
        assert value == pytest.approx(expected, nan_ok=True)


def scene_of(predicted: str, true: str):
    """Make a scene from one letter per voxel: the predicted instance a, b, ..., or none; the true one 1, 2, ..., or none."""
    return [
        (set() if p == "." else {ord(p) - ord("a")}, 0 if t == "." else int(t)) for p, t in zip(predicted, true, strict=True)
    ]


def test_by_hand():
    scene = scene_of("aaaabbbbcc..ddee", "111111222222..33")
    overlap = overlap_of(scene)
    # a is in 1 (4 of 6), b has 2 of 1 and 2 of 2, c is in 2 (2 of 6), d is unlabelled, e is 3 itself.
    scores = np.array([5, 4, 3, 2, 1])
    # At 0.5: a right, b and c wrong, d left out, e right: (1/1 + 2/4) / 3.
    assert average_precision(overlap, scores, 0.5) == pytest.approx((1 + 2 / 4) / 3)
    # At 0.25: b takes 2 with 2/8; c finds it taken.
    assert average_precision(overlap, scores, 0.25) == pytest.approx((1 + 1 + 3 / 4) / 3)
    pieces = partition(overlap)
    assert (pieces.over_segmentation, pieces.under_segmentation) == (1.0, 1.0)


def test_pieces_and_lumps():
    pieces = partition(overlap_of(scene_of("aabbccdddd", "1111112222")))
    assert (pieces.over_segmentation, pieces.under_segmentation) == (4 / 2, 1.0)
    lumps = partition(overlap_of(scene_of("aaaaaabbbb", "1112223333")))
    # a is half of each, and mostly of neither.
    assert (lumps.over_segmentation, lumps.under_segmentation) == (1.0, 3 / 2)


def test_a_perfect_map():
    overlap = overlap_of(scene_of("aabbb.ccc", "11222.777"))
    assert average_precision(overlap, np.zeros(PREDICTED), 0.5) == 1.0
    assert partition(overlap) == partition(overlap_of(scene_of("a", "1")))


@pytest.mark.parametrize(("members", "instances"), [([0], [0, 1]), ([0], [PREDICTED]), ([0], [-1])])
def test_odd_members_are_refused(members, instances):
    with pytest.raises(MapError, match="members"):
        overlaps(np.array(members), np.array(instances), PREDICTED, np.array([1], np.int32))
