"""Reliability curve against scikit-learn, expected error against the definition."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sklearn.calibration import calibration_curve

from fus3dmaps_core.errors import MapError
from fus3dmaps_lab.evaluation.calibration import reliability

probabilities = st.one_of(st.floats(0, 1), st.integers(0, 15).map(lambda edge: edge / 15))
predictions = st.lists(st.tuples(probabilities, st.booleans()), min_size=1, max_size=60)


def split(rows):
    return np.array([each for each, _ in rows], np.float64), np.array([right for _, right in rows])


@given(predictions, st.sampled_from([1, 10, 15]))
def test_the_curve_agrees_with_scikit_learn(rows, bins):
    confidence, right = split(rows)
    curve = reliability(confidence, right, bins)
    expected_accuracy, expected_confidence = calibration_curve(
        right, confidence, n_bins=bins, strategy="uniform", pos_label=True
    )
    filled = curve.counts > 0
    np.testing.assert_allclose(curve.accuracy[filled], expected_accuracy, rtol=0, atol=1e-12)
    np.testing.assert_allclose(curve.confidence[filled], expected_confidence, rtol=0, atol=1e-12)
    assert np.isnan(curve.accuracy[~filled]).all()
    assert np.isnan(curve.confidence[~filled]).all()
    assert curve.counts.sum() == len(rows)


@given(predictions)
def test_the_expected_error_is_what_its_definition_says(rows):
    total = 0.0
    for first in np.arange(15):
        low, high = np.linspace(0, 1, 16)[first : first + 2]
        mine = [(each, right) for each, right in rows if low < each <= high or (first == 0 and each == 0)]
        total += abs(sum(right for _, right in mine) - sum(each for each, _ in mine)) / len(rows)
    assert reliability(*split(rows)).expected_error == pytest.approx(total, abs=1e-9)


def test_by_hand():
    curve = reliability(np.array([0.9, 0.9, 0.1, 0.1]), np.array([True, False, False, False]), bins=2)
    assert curve.edges.tolist() == [0, 0.5, 1]
    assert (curve.counts.tolist(), curve.accuracy.tolist()) == ([2, 2], [0, 0.5])
    assert curve.expected_error == pytest.approx((0.1 + 0.4) / 2)
    assert math.isnan(reliability(np.empty(0), np.empty(0, bool)).expected_error)


@pytest.mark.parametrize(
    ("confidence", "right"), [([0.5], [True, False]), ([1.5], [True]), ([-0.1], [True]), ([math.nan], [True])]
)
def test_odd_predictions_are_refused(confidence, right):
    with pytest.raises(MapError, match="probabilities"):
        reliability(np.array(confidence), np.array(right))
