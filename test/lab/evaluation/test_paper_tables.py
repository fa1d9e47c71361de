"""All numbers of the paper are there, and agree where the paper gives them twice."""

from __future__ import annotations

from collections import Counter
from itertools import product

import pytest

from fus3dmaps_lab.evaluation.paper_tables import (
    CLIP_DINOISER,
    HM3DSEM,
    NARADIO,
    PAPER_ROWS,
    REPLICA,
    SCANNET,
    SCENES,
    TABLES,
)
from fus3dmaps_lab.evaluation.records import LAYERS, MODES

SCORES = ("mIoU", "f-mIoU", "accuracy")


def rows(table, **fields):
    return [row for row in PAPER_ROWS if row.table == table and all(getattr(row, k) == v for k, v in fields.items())]


def value(table, **fields):
    (row,) = rows(table, **fields)
    return row.value


# Methods x metrics x columns, counted in the paper's own tables.
SHAPES = {
    "instance maps": 6 * 3 * 2,
    "dense maps": 3 * 3 * 4,
    "ablation of instance maps": 2 * 3 * 4,
    "ablation of dense maps": 4 * 3 * 4,
    "lambda": 2 * 3 * 5,
    "HM3DSem": 5 * 3,
    "memory": 9 * 4,
    "frame rates": 4 * 4,
}


def test_every_table_has_its_shape():
    assert Counter(row.table for row in PAPER_ROWS) == SHAPES
    assert tuple(SHAPES) == TABLES


def test_no_number_is_given_twice():
    assert max(Counter(tuple(v for k, v in vars(row).items() if k != "value") for row in PAPER_ROWS).values()) == 1


def test_names_are_those_of_the_records():
    for row in PAPER_ROWS:
        assert row.layer in (*LAYERS, "all")
        assert row.mode in (*MODES, "no fusion")
        assert row.metric in (*SCORES, "MiB", "Hz")
        assert (row.background is None) == (row.metric in ("MiB", "Hz"))
        assert (row.variance_ratio is not None) == (row.table == "lambda")
        assert bool(row.device) == (row.table == "frame rates")
        if row.metric in SCORES:
            assert 0 < row.value < 1


@pytest.mark.parametrize(
    ("table", "method", "layers"),
    [
        ("ablation of instance maps", NARADIO, ("instances", "fused_instances")),
        ("ablation of instance maps", CLIP_DINOISER, ("instances", "fused_instances")),
        ("ablation of dense maps", NARADIO, ("dense", "fused_dense")),
        ("ablation of dense maps", CLIP_DINOISER, ("dense", "fused_dense")),
    ],
)
def test_ablations_are_complete(table, method, layers):
    backgrounds = (False, True) if "dense" in layers else (False,)
    found = {(row.layer, row.dataset, row.background, row.metric) for row in rows(table, method=method)}
    assert found == set(product(layers, (REPLICA, SCANNET), backgrounds, SCORES))


@pytest.mark.parametrize(
    ("expected", "table", "fields"),
    [
        (0.2427, "instance maps", {"method": "OpenVox", "dataset": REPLICA, "metric": "mIoU"}),
        (0.5466, "instance maps", {"method": "OpenVox", "dataset": SCANNET, "metric": "f-mIoU"}),
        (0.1980, "instance maps", {"method": "ConceptGraphs", "dataset": REPLICA, "metric": "accuracy"}),
        (0.3605, "instance maps", {"method": "HOV-SG", "dataset": SCANNET, "metric": "f-mIoU"}),
        (0.4364, "instance maps", {"method": "Open-Fusion", "dataset": REPLICA, "metric": "f-mIoU"}),
        (0.3237, "instance maps", {"method": NARADIO, "mode": "window", "dataset": REPLICA, "metric": "mIoU"}),
        (0.6250, "instance maps", {"method": NARADIO, "mode": "window", "dataset": SCANNET, "metric": "accuracy"}),
        (0.1857, "dense maps", {"method": "ConceptFusion", "dataset": SCANNET, "background": True, "metric": "mIoU"}),
        (0.3151, "dense maps", {"method": "ConceptFusion", "dataset": REPLICA, "background": False, "metric": "f-mIoU"}),
        (0.4129, "dense maps", {"method": "RayFronts", "dataset": SCANNET, "background": False, "metric": "mIoU"}),
        (0.5445, "dense maps", {"method": "RayFronts", "dataset": REPLICA, "background": True, "metric": "accuracy"}),
        (0.3923, "dense maps", {"method": NARADIO, "dataset": SCANNET, "background": True, "metric": "f-mIoU"}),
        (0.0881, "difference", {"method": NARADIO, "dataset": SCANNET, "metric": "mIoU"}),
        (-0.0044, "difference", {"method": CLIP_DINOISER, "dataset": REPLICA, "metric": "mIoU"}),
        (
            0.3777,
            "ablation of dense maps",
            {"method": CLIP_DINOISER, "layer": "dense", "dataset": REPLICA, "background": True, "metric": "f-mIoU"},
        ),
        (
            0.4306,
            "ablation of dense maps",
            {"method": CLIP_DINOISER, "layer": "fused_dense", "dataset": SCANNET, "background": True, "metric": "accuracy"},
        ),
        (
            0.6172,
            "ablation of dense maps",
            {"method": NARADIO, "layer": "dense", "dataset": REPLICA, "background": False, "metric": "f-mIoU"},
        ),
        (0.366, "lambda", {"method": NARADIO, "variance_ratio": 10.0, "metric": "mIoU"}),
        (0.404, "lambda", {"method": CLIP_DINOISER, "variance_ratio": 0.2, "metric": "f-mIoU"}),
        (0.525, "lambda", {"method": CLIP_DINOISER, "variance_ratio": 1.0, "metric": "accuracy"}),
        (0.3031, "HM3DSem", {"method": "Open-Fusion", "metric": "f-mIoU"}),
        (0.5538, "HM3DSem", {"method": NARADIO, "layer": "instances", "metric": "accuracy"}),
        (0.4622, "HM3DSem", {"method": NARADIO, "mode": "window", "metric": "f-mIoU"}),
        (0.3530, "HM3DSem", {"method": NARADIO, "mode": "window_no_evidence", "metric": "mIoU"}),
        (546, "memory", {"dataset": "HM3DSem 00847", "method": NARADIO, "mode": "window"}),
        (739, "memory", {"dataset": "HM3DSem 00890", "method": CLIP_DINOISER, "mode": "full"}),
        (354, "memory", {"dataset": "TartanGround Hospital", "method": NARADIO, "mode": "window"}),
        (2940, "memory", {"dataset": "Odin1 University", "method": CLIP_DINOISER, "layer": "dense"}),
        (14.59, "frame rates", {"device": "RTX 4090", "mode": "window", "method": CLIP_DINOISER, "dataset": SCANNET}),
        (3.54, "frame rates", {"device": "Jetson AGX Orin", "mode": "no fusion", "method": NARADIO, "dataset": REPLICA}),
    ],
)
def test_numbers_read_by_hand(expected, table, fields):
    if table == "difference":
        table = "ablation of instance maps"
        found = value(table, layer="fused_instances", **fields) - value(table, layer="instances", **fields)
    else:
        found = value(table, **fields)
    assert found == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize(("method", "chosen_lambda"), [(NARADIO, 1.0), (CLIP_DINOISER, 5.0)])
@pytest.mark.parametrize("metric", SCORES)
def test_the_chosen_lambda_gives_the_mean_of_the_two_datasets(method, chosen_lambda, metric):
    table = "ablation of instance maps"
    both = [value(table, method=method, layer="fused_instances", dataset=d, metric=metric) for d in (REPLICA, SCANNET)]
    chosen = value("lambda", method=method, variance_ratio=chosen_lambda, metric=metric)
    assert chosen == pytest.approx(sum(both) / 2, abs=0.00051)


@pytest.mark.parametrize(
    ("table", "ablation", "layer"),
    [
        ("instance maps", "ablation of instance maps", "fused_instances"),
        ("dense maps", "ablation of dense maps", "fused_dense"),
    ],
)
def test_results_and_ablations_repeat_the_same_numbers(table, ablation, layer):
    def keyed(name):
        found = rows(name, method=NARADIO, layer=layer, mode="full")
        return {(row.dataset, row.background, row.metric): row.value for row in found}

    assert keyed(table) == keyed(ablation)


def test_memory_halves_with_the_embedding_as_it_should():
    # Both encoders fill the same voxels, so the ratio of the dense columns is that of bytes per voxel: one number.
    scenes = {row.dataset for row in rows("memory")}
    assert len(scenes) == 9
    ratios = [
        value("memory", dataset=scene, method=NARADIO, layer="dense")
        / value("memory", dataset=scene, method=CLIP_DINOISER, layer="dense")
        for scene in scenes
    ]
    assert max(ratios) - min(ratios) < 0.005


def test_scenes_of_the_datasets():
    assert {dataset: len(scenes) for dataset, scenes in SCENES.items()} == {REPLICA: 8, SCANNET: 5, HM3DSEM: 7}
    assert len({scene for scenes in SCENES.values() for scene in scenes}) == 20
    assert {f"{HM3DSEM} {scene}" for scene in SCENES[HM3DSEM]} <= {row.dataset for row in rows("memory")}
