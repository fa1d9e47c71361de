"""Verdicts follow the data, and change with it."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from lab.evaluation.made_up_results import (
    SCENE,
    association_points,
    lambda_points,
    made_up_records,
    memory_points,
)

from fus3dmaps_lab.evaluation.records import Record
from fus3dmaps_lab.evaluation.verdicts import association_verdict, effect_verdicts, lambda_verdict, memory_verdicts

INSTANCES, DENSE, WINDOW, EVIDENCE = range(4)


def held(records):
    return [verdict.holds for verdict in effect_verdicts(records)]


def test_all_hold_in_data_made_so():
    verdicts = effect_verdicts(made_up_records())
    assert [verdict.holds for verdict in verdicts] == [True] * 4
    assert str(verdicts[INSTANCES]).startswith(
        "holds: fused instances beat unfused instances in mIoU. Better in 5 of 5 pairs"
    )
    assert "It keeps 99.20 %, mean 0.5047 → 0.5007" in verdicts[WINDOW].numbers
    assert "Worse in 5 of 5 pairs" in verdicts[EVIDENCE].numbers


@pytest.mark.parametrize(
    ("which", "levels"),
    [
        (INSTANCES, {"instances__full": 0.6}),
        (DENSE, {"fused_dense__full": 0.30}),
        (WINDOW, {"fused_instances__window": 0.48}),
        (EVIDENCE, {"fused_instances__window_no_evidence": 0.52}),
    ],
)
def test_each_turns_with_its_data(which, levels):
    found = held(made_up_records(**levels))
    assert found == [i != which for i in range(4)]
    assert "does not hold" in str(effect_verdicts(made_up_records(**levels))[which])


def records_with(differences):
    firsts = [Record(SCENE, s, "instances", "full", "mIoU", 0.4) for s in range(len(differences))]
    return firsts + [Record(SCENE, s, "fused_instances", "full", "mIoU", 0.4 + d) for s, d in enumerate(differences)]


def test_every_pair_is_enough_without_significance():
    assert held(records_with([0.001, 0.001, 0.2, 0.001, 0.001])) == [True]


def test_significance_is_enough_without_every_pair():
    clear = [0.05, 0.06, 0.05, 0.06, -0.001, 0.05, 0.06, 0.05, 0.06, 0.05]
    assert held(records_with(clear)) == [True]
    assert held(records_with([-d for d in clear])) == [False]
    assert held(records_with([0.05, -0.06, 0.05, 0.06, -0.01])) == [False]


def test_few_pairs_decide_nothing():
    (verdict,) = effect_verdicts(records_with([0.1, 0.2]))
    assert verdict.holds is None
    assert str(verdict).startswith("undecided")
    assert "2 pairs, at least 5 decide" in verdict.numbers


def test_what_cannot_be_compared_says_why():
    records = records_with([0.1] * 5)
    (verdict,) = effect_verdicts(records[:-1])
    assert verdict.holds is None
    assert "lacks simulated building seed 4" in verdict.numbers
    records[0] = Record(SCENE, 0, "instances", "full", "mIoU", math.nan)
    assert "undefined for simulated building seed 0" in effect_verdicts(records)[0].numbers


def test_no_data_no_verdict():
    assert effect_verdicts([]) == []
    assert lambda_verdict([]) is None
    assert memory_verdicts([]) == []
    assert association_verdict([]) is None


def test_lambda():
    verdict = lambda_verdict(lambda_points())
    assert verdict is not None
    assert verdict.holds is True
    assert "At 0.2 the best lambda is 0.2, between 0.1 and 0.5" in verdict.numbers
    assert "5 of 5 seeds" in verdict.numbers
    turned = lambda_verdict(lambda_points({5.0: 0.1}))
    assert turned is not None
    assert turned.holds is False
    assert "At 5 the best lambda is 0.1" in turned.numbers
    assert "(mIoU of fused instances)" in verdict.claim
    dense = lambda_verdict([replace(p, metric="fused_dense/mIoU") for p in lambda_points()], "fused_dense/mIoU")
    assert dense is not None
    assert "(mIoU of the fused dense layer)" in dense.claim
    two = lambda_verdict(lambda_points(ratios=(0.2, 5.0)))
    assert two is not None
    assert two.holds is None


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, [True, True]),
        ({"slope": 1.04}, [True, True]),
        ({"slope": 1.2}, [False, True]),
        ({"slope": 0.9}, [False, True]),
        ({"bend": 0.01}, [False, True]),
        ({"window_share": 0.8}, [True, False]),
    ],
)
def test_memory(changes, expected):
    verdicts = memory_verdicts(memory_points(**changes))
    assert [verdict.holds for verdict in verdicts] == expected
    assert "up to 1,000 m³" in verdicts[0].numbers


def test_memory_without_a_prediction_is_undecided():
    points = [point for point in memory_points() if point.curve != "predicted"]
    assert [verdict.holds for verdict in memory_verdicts(points)] == [None, True]
    bent = [point for point in memory_points(bend=0.01) if point.curve != "predicted"]
    assert memory_verdicts(bent)[0].holds is False
    assert [v.holds for v in memory_verdicts([p for p in points if p.x < 500])] == [True]  # Two volumes are always linear.


def test_few_seeds_decide_no_sweep():
    for verdict in (
        lambda_verdict([point for point in lambda_points({5.0: 0.1}) if point.seed < 4]),
        association_verdict([point for point in association_points(AP25=-0.1) if point.seed < 4]),
    ):
        assert verdict is not None
        assert verdict.holds is None
        assert verdict.numbers.endswith("4 seeds, at least 5 decide.")


def test_association():
    verdict = association_verdict(association_points())
    assert verdict is not None
    assert (verdict.claim, verdict.holds) == ("visible IoU 0.2 is the best by every metric", True)
    turned = association_verdict(association_points(AP25=-0.1))
    assert turned is not None
    assert turned.holds is False
    assert "AP25: IoU 0.2 + merging (0.4400)" in turned.numbers
    assert association_verdict([p for p in association_points() if p.curve == "IoU 0.2"]) is None
    unfused = [replace(point, curve=f"{point.curve}, unfused") for point in association_points(AP25=-0.1)]
    both = association_verdict([*association_points(), *unfused])
    assert both is not None
    assert both.holds is False
    assert "unfused AP25: IoU 0.2 + merging (0.4400)" in both.numbers
    alone = association_verdict(unfused)
    assert alone is not None
    assert alone.numbers.startswith("Best on average over seeds by unfused mIoU: visible IoU 0.2 (0.4700)")
