"""Evaluation of a map against the truth: all metrics of all layers.

Metrics of a layer, without background classes unless ``_with_background`` is in the name:

- ``mIoU``, ``f-mIoU``, ``accuracy``, ``mean_accuracy``, ``iou/NAME`` (``iou_with_background/NAME``) of each class;
- ``coverage``, the share of the truth's voxels with a voxel of the layer near them, and ``mIoU_covered``, the mIoU over
  these alone, for layers that do not cover the truth, such as the dense layer of a map with a window;
- ``ECE``, expected calibration error of the likeliest class of the nearest voxel;
- ``cosine``, mean cosine of the nearest voxel's embedding with the text of the true class, which does not depend on the
  other classes;
- ``precision@K``, ``localisation_error_m``, ``localised`` (share of first answers within the box of the nearest true
  instance), means over the queried classes;
- of the instance layers ``AP25``, ``AP50`` (class-agnostic, by top hypotheses, ranked by the weight of instances),
  ``over_segmentation`` and ``under_segmentation``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fus3dmaps_core.encoders.protocols import TextEncoder
from fus3dmaps_core.errors import MapError
from fus3dmaps_core.voxel_map.semantic_map import SemanticMap
from fus3dmaps_lab.evaluation.calibration import reliability
from fus3dmaps_lab.evaluation.ground_truth import VoxelTruth, voxel_keys
from fus3dmaps_lab.evaluation.instance_quality import average_precision, overlaps, partition
from fus3dmaps_lab.evaluation.matching import Neighbours, mode_of_neighbours, nearest_voxels, same_voxels
from fus3dmaps_lab.evaluation.prediction import Rule, layer_cosines, predict_classes, top_classes
from fus3dmaps_lab.evaluation.records import LAYERS
from fus3dmaps_lab.evaluation.retrieval import instance_scores, majority_classes, score_retrieval, true_objects
from fus3dmaps_lab.evaluation.segmentation_metrics import ClassSubset, score_segmentation, without_background

INSTANCE_LAYERS = ("instances", "fused_instances")
"""Layers of a map with a sliding window that hold everything it saw; its dense layer holds only the window."""

PRECISION_AT = (1, 3, 5)


@dataclass(frozen=True)
class EvaluationProtocol:
    """Details of an evaluation. The defaults are those of the published protocol, except the rule.

    Attributes:
        rule: Where a class must be likely to be predicted at all, see :mod:`fus3dmaps_lab.evaluation.prediction`.
        min_peak: Probability that it must reach there.
        min_probability: Least probability of a voxel's best class; otherwise the voxel gets none.
        reach_voxels: Greatest distance at which a voxel of the map counts for a voxel of the truth, for coverage, instance
            quality and retrieval. Segmentation has no such limit.
        min_voxels: Least number of voxels of an instance that is ranked in retrieval.
    """

    rule: Rule = "global"
    min_peak: float = 0.5
    min_probability: float = 0.1
    reach_voxels: float = 2.0
    min_voxels: int = 4


def evaluate_map(
    semantic_map: SemanticMap,
    texts: TextEncoder | NDArray[np.floating],
    truth: VoxelTruth,
    class_names: Sequence[str],
    background: frozenset[int],
    layers: Sequence[str] = LAYERS,
    logit_scale: float = 100.0,
    k: int = 5,
    protocol: EvaluationProtocol | None = None,
    truth_without_background: VoxelTruth | None = None,
) -> dict[str, dict[str, float]]:
    """Evaluate layers of a map, which must not change meanwhile.

    Args:
        semantic_map: The map; with a window, it should have been fused.
        texts: Encoder of the class names, or (c, d) embeddings of classes 1 .. c, any length but 0.
        truth: The truth with all classes.
        class_names: Name of each class by its number; the first stands for nothing and is never queried.
        background: Numbers of the background classes.
        layers: Some of LAYERS.
        logit_scale: Factor of the cosines in the softmax.
        k: Number of nearest voxels of the map whose most frequent class a voxel of the truth gets; 0 takes the same voxel.
        protocol: Details; None takes the defaults.
        truth_without_background: Truth in which a voxel that shows any other class has no background class, as made by
            :func:`voxel_truth_from_frames`. None takes the truth with background classes removed.

    Returns:
        Metrics by name, by layer; NaN if undefined.

    Raises:
        MapError: The truth has another voxel size, a class has no name, or the texts do not fit the classes.
        QueryError: A layer is unknown.
    """
    plain = truth_without_background or truth.without(background)
    for each in (truth, plain):
        _check_truth(each, semantic_map.config.voxel_size_m, class_names)
    everything, objects = without_background(class_names, ()), without_background(class_names, background)
    if isinstance(texts, np.ndarray):
        vectors: NDArray[np.floating] = texts
    else:
        vectors = texts.encode_text(everything.names)
    if len(vectors) != len(everything.names):
        raise MapError(f"texts: {len(vectors)} embeddings do not go with {len(everything.names)} classes")
    views = [_View("", objects, plain), _View("_with_background", everything, truth)]
    judge = _Judge(semantic_map, truth, logit_scale, k, protocol or EvaluationProtocol())
    return {layer: judge.metrics(layer, vectors, views) for layer in layers}


def _check_truth(truth: VoxelTruth, voxel_size_m: float, class_names: Sequence[str]) -> None:
    if truth.voxel_size_m != voxel_size_m:
        raise MapError(f"truth: its voxels have {truth.voxel_size_m} m, the map's {voxel_size_m} m")
    if len(truth.classes) and truth.classes.max() >= len(class_names):
        raise MapError(f"truth: class {truth.classes.max()} has no name")


@dataclass(frozen=True)
class _View:
    """A choice of classes, with the ending of its metrics' names and its truth."""

    ending: str
    subset: ClassSubset
    truth: VoxelTruth


class _Judge:
    """The parts of an evaluation that all layers of a map share."""

    def __init__(
        self, semantic_map: SemanticMap, truth: VoxelTruth, logit_scale: float, k: int, protocol: EvaluationProtocol
    ) -> None:
        self._map, self._truth, self._protocol = semantic_map, truth, protocol
        self._logit_scale, self._k = logit_scale, k
        self._size_m = semantic_map.config.voxel_size_m
        self._nearest: list[tuple[NDArray[np.int64], NDArray[np.float64], Neighbours]] = []
        self._instances, voxels = semantic_map.instances(), semantic_map.voxels()
        self._keys = voxel_keys(voxels.centers_m, self._size_m)
        place_of_id = np.searchsorted(self._instances.ids, voxels.top_instance)
        self._top = np.where(voxels.top_instance >= 0, place_of_id, -1)
        held = self._top >= 0
        near = self._neighbours(self._keys[held], truth)
        self._covering = _of_nearest(near, self._top[held], protocol.reach_voxels)
        count = len(self._instances.ids)
        self._instance_classes = majority_classes(self._covering, truth.classes, count)
        self._objects = true_objects(truth)

    def metrics(self, layer: str, vectors: NDArray[np.floating], views: Sequence[_View]) -> dict[str, float]:
        centers_m, cosines = layer_cosines(self._map, layer, vectors)
        keys = voxel_keys(centers_m, self._size_m)
        top = np.append(self._top, -1)[same_voxels(keys, self._keys)]
        scores = instance_scores(top, cosines, len(self._instances.ids), self._protocol.min_voxels)
        found: dict[str, float] = {}
        for view in views:
            found |= self._segmentation(keys, cosines, view)
            found |= self._retrieval(scores, view)
            if layer in INSTANCE_LAYERS:
                found |= self._instance_quality(view)
        return found

    def _segmentation(self, keys: NDArray[np.int64], cosines: NDArray[np.float32], view: _View) -> dict[str, float]:
        protocol, subset, end = self._protocol, view.subset, view.ending
        of_view = cosines[:, subset.old_numbers - 1]
        predicted = predict_classes(
            of_view, self._logit_scale, protocol.min_probability, protocol.rule, min_peak=protocol.min_peak
        )
        near = self._neighbours(keys, view.truth)
        if self._k:
            matched = mode_of_neighbours(near, predicted)
        else:
            matched = np.append(predicted, np.int32(0))[same_voxels(view.truth.positions, keys)]
        true, count = subset.new_numbers[view.truth.classes], len(subset.names)
        covered = _of_nearest(near, np.zeros(len(keys), np.int64), protocol.reach_voxels) >= 0
        scores = score_segmentation(true, matched, count)
        likeliest, probability = top_classes(of_view, self._logit_scale)
        judged = (true > 0) if near.places.shape[1] else np.zeros(len(true), bool)
        speaker = near.places[judged, 0] if near.places.shape[1] else np.empty(0, np.int64)
        curve = reliability(probability[speaker], likeliest[speaker] == true[judged])
        return {
            f"mIoU{end}": scores.miou,
            f"f-mIoU{end}": scores.f_miou,
            f"accuracy{end}": scores.accuracy,
            f"mean_accuracy{end}": scores.mean_accuracy,
            f"mIoU_covered{end}": score_segmentation(true[covered], matched[covered], count).miou,
            f"coverage{end}": _mean(covered[true > 0]),
            f"ECE{end}": curve.expected_error,
            f"cosine{end}": _mean(of_view[speaker, true[judged] - 1].astype(np.float64)),
            **{f"iou{end}/{name}": float(value) for name, value in zip(subset.names, scores.iou, strict=True)},
        }

    def _retrieval(self, scores: NDArray[np.float64], view: _View) -> dict[str, float]:
        classes = view.subset.old_numbers.tolist()
        centroids_m = self._instances.centroids_m
        result = score_retrieval(scores, self._instance_classes, centroids_m, self._objects, classes, PRECISION_AT)
        return {
            **{f"precision@{k}{view.ending}": _mean(result.precision[k]) for k in PRECISION_AT},
            f"localisation_error_m{view.ending}": _mean(
                result.localisation_error_m[np.isfinite(result.localisation_error_m)]
            ),
            f"localised{view.ending}": _mean(result.inside_box),
        }

    def _instance_quality(self, view: _View) -> dict[str, float]:
        members = np.flatnonzero(self._covering >= 0)
        true = np.where(view.subset.new_numbers[self._truth.classes] > 0, self._truth.instances, 0)
        overlap = overlaps(members, self._covering[members], len(self._instances.ids), true)
        pieces = partition(overlap)
        return {
            f"AP25{view.ending}": average_precision(overlap, self._instances.weights, 0.25),
            f"AP50{view.ending}": average_precision(overlap, self._instances.weights, 0.5),
            f"over_segmentation{view.ending}": pieces.over_segmentation,
            f"under_segmentation{view.ending}": pieces.under_segmentation,
        }

    def _neighbours(self, keys: NDArray[np.int64], truth: VoxelTruth) -> Neighbours:
        """Find the nearest voxels, once for layers with the same voxels."""
        positions = truth.positions
        for known_keys, known_positions, neighbours in self._nearest:
            if np.array_equal(known_keys, keys) and np.array_equal(known_positions, positions):
                return neighbours
        neighbours = nearest_voxels(positions, keys, max(self._k, 1))
        self._nearest.append((keys, positions, neighbours))
        return neighbours


def _of_nearest(near: Neighbours, values: NDArray[np.int64], reach_voxels: float) -> NDArray[np.int64]:
    """Return the value of the nearest voxel, -1 if none is within reach."""
    if not near.places.shape[1]:
        return np.full(len(near.places), -1, np.int64)
    return np.where(near.distances[:, 0] <= reach_voxels, values[near.places[:, 0]], -1)


def _mean(values: NDArray[np.floating] | NDArray[np.bool_]) -> float:
    return float(np.mean(values)) if len(values) else float("nan")
