"""Test of the paper's claims on simulated buildings: one building per seed, mapped in every compared way.

Everything here is a simulation: the numbers say how the map behaves with stated statistics of encoders and segmenter, not
how good any real model is.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from typing import Any

import numpy as np

from fus3dmaps_core.pipeline import Pipeline
from fus3dmaps_lab.evaluation.building_runs import BuildingRun, Variant
from fus3dmaps_lab.evaluation.curves import UNFUSED
from fus3dmaps_lab.evaluation.evaluate_map import INSTANCE_LAYERS, evaluate_map
from fus3dmaps_lab.evaluation.ground_truth import voxel_truth
from fus3dmaps_lab.evaluation.records import LAYERS, MODES, CurvePoint, Record
from fus3dmaps_lab.simulation.building.simulated_building import SimulatedBuilding
from fus3dmaps_lab.simulation.models.encoder_statistics import DENSE_SAMPLES, EncoderStatistics
from fus3dmaps_lab.simulation.models.simulated_segmenter import SegmenterStatistics

SCENE = "simulated building"
_MERGING = {"map.merge_overlap": 0.5, "map.merge_cosine": -1.0}  # By overlap alone: embeddings of few crops are too noisy.

ASSOCIATIONS: dict[str, dict[str, Any]] = {
    "IoU": {},
    "visible IoU": {"map.association": "visible_iou"},
    "IoU + merging": _MERGING,
    "visible IoU + merging": {"map.association": "visible_iou", **_MERGING},
}
"""Ways to associate proposals with instances, as parameters that differ from the defaults."""


@dataclass(frozen=True)
class Study:
    """The building and the comparisons of every seed.

    Attributes:
        storeys: Number of storeys.
        rooms_per_storey: Number of rooms on each storey.
        frames: Number of frames along the route; None takes as many as the rooms need.
        statistics: Statistics of the encoders; their ``variance_ratio`` is lambda unless it is swept.
        segmenter: Statistics of the segmenter.
        window_radius_m: Radius of the modes with a window.
        noise_ratios: R^D / R^I of each lambda sweep; each is swept with both models of the noise.
        lambdas: Values of a sweep.
        window_radii_m: Radii of the sweep over radii.
        associations: Parameters of each way to associate, by its name.
        settings: Parameters of every map that differ from the defaults; compared parameters override them.
    """

    storeys: int = 1
    rooms_per_storey: int = 6
    frames: int | None = None
    statistics: EncoderStatistics = field(default_factory=EncoderStatistics)
    segmenter: SegmenterStatistics = field(default_factory=SegmenterStatistics)
    window_radius_m: float = 6.0
    noise_ratios: tuple[float, ...] = ()
    lambdas: tuple[float, ...] = (0.02, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 50.0)
    window_radii_m: tuple[float, ...] = ()
    associations: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    settings: Mapping[str, Any] = field(default_factory=dict)


def study_building(
    study: Study, seed: int, on_progress: Callable[[int, int], object] | None = None
) -> tuple[list[Record], list[CurvePoint]]:
    """Build, map and evaluate the building of one seed.

    Args:
        study: The building and the comparisons.
        seed: Seed of the building, the sensor and the simulated models.
        on_progress: Called with the number of frames mapped and of all frames.

    Returns:
        Records of the three modes, and the points of the curves.
    """
    building = SimulatedBuilding(
        seed=seed, storeys=study.storeys, rooms_per_storey=study.rooms_per_storey, frames=study.frames
    )
    size = (building.intrinsics.width, building.intrinsics.height)
    run = BuildingRun(building.truth, size, _variants(study), seed, study.segmenter)
    run.feed(building, (lambda done: on_progress(done, len(building))) if on_progress else None)
    judge = _Judge(building, run.pipelines["full"].config.map.voxel_size_m)
    records = [
        Record(SCENE, seed, layer, mode, metric, value)
        for mode in MODES
        for layer, metrics in judge.scores(run.pipelines[mode], LAYERS if mode == "full" else INSTANCE_LAYERS).items()
        for metric, value in metrics.items()
    ]
    points = [
        CurvePoint(experiment, curve, seed, x, metric, value)
        for experiment, curve, x, metrics in _curves(study, run.pipelines, judge)
        for metric, value in metrics.items()
    ]
    return records, points


def with_noise_ratio(statistics: EncoderStatistics, ratio: float) -> EncoderStatistics:
    """Return the statistics with another R^D / R^I; the product of the two stays."""
    mean = float(np.sqrt(statistics.patch_variance * statistics.crop_variance))
    return replace(statistics, patch_variance=mean * ratio**0.5, crop_variance=mean / ratio**0.5)


def _noise_models(statistics: EncoderStatistics) -> dict[str, EncoderStatistics]:
    """Return statistics by experiment. Single patches are equally noisy in both; crops of counted observations far less."""
    counted = statistics.patch_variance * DENSE_SAMPLES
    return {
        "lambda": replace(statistics, noise_per="observation", patch_variance=counted, crop_variance=counted),
        "lambda_per_embedding": statistics,
    }


def _variants(study: Study) -> dict[str, Variant]:
    window = {"fusion.window_radius_m": study.window_radius_m}
    plain = study.statistics
    variants = {
        "full": Variant({"fusion.window_radius_m": 0.0}, plain),
        "window": Variant(window, plain),
        "window_no_evidence": Variant({**window, "fusion.keep_most_evidence": False}, plain),
    }
    for (experiment, noisy), ratio in product(_noise_models(plain).items(), study.noise_ratios):
        noisy = with_noise_ratio(noisy, ratio)
        variants[f"{experiment} {_ratio_name(ratio)}"] = Variant({"fusion.window_radius_m": 0.0}, noisy)
    for radius_m in study.window_radii_m:
        variants[_radius_name(radius_m)] = Variant({"fusion.window_radius_m": radius_m}, plain)
    for name, settings in study.associations.items():
        variants[name] = Variant({"fusion.window_radius_m": 0.0, **settings}, plain)
    return {name: replace(each, settings={**study.settings, **each.settings}) for name, each in variants.items()}


def _ratio_name(ratio: float) -> str:
    return f"R^D / R^I = {ratio:g}"


def _radius_name(radius_m: float) -> str:
    return f"window of {radius_m:g} m"


class _Judge:
    """Compares maps with the ground truth of the building."""

    def __init__(self, building: SimulatedBuilding, voxel_size_m: float) -> None:
        truth, surface = building.truth, building.surface()
        self._names, self._background = truth.class_names, truth.background
        self._voxels = voxel_truth(
            surface.points_m, truth.class_of_part[surface.parts], truth.instance_of_part[surface.parts], voxel_size_m
        )

    def scores(self, pipeline: Pipeline, layers: Sequence[str]) -> dict[str, dict[str, float]]:
        trio = pipeline.trio
        return evaluate_map(
            pipeline.semantic_map, trio.text, self._voxels, self._names, self._background, layers, trio.logit_scale
        )


def _curves(
    study: Study, pipelines: Mapping[str, Pipeline], judge: _Judge
) -> Iterator[tuple[str, str, float, dict[str, float]]]:
    """Yield experiment, curve, x and metrics of every point."""
    for experiment, ratio in product(_noise_models(study.statistics), study.noise_ratios):
        pipeline = pipelines[f"{experiment} {_ratio_name(ratio)}"]
        for value in study.lambdas:
            pipeline.semantic_map.variance_ratio = value
            pipeline.semantic_map.fuse(full=True)
            scores = judge.scores(pipeline, ("fused_instances", "fused_dense"))
            dense = {f"fused_dense/{name}": each for name, each in _headline(scores["fused_dense"]).items()}
            yield experiment, _ratio_name(ratio), value, _headline(scores["fused_instances"]) | dense
    for radius_m in study.window_radii_m:
        for layer, metrics in judge.scores(pipelines[_radius_name(radius_m)], INSTANCE_LAYERS).items():
            yield "window_radius", layer, radius_m, _headline(metrics)
    for name in study.associations:
        pipeline = pipelines[name]
        for layer, metrics in judge.scores(pipeline, INSTANCE_LAYERS).items():
            count = float(pipeline.semantic_map.instance_count)
            yield (
                "association",
                name if layer == "fused_instances" else name + UNFUSED,
                0.0,
                {
                    **{name: value for name, value in metrics.items() if not name.startswith("iou")},
                    "instances": count,
                },
            )


def _headline(metrics: Mapping[str, float]) -> dict[str, float]:
    return {name: metrics[name] for name in ("mIoU", "f-mIoU", "accuracy", "cosine", "mIoU_with_background")}
