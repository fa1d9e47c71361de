"""Records are grouped correctly, and only equal scenes and seeds are compared."""

from __future__ import annotations

import pytest

from fus3dmaps_lab.evaluation.effects import (
    EFFECTS,
    FUSED_INSTANCES,
    OTHER,
    SIMULATION,
    WINDOW,
    Condition,
    compare_effect,
    group_of,
    grouped,
    metrics_in,
    paper_scene,
    values_of,
)
from fus3dmaps_lab.evaluation.paper_tables import HM3DSEM, REPLICA, SCANNET
from fus3dmaps_lab.evaluation.records import LAYERS, MODES, Record
from fus3dmaps_lab.evaluation.statistics import ComparisonError


def record(layer, value, seed=0, mode="full", metric="mIoU", scene="simulated building"):
    return Record(scene, seed, layer, mode, metric, value)


@pytest.mark.parametrize(
    ("scene", "group"),
    [
        ("simulated building", SIMULATION),
        ("Simulation of room0", SIMULATION),
        ("office0", REPLICA),
        ("room_2", REPLICA),
        ("replica/room1", REPLICA),
        ("office5", OTHER),
        ("room0_old", OTHER),
        ("scene0011_00", SCANNET),
        ("0518", SCANNET),
        ("scene0012_00", OTHER),
        ("00824", HM3DSEM),
        ("00824-Dd4bFSTQ8gi", HM3DSEM),
        ("00825-yHLr6bvWsVm", OTHER),
        ("redkitchen", OTHER),
    ],
)
def test_groups(scene, group):
    assert group_of(scene) == group


def test_published_names_lead_to_the_papers_scene():
    assert paper_scene("Room_0") == (REPLICA, "room0")
    assert paper_scene("scene0378_02") == (SCANNET, "0378")
    assert paper_scene("hm3dsem/00890-6s7QHgap2fW") == (HM3DSEM, "00890")
    assert paper_scene("kitchen") is None


def test_groups_keep_their_order_and_their_records():
    records = [record("dense", 0.1, scene=scene) for scene in ("kitchen", "0011", "simulated flat", "office1")]
    found = grouped(records)
    assert list(found) == [SIMULATION, REPLICA, SCANNET, OTHER]
    assert sorted(r.scene for members in found.values() for r in members) == sorted(r.scene for r in records)


def test_metrics_are_ordered_and_classes_left_out():
    names = ("AP25", "iou/bed", "iou_with_background/wall", "mIoU_with_background", "accuracy", "mIoU")
    assert metrics_in(record("dense", 0.1, metric=name) for name in names) == (
        "mIoU",
        "accuracy",
        "mIoU_with_background",
        "AP25",
    )


def test_effects_are_between_layers_and_modes_that_exist():
    for effect in EFFECTS:
        for condition in (effect.first, effect.second):
            assert condition.layer in LAYERS
            assert condition.mode in MODES


def test_an_effect_takes_only_its_own_records():
    records = [
        record("instances", 0.4),
        record("fused_instances", 0.5),
        record("fused_instances", 0.9, mode="window"),
        record("fused_instances", 0.9, metric="accuracy"),
        record("dense", 0.9),
    ]
    found = compare_effect(records, FUSED_INSTANCES, "mIoU")
    assert found is not None
    assert found.differences == {("simulated building", 0): pytest.approx(0.1)}
    window = compare_effect(records, WINDOW, "mIoU")
    assert window is not None
    assert window.difference.mean == pytest.approx(0.4)


def test_pairs_are_of_equal_scene_and_seed():
    places = [("simulated flat", 0), ("simulated flat", 1), ("simulated house", 0)]
    records = [record("instances", 0.1 * i, scene=scene, seed=seed) for i, (scene, seed) in enumerate(places)]
    records += [record("fused_instances", 0.2 * i, scene=scene, seed=seed) for i, (scene, seed) in enumerate(places)]
    found = compare_effect(records[::-1], FUSED_INSTANCES, "mIoU")
    assert found is not None
    assert found.differences == {place: pytest.approx(0.1 * i) for i, place in enumerate(places)}


def test_what_was_not_measured_is_no_comparison():
    assert compare_effect([record("instances", 0.4)], FUSED_INSTANCES, "mIoU") is None


def test_a_missing_seed_is_refused():
    records = [record("instances", 0.4, 0), record("instances", 0.4, 1), record("fused_instances", 0.5, 0)]
    with pytest.raises(ComparisonError, match="mIoU of fused_instances, full lacks simulated building seed 1"):
        compare_effect(records, FUSED_INSTANCES, "mIoU")


def test_a_number_given_twice_is_refused():
    with pytest.raises(ComparisonError, match="given twice for simulated building seed 3"):
        values_of([record("dense", 0.4, 3), record("dense", 0.5, 3)], Condition("dense", "full"), "mIoU")
