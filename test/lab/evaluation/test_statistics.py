"""Spread and paired tests agree with the textbook and refuse what cannot be paired."""

from __future__ import annotations

import math
import statistics
from math import comb

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fus3dmaps_lab.evaluation.statistics import ComparisonError, compare, kept, named, spread

values = st.floats(-1, 1).map(lambda value: round(value, 6))


def by_seed(numbers, scene="building"):
    return {(scene, seed): number for seed, number in enumerate(numbers)}


@given(st.lists(values, min_size=2, max_size=20))
def test_spread_agrees_with_the_standard_library(numbers):
    found = spread(numbers)
    assert found.count == len(numbers)
    assert found.mean == pytest.approx(statistics.mean(numbers), abs=1e-12)
    assert found.std == pytest.approx(statistics.stdev(numbers), abs=1e-12)
    assert (found.minimum, found.maximum) == (min(numbers), max(numbers))


def test_undefined_values_are_left_out_and_counted():
    found = spread([1.0, math.nan, 3.0])
    assert (found.count, found.mean, found.undefined) == (2, 2.0, 1)
    assert spread([0.5]).mean == 0.5
    assert math.isnan(spread([0.5]).std)
    nothing = spread([math.nan])
    assert (nothing.count, nothing.undefined) == (0, 1)
    assert math.isnan(nothing.mean)


def test_student_sleep_data_give_the_published_p():
    # Student (1908): extra sleep under two drugs; t = 4.0621 with 9 degrees of freedom, p = 0.002833.
    first = by_seed([0.7, -1.6, -0.2, -1.2, -0.1, 3.4, 3.7, 0.8, 0.0, 2.0])
    second = by_seed([1.9, 0.8, 1.1, 0.1, -0.1, 4.4, 5.5, 1.6, 4.6, 3.4])
    found = compare(first, second)
    assert found.t_p == pytest.approx(0.002833, abs=5e-7)
    assert found.difference.mean == pytest.approx(1.58)
    assert (found.better, found.worse, found.count) == (9, 0, 10)
    assert found.sign_p == pytest.approx(2 / 2**9)


@given(st.lists(values, min_size=1, max_size=12), st.data())
def test_sign_test_is_the_binomial_tail(first, data):
    second = data.draw(st.lists(values, min_size=len(first), max_size=len(first)))
    found = compare(by_seed(first), by_seed(second))
    assert found.better == sum(b > a for a, b in zip(first, second, strict=True))
    assert found.worse == sum(b < a for a, b in zip(first, second, strict=True))
    n, k = found.better + found.worse, min(found.better, found.worse)
    assert found.sign_p == pytest.approx(min(1.0, 2 * sum(comb(n, i) for i in range(k + 1)) / 2**n))


def test_five_of_five_has_the_smallest_signed_rank_p():
    found = compare(by_seed([0.1, 0.2, 0.3, 0.4, 0.5]), by_seed([0.15, 0.26, 0.37, 0.48, 0.59]))
    assert found.wilcoxon_p == found.sign_p == pytest.approx(2 / 2**5)


def test_swapped_conditions_mirror():
    first, second = by_seed([0.1, 0.5, 0.3]), by_seed([0.2, 0.4, 0.7])
    one, other = compare(first, second), compare(second, first)
    assert one.difference.mean == -other.difference.mean
    assert (one.better, one.worse) == (other.worse, other.better)
    assert (one.t_p, one.wilcoxon_p, one.sign_p) == (other.t_p, other.wilcoxon_p, other.sign_p)


def test_what_differs_by_rounding_is_equal():
    found = compare(by_seed([0.1 + 0.2, 0.5]), by_seed([0.3, 0.5]))
    assert (found.better, found.worse, found.difference.mean) == (0, 0, 0.0)
    assert found.wilcoxon_p == found.sign_p == 1.0
    assert math.isnan(found.t_p)


def test_a_t_test_needs_differences_that_vary():
    assert math.isnan(compare(by_seed([0.1]), by_seed([0.2])).t_p)
    assert math.isnan(compare(by_seed([0.1, 0.2, 0.3]), by_seed([0.2, 0.3, 0.4])).t_p)


def test_share_kept():
    assert kept(compare(by_seed([0.4, 0.6]), by_seed([0.39, 0.58]))) == pytest.approx(97.0)
    assert math.isnan(kept(compare(by_seed([0.0]), by_seed([0.5]))))


def test_unequal_seeds_are_refused_by_name():
    first = {("building", 0): 0.1, ("building", 1): 0.2, ("building", 2): 0.3}
    with pytest.raises(ComparisonError, match="fused lacks building seeds 0, 2, which unfused has"):
        compare(first, {("building", 1): 0.1}, ("unfused", "fused"))
    with pytest.raises(ComparisonError, match="unfused lacks room0 seed 0, which fused has"):
        compare(first, {**first, ("room0", 0): 0.1}, ("unfused", "fused"))


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_undefined_values_are_refused_by_name(bad):
    with pytest.raises(ComparisonError, match="the second is undefined for building seed 1"):
        compare(by_seed([0.1, 0.2]), by_seed([0.1, bad]))


def test_no_result_is_refused():
    with pytest.raises(ComparisonError, match="neither"):
        compare({}, {})


def test_units_are_named_by_scene():
    assert named([("b", 1), ("a", 0), ("b", 0)]) == "a seed 0; b seeds 0, 1"
