"""The paper's numbers are shown beside ours only where both are comparable, and each row says whose it is."""

from __future__ import annotations

import math

import pytest
from lab.evaluation.made_up_results import SCENE, lambda_points, made_up_records, memory_points

from fus3dmaps_lab.evaluation.beside_paper import effect_table, lambda_table, memory_table, paper_effect, results_table
from fus3dmaps_lab.evaluation.effects import EFFECTS, FUSED_DENSE, FUSED_INSTANCES, NO_EVIDENCE, WINDOW
from fus3dmaps_lab.evaluation.paper_tables import CLIP_DINOISER, HM3DSEM, NARADIO, REPLICA, SCANNET, SCENES


def names(table):
    return [column.name for column in table.columns]


def rows(table, **fields):
    found = [dict(zip(names(table), row, strict=True)) for row in table.rows]
    return [row for row in found if all(row[name] == value for name, value in fields.items())]


def test_the_papers_effects():
    instances = paper_effect(FUSED_INSTANCES)
    assert instances[REPLICA, NARADIO, "mIoU"] == (0.2665, 0.3137)
    assert instances[SCANNET, CLIP_DINOISER, "accuracy"] == (0.5085, 0.5350)
    assert instances[HM3DSEM, NARADIO, "f-mIoU"] == (0.4336, 0.4708)
    assert len(instances) == (2 * 2 + 1) * 3
    dense = paper_effect(FUSED_DENSE)
    assert dense[REPLICA, CLIP_DINOISER, "mIoU_with_background"] == (0.1558, 0.2262)
    assert len(dense) == 2 * 2 * 2 * 3
    window = paper_effect(WINDOW)
    assert window[HM3DSEM, NARADIO, "mIoU"] == (0.4062, 0.4022)
    assert window[REPLICA, NARADIO, "mIoU"] == (0.3137, 0.3237)
    assert len(window) == 3 * 3
    assert paper_effect(NO_EVIDENCE) == {
        (HM3DSEM, NARADIO, "mIoU"): (0.4022, 0.3530),
        (HM3DSEM, NARADIO, "f-mIoU"): (0.4622, 0.4135),
        (HM3DSEM, NARADIO, "accuracy"): (0.5778, 0.5278),
    }


def test_beside_a_simulation_stand_effects_alone():
    table = effect_table(made_up_records(), FUSED_INSTANCES, "simulated")
    assert names(table) == ["source", "data", "encoders", "metric", "difference", "second / first, %"]
    ours = rows(table, source="ours, simulation", metric="mIoU")
    assert [row["data"] for row in ours] == [f"{SCENE}; 5 runs"]
    assert ours[0]["difference"].mean == pytest.approx(0.1, abs=0.002)
    (theirs,) = rows(table, source="paper", data=SCANNET, encoders="NARADIO", metric="mIoU")
    assert theirs["difference"].mean == pytest.approx(0.0881)
    assert theirs["second / first, %"] == pytest.approx(100 * 0.4689 / 0.3808)


@pytest.mark.parametrize("effect", EFFECTS)
def test_no_score_of_the_paper_is_in_a_table_of_a_simulation(effect):
    table = effect_table(made_up_records(), effect, "simulated")
    scores = {value for pair in paper_effect(effect).values() for value in pair}
    shown = {cell if isinstance(cell, float) else cell.mean for row in table.rows for cell in row[4:]}
    assert scores.isdisjoint(shown)
    assert {row["source"] for row in rows(table)} == {"ours, simulation", "paper"}


def test_recorded_scenes_show_both_values_and_how_many_scenes():
    records = [r for scene in ("room_0", "room1") for r in made_up_records(scene, seeds=(0,))]
    table = effect_table(records, FUSED_INSTANCES, "lite")
    assert "instances, full" in names(table)
    (ours,) = rows(table, source="ours", metric="mIoU")
    assert (ours["data"], ours["encoders"]) == (f"{REPLICA}, 2 of its 8 scenes", "lite")
    assert ours["instances, full"].count == 2
    every = [r for scene in SCENES[SCANNET] for r in made_up_records(f"scene{scene}_00", seeds=(0,))]
    assert rows(effect_table(every, FUSED_INSTANCES, "lite"), source="ours")[0]["data"] == SCANNET


def test_an_effect_that_cannot_be_compared_has_no_row_of_ours():
    records = [r for r in made_up_records() if (r.layer, r.seed) != ("instances", 3)]
    assert rows(effect_table(records, FUSED_INSTANCES, "simulated"), source="ours, simulation") == []


def test_results_beside_every_method_of_the_paper():
    records = [r for scene in SCENES[SCANNET] for r in made_up_records(scene, seeds=(0,))]
    table = results_table(records, SCANNET, "lite")
    ours = rows(table, source="ours")
    assert {(row["layer"], row["mode"]) for row in ours} >= {("dense", "full"), ("fused_instances", "window")}
    assert {row["method"] for row in ours} == {"lite"}
    expected = [r.value for r in records if (r.layer, r.mode, r.metric) == ("dense", "full", "mIoU_with_background")]
    (dense,) = [row for row in ours if row["layer"] == "dense"]
    assert dense["mIoU_with_background"] == pytest.approx(sum(expected) / 5)
    (rayfronts,) = rows(table, method="RayFronts")
    assert (rayfronts["mIoU"], rayfronts["accuracy_with_background"]) == (0.4129, 0.4915)
    (naradio,) = rows(table, method=NARADIO, layer="fused_instances", mode="full")
    assert naradio["mIoU"] == 0.4689
    assert math.isnan(naradio["mIoU_with_background"])
    # Four baselines of instances, two of dense maps, and four layers of each of two encoders, one of them with a window.
    assert len(rows(table, source="paper")) == 4 + 2 + 4 * 2 + 1


def test_lambda_is_relative_to_the_best_of_each_row():
    table = lambda_table(lambda_points())
    columns = names(table)[2:]
    assert {"lambda = 0.01", "lambda = 0.1", "lambda = 5", "lambda = 10"} <= set(columns)
    (five,) = rows(table, curve="R^D / R^I = 5")
    assert five["lambda = 5"] == 100.0
    assert five["lambda = 0.01"] == pytest.approx(100 * (0.52 - 0.02 * math.log10(500) ** 2) / 0.52)
    (paper,) = rows(table, curve=CLIP_DINOISER)
    assert paper["lambda = 5"] == 100.0
    assert paper["lambda = 0.1"] == pytest.approx(100 * 0.243 / 0.310)
    assert math.isnan(paper["lambda = 2"])
    assert {row["source"] for row in rows(table)} == {"ours, simulation", "paper, Replica and ScanNet"}


def test_memory_is_a_share():
    table = memory_table(memory_points(window_share=0.25))
    ours = rows(table, source="ours, simulation")
    assert [row["data"] for row in ours] == ["seed 0, 1,000 m³", "seed 1, 1,000 m³"]
    assert ours[0]["window / dense map, %"] == pytest.approx(25.0)
    (hospital,) = rows(table, data="TartanGround Hospital", encoders="NARADIO")
    assert hospital["window / dense map, %"] == pytest.approx(100 * 354 / 5970)
    assert len(rows(table, source="paper")) == 9 * 2
