"""Studies of simulated buildings: they compare what they name, and seeds are independent."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from fus3dmaps_core.config.schema import Config
from fus3dmaps_lab.evaluation.building_runs import BuildingRun, Variant
from fus3dmaps_lab.evaluation.evaluate_map import INSTANCE_LAYERS
from fus3dmaps_lab.evaluation.memory_study import MemoryStudy, bytes_per_voxel, memory_curves
from fus3dmaps_lab.evaluation.records import LAYERS, MODES
from fus3dmaps_lab.evaluation.simulation import ASSOCIATIONS, Study, study_building, with_noise_ratio
from fus3dmaps_lab.evaluation.simulation_runs import study_seeds
from fus3dmaps_lab.simulation.building.simulated_building import SimulatedBuilding
from fus3dmaps_lab.simulation.models.encoder_statistics import EncoderStatistics

SMALL = Study(rooms_per_storey=2, frames=30, window_radius_m=2.0)


@pytest.fixture(scope="module")
def whole():
    study = replace(
        SMALL,
        noise_ratios=(0.5,),
        lambdas=(0.1, 1.0),
        window_radii_m=(2.0, 50.0),
        associations={name: ASSOCIATIONS[name] for name in ("IoU", "visible IoU")},
    )
    return study_building(study, seed=1)


def value(records, layer: str, mode: str, metric: str) -> float:
    (found,) = (r.value for r in records if (r.layer, r.mode, r.metric) == (layer, mode, metric))
    return found


def test_every_layer_and_mode_is_there(whole) -> None:
    records, _ = whole
    assert {(r.layer, r.mode) for r in records} == {(layer, "full") for layer in LAYERS} | {
        (layer, mode) for layer in INSTANCE_LAYERS for mode in MODES[1:]
    }
    assert {r.seed for r in records} == {1}
    assert all("simulated" in r.scene for r in records)
    for layer in LAYERS:
        assert 0.1 < value(records, layer, "full", "mIoU") <= 1
    names = {r.metric for r in records}
    assert {
        "mIoU",
        "f-mIoU",
        "accuracy",
        "mean_accuracy",
        "AP25",
        "AP50",
        "precision@1",
        "ECE",
        "localisation_error_m",
    } <= names
    assert {"mIoU_with_background", "f-mIoU_with_background"} <= names


def test_a_window_changes_only_what_is_fused(whole) -> None:
    records, _ = whole
    for metric in ("mIoU", "accuracy"):
        assert value(records, "instances", "window", metric) == value(records, "instances", "full", metric)


def test_curves_are_of_the_variants_that_they_name(whole) -> None:
    records, points = whole
    at = {(p.experiment, p.curve, p.x, p.metric): p.value for p in points}
    for layer in INSTANCE_LAYERS:
        assert at["window_radius", layer, 2.0, "mIoU"] == value(records, layer, "window", "mIoU")
    assert at["window_radius", "instances", 50.0, "mIoU"] == value(records, "instances", "full", "mIoU")
    assert at["association", "IoU", 0.0, "mIoU"] == value(records, "fused_instances", "full", "mIoU")
    assert at["association", "IoU, unfused", 0.0, "mIoU"] == value(records, "instances", "full", "mIoU")
    assert at["association", "visible IoU", 0.0, "instances"] > 0
    assert {x for experiment, _, x, _ in at if experiment == "lambda"} == {0.1, 1.0}


def test_the_same_seed_gives_the_same_numbers_in_other_processes(whole) -> None:
    told: list[tuple[int, int]] = []
    records, _ = study_seeds(SMALL, [1, 2], jobs=2, on_progress=lambda done, total: told.append((done, total)))
    assert told[-1] == (60, 60)
    assert [done for done, _ in told] == sorted(done for done, _ in told)
    again = {(r.layer, r.mode, r.metric): r.value for r in whole[0]}
    for record in records:
        if record.seed == 1:
            expected = again[record.layer, record.mode, record.metric]
            assert record.value == expected or (math.isnan(record.value) and math.isnan(expected))
    assert [r.seed for r in records] == sorted(r.seed for r in records)
    assert value([r for r in records if r.seed == 2], "dense", "full", "mIoU") != value(whole[0], "dense", "full", "mIoU")


def test_a_seed_that_fails_ends_the_study() -> None:
    with pytest.raises(ValueError, match="building needs"):
        study_seeds(replace(SMALL, frames=1), [0, 1], jobs=2)


@pytest.mark.parametrize("ratio", [0.2, 1.0, 5.0])
def test_a_noise_ratio_keeps_the_product(ratio) -> None:
    plain = EncoderStatistics()
    changed = with_noise_ratio(plain, ratio)
    assert changed.variance_ratio == pytest.approx(ratio)
    assert changed.patch_variance * changed.crop_variance == pytest.approx(plain.patch_variance * plain.crop_variance)


def test_a_map_of_several_is_the_map_alone() -> None:
    building = SimulatedBuilding(seed=2, rooms_per_storey=2, frames=20)
    size = (building.intrinsics.width, building.intrinsics.height)
    variants = {"first": Variant(), "second": Variant({"fusion.window_radius_m": 2.0})}
    together = BuildingRun(building.truth, size, variants, seed=2)
    together.feed(building)
    for name, variant in variants.items():
        alone = BuildingRun(building.truth, size, {name: variant}, seed=2)
        alone.feed(building)
        expected, found = (run.pipelines[name].semantic_map.export_state() for run in (alone, together))
        assert expected.keys() == found.keys()
        for key, array in expected.items():
            np.testing.assert_array_equal(found[key], array)


def test_memory_follows_the_mapped_volume_and_a_window_does_not() -> None:
    study = MemoryStudy(storeys=1, rooms_per_storey=2, frames=80, dimension=32, window_radius_m=1.0, measurements=4)
    points = memory_curves(study, seed=0)
    curves = {curve: [(p.x, p.value) for p in points if p.curve == curve] for curve in {p.curve for p in points}}
    assert {len(each) for each in curves.values()} == {4}
    volumes = [x for x, _ in curves["dense map"]]
    assert volumes == sorted(volumes)
    assert volumes[0] > 0
    for (_, whole), (_, window) in zip(curves["dense map"], curves["sliding window"], strict=True):
        assert window < whole
    per_voxel = [held / (x / 0.05**3) for x, held in curves["predicted"]]
    np.testing.assert_allclose(per_voxel, bytes_per_voxel(Config(), 32))
    # Keys, hash, colour, hypotheses and weight beside 32 halves.
    assert 64 < per_voxel[0] < 64 + 160
