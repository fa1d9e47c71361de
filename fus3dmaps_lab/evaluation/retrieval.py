"""Evaluation of retrieval: a map's instances ranked by a text, as a query ranks them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fus3dmaps_lab.evaluation.ground_truth import VoxelTruth

NOWHERE = -1
"""Class of an instance that covers no voxel of the truth."""


@dataclass(frozen=True)
class TrueObjects:
    """The true instances, by ascending number.

    Attributes:
        ids: (b,) int32.
        classes: (b,) int32 class of most of their voxels; ties: the lowest.
        centroids_m: (b, 3) float64 mean of the centres of their voxels, metres, map frame.
        boxes_min_m: (b, 3) float64 smallest corner of their voxels.
        boxes_max_m: (b, 3) float64 largest corner.
    """

    ids: NDArray[np.int32]
    classes: NDArray[np.int32]
    centroids_m: NDArray[np.float64]
    boxes_min_m: NDArray[np.float64]
    boxes_max_m: NDArray[np.float64]


@dataclass(frozen=True)
class RetrievalScores:
    """Scores of the answers to one text per queried class.

    Attributes:
        classes: (q,) int32 queried classes.
        precision: By k, (q,) float64 share of the k best instances (of all, if there are fewer) that have the class; 0 if
            the map has no instance.
        localisation_error_m: (q,) float64 distance of the best instance's centroid from the nearest centroid of a true
            instance of the class; NaN if the map has no instance.
        inside_box: (q,) float64, 1 if the best instance's centroid is in the box of that true instance, else 0.
    """

    classes: NDArray[np.int32]
    precision: dict[int, NDArray[np.float64]]
    localisation_error_m: NDArray[np.float64]
    inside_box: NDArray[np.float64]


def true_objects(truth: VoxelTruth) -> TrueObjects:
    """Locate the true instances."""
    inside = truth.instances > 0
    ids, place = np.unique(truth.instances[inside], return_inverse=True)
    centers_m, classes = truth.centers_m[inside], truth.classes[inside]
    counts = np.bincount(place, minlength=len(ids))
    sums = [np.bincount(place, weights=centers_m[:, axis], minlength=len(ids)) for axis in range(3)]
    low, high = np.full((len(ids), 3), np.inf), np.full((len(ids), 3), -np.inf)
    np.minimum.at(low, place, centers_m)
    np.maximum.at(high, place, centers_m)
    half = truth.voxel_size_m / 2
    return TrueObjects(
        ids, _most_frequent(place, classes, len(ids)), np.stack(sums, axis=1) / counts[:, None], low - half, high + half
    )


def instance_scores(
    instance_of_voxel: NDArray[np.integer], cosines: NDArray[np.floating], count: int, min_voxels: int = 1
) -> NDArray[np.float64]:
    """Compute the score of each instance for each text: the mean over its voxels, as in a query.

    Args:
        instance_of_voxel: (n,) instance that occupies each voxel of a layer, in 0 .. count - 1, or -1.
        cosines: (n, c) cosines of these voxels.
        count: Number of instances.
        min_voxels: Instances with fewer of these voxels are not ranked.

    Returns:
        (count, c) float64, NaN for an instance that is not ranked.
    """
    occupied = instance_of_voxel >= 0
    owners = instance_of_voxel[occupied]
    voxels = np.bincount(owners, minlength=count).astype(np.float64)
    voxels[voxels < max(min_voxels, 1)] = np.nan
    scores = np.empty((count, cosines.shape[1]))
    for column, values in enumerate(cosines.T):
        scores[:, column] = np.bincount(owners, weights=values[occupied], minlength=count) / voxels
    return scores


def majority_classes(instance_of_voxel: NDArray[np.integer], classes: NDArray[np.integer], count: int) -> NDArray[np.int32]:
    """Return the true class of most voxels that each instance covers, without unknown ones; ties go to the lowest.

    Args:
        instance_of_voxel: (n,) instance that covers each voxel of the truth, in 0 .. count - 1, or -1.
        classes: (n,) true class of each, 0 where unknown.
        count: Number of instances.

    Returns:
        (count,) int32; 0 for an instance that covers only unknown voxels, NOWHERE for one that covers no voxel.
    """
    covered = instance_of_voxel >= 0
    known = covered & (classes > 0)
    found = _most_frequent(instance_of_voxel[known], classes[known], count)
    covers = np.bincount(instance_of_voxel[covered], minlength=count) > 0
    return np.where(covers, found, NOWHERE).astype(np.int32)


def score_retrieval(
    scores: NDArray[np.floating],
    instance_classes: NDArray[np.integer],
    centroids_m: NDArray[np.floating],
    objects: TrueObjects,
    classes: Sequence[int],
    ks: Sequence[int] = (1, 3, 5),
) -> RetrievalScores:
    """Score the query for each class that has a true instance.

    Instances of unknown class are not ranked, because they may be right or wrong. Instances that cover no voxel of the truth
    are ranked, and are wrong.

    Args:
        scores: (count, c) of the map's instances for each class 1 .. c, NaN for those that are not ranked; ties: the lower
            place first.
        instance_classes: (count,) true classes by :func:`majority_classes`.
        centroids_m: (count, 3) metres, map frame.
        objects: The true instances.
        classes: Classes to query; those without a true instance are left out.
        ks: Values of k for precision.
    """
    asked = [each for each in classes if np.any(objects.classes == each)]
    precision = {k: np.zeros(len(asked)) for k in ks}
    error_m, inside = np.full(len(asked), np.nan), np.zeros(len(asked))
    for row, number in enumerate(asked):
        column = scores[:, number - 1]
        rankable = np.flatnonzero(np.isfinite(column) & (instance_classes != 0))
        ranked = rankable[np.argsort(-column[rankable], kind="stable")]
        if not len(ranked):
            continue
        for k in ks:
            precision[k][row] = np.mean(instance_classes[ranked[:k]] == number)
        mine = np.flatnonzero(objects.classes == number)
        centroid_m = np.asarray(centroids_m[ranked[0]], np.float64)
        distances_m = np.linalg.norm(objects.centroids_m[mine] - centroid_m, axis=1)
        nearest = mine[distances_m.argmin()]
        error_m[row] = distances_m.min()
        inside[row] = np.all((centroid_m >= objects.boxes_min_m[nearest]) & (centroid_m <= objects.boxes_max_m[nearest]))
    return RetrievalScores(np.array(asked, np.int32), precision, error_m, inside)


def _most_frequent(groups: NDArray[np.integer], labels: NDArray[np.integer], count: int) -> NDArray[np.int32]:
    """Return the most frequent label of each group, 0 for an empty group; ties go to the lowest."""
    found = np.zeros(count, np.int32)
    if len(groups):
        width = int(labels.max()) + 1
        pairs, counts = np.unique(groups.astype(np.int64) * width + labels, return_counts=True)
        order = np.lexsort((-(pairs % width), counts, pairs // width))
        # In each group the last write wins: the highest count, with ties the lowest label.
        ends = np.flatnonzero(np.diff(pairs[order] // width, append=-1))
        found[pairs[order][ends] // width] = pairs[order][ends] % width
    return found
