"""A labelled scene through all modes: a simulated building stands in for a dataset, with models that see its truth."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from fus3dmaps_core.config.schema import Config
from fus3dmaps_core.errors import RecordingError
from fus3dmaps_core.frame import PosedFrame
from fus3dmaps_lab.evaluation import dataset_runs
from fus3dmaps_lab.evaluation.dataset_runs import evaluate_dataset
from fus3dmaps_lab.evaluation.evaluate_map import INSTANCE_LAYERS
from fus3dmaps_lab.evaluation.records import LAYERS, MODES
from fus3dmaps_lab.simulation.building.simulated_building import SimulatedBuilding
from fus3dmaps_lab.simulation.models.encoder_statistics import EncoderStatistics
from fus3dmaps_lab.simulation.models.oracle import Oracle
from fus3dmaps_lab.simulation.models.simulated_encoders import simulated_trio
from fus3dmaps_lab.simulation.models.simulated_segmenter import SegmenterStatistics, SimulatedSegmenter

CONFIG = Config().with_values({"image.width": 320, "image.height": 240})


class LabelledBuilding:
    """A building as a dataset with label images and, if wanted, with points."""

    name, scene = "building", "simulated ward"

    def __init__(self, with_points: bool = False, labelled: bool = True) -> None:
        self.building = SimulatedBuilding(seed=2, rooms_per_storey=1, frames=30)
        self.oracle = Oracle()
        self.truth = self.building.truth
        self.class_names, self.background = self.truth.class_names, self.truth.background
        self.intrinsics = self.building.intrinsics
        self._with_points, self._labelled = with_points, labelled
        self.labels_read = 0

    def __len__(self) -> int:
        return len(self.building)

    def __iter__(self) -> Iterator[PosedFrame]:
        for labelled in self.building:
            self.oracle.look(labelled)
            yield labelled.frame

    def label_image(self, index: int) -> np.ndarray:
        self.labels_read += 1
        return self.truth.class_of_part[self.building.frame(index).parts] * self._labelled

    def instance_image(self, index: int) -> np.ndarray:
        return self.truth.instance_of_part[self.building.frame(index).parts]

    def ground_truth_points(self):
        if not self._with_points:
            return None
        surface = self.building.surface()
        return surface.points_m, self.truth.class_of_part[surface.parts], self.truth.instance_of_part[surface.parts]


@pytest.fixture
def with_models(monkeypatch):
    def make(dataset: LabelledBuilding) -> LabelledBuilding:
        trio = simulated_trio(dataset.oracle, dataset.truth, EncoderStatistics(patch_variance=0.5, crop_variance=0.5))
        segmenter = SimulatedSegmenter(dataset.oracle, dataset.truth, SegmenterStatistics())
        monkeypatch.setattr(dataset_runs, "load_trio", lambda *_: trio)
        monkeypatch.setattr(dataset_runs, "load_segmenter", lambda *_: segmenter)
        return dataset

    return make


@pytest.mark.parametrize("with_points", [False, True])
def test_every_mode_is_compared_with_the_labels(with_models, with_points) -> None:
    dataset = with_models(LabelledBuilding(with_points))
    told: list[tuple[int, int]] = []
    records = evaluate_dataset(dataset, CONFIG, lambda done, total: told.append((done, total)))
    assert told == [(done, 30) for done in range(1, 31)]
    assert (dataset.labels_read == 0) == with_points
    assert {(r.layer, r.mode) for r in records} == {(layer, "full") for layer in LAYERS} | {
        (layer, mode) for layer in INSTANCE_LAYERS for mode in MODES[1:]
    }
    assert {(r.scene, r.seed) for r in records} == {("simulated ward", 0)}
    # Models that see the truth with little noise: what was seen is right. Points have what was not seen, too.
    of_all, of_objects = (
        {r.layer: r.value for r in records if (r.mode, r.metric) == ("full", metric)}
        for metric in ("accuracy_with_background", "accuracy")
    )
    assert min(of_all["dense"], of_all["fused_dense"]) > (0.7 if with_points else 0.9)
    assert min(of_objects[layer] for layer in INSTANCE_LAYERS) > 0.5


def test_the_window_is_that_of_the_configuration_or_the_published_one(with_models) -> None:
    tiny = evaluate_dataset(with_models(LabelledBuilding()), CONFIG.with_values({"fusion.window_radius_m": 0.5}))
    wide = evaluate_dataset(with_models(LabelledBuilding()), CONFIG)
    score = [
        {r.metric: r.value for r in records if (r.layer, r.mode) == ("fused_instances", "window_no_evidence")}
        for records in (tiny, wide)
    ]
    assert score[0]["cosine"] != score[1]["cosine"]


def test_a_scene_without_labels_is_refused_by_name(with_models) -> None:
    with pytest.raises(RecordingError, match="simulated ward"):
        evaluate_dataset(with_models(LabelledBuilding(labelled=False)), CONFIG)
