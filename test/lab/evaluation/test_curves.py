"""Figures read off curves are those put into them."""

from __future__ import annotations

import math

import numpy as np
import pytest
from lab.evaluation.made_up_results import BYTES_PER_M3, LAMBDAS, lambda_points, memory_points

from fus3dmaps_lab.evaluation.curves import bytes_at_the_end, lambda_optima, line_of, predicted_ratio
from fus3dmaps_lab.evaluation.records import CurvePoint


@pytest.mark.parametrize(
    ("curve", "ratio"),
    [
        ("R^D / R^I = 5", 5.0),
        ("R^D / R^I = 0.2", 0.2),
        ("R^D / R^I = 1e-05", 1e-5),
        ("R^D / R^I = 0", None),
        ("R^D / R^I = 1.2.3", None),
        ("something", None),
    ],
)
def test_ratio_of_a_curve(curve, ratio):
    assert predicted_ratio(curve) == ratio


@pytest.mark.parametrize("best", LAMBDAS)
def test_the_best_lambda_is_found_with_its_neighbours(best):
    (optimum,) = lambda_optima(lambda_points({1.0: best}, ratios=(1.0,)))
    at = LAMBDAS.index(best)
    assert optimum.best == best
    assert (optimum.low, optimum.high) == (LAMBDAS[max(at - 1, 0)], LAMBDAS[min(at + 1, len(LAMBDAS) - 1)])
    assert optimum.brackets == (0.5 <= best <= 2.0)  # The neighbours of 0.5 are 0.2 and 1.
    assert optimum.seeds == (5 if optimum.brackets else 0, 5)
    assert optimum.loss_percent == pytest.approx(100 * 0.02 * np.log10(best) ** 2 / 0.52)


def test_optima_are_ordered_and_other_curves_ignored():
    points = [*lambda_points(ratios=(5.0, 0.2)), CurvePoint("lambda", "unnamed", 0, 1.0, "mIoU", 0.9)]
    points += [CurvePoint("lambda", "R^D / R^I = 5", 0, x, "accuracy", x) for x in LAMBDAS]
    assert [(optimum.ratio, optimum.best) for optimum in lambda_optima(points)] == [(0.2, 0.2), (5.0, 5.0)]
    assert [(optimum.ratio, optimum.best) for optimum in lambda_optima(points, "accuracy")] == [(5.0, 100.0)]


def test_undefined_points_and_lambda_zero_do_no_harm():
    points = [*lambda_points(ratios=(1.0,)), CurvePoint("lambda", "R^D / R^I = 1", 0, 1.0, "accuracy", math.nan)]
    points.append(CurvePoint("lambda", "R^D / R^I = 1", 0, 0.0, "mIoU", 0.1))
    (optimum,) = lambda_optima(points)
    assert optimum.best == 1.0
    assert lambda_optima(points, "accuracy") == []


def test_line_through_bytes():
    line = line_of(memory_points(slope=1.5), "dense map")
    assert line is not None
    assert line.slope == pytest.approx(1.5 * BYTES_PER_M3)
    assert line.offset == pytest.approx(0.0, abs=1.0)
    assert line.linearity == pytest.approx(1.0)
    assert (line.largest_x, line.volumes) == (1000.0, 4)
    bent = line_of(memory_points(bend=0.01), "dense map")
    assert bent is not None
    assert bent.linearity < 0.98


def test_no_line_through_one_volume():
    assert line_of([CurvePoint("memory", "dense map", s, 5.0, "bytes", s) for s in (1, 2, 3)], "dense map") is None
    assert line_of([], "dense map") is None


def test_ends_are_by_seed():
    points = [*memory_points(window_share=0.25), CurvePoint("memory", "dense map", 7, 1.0, "bytes", 1.0)]
    full = 1000 * BYTES_PER_M3
    assert bytes_at_the_end(points) == {0: (1000.0, full, full / 4), 1: (1000.0, full, full / 4)}
