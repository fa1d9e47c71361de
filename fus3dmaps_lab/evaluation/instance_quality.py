"""Agreement of a map's instances with the true ones, whatever their class.

Instances are sets of voxels of the truth. A voxel of the truth belongs to the instances of the map's voxel nearest to it. A
map's instances may overlap (all hypotheses of a voxel) or not (its top hypothesis only); true ones never overlap.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fus3dmaps_core.errors import MapError


@dataclass(frozen=True)
class Overlaps:
    """Numbers of voxels that predicted and true instances share.

    Attributes:
        predicted: (p,) places of the predicted instances of all overlapping pairs.
        true: (p,) places of the true instances of these pairs.
        shared: (p,) int64 shared voxels of these pairs.
        predicted_sizes: (a,) int64 voxels of each predicted instance.
        true_sizes: (b,) int64 voxels of each true instance.
        ids: (b,) int32 number of each true instance.
    """

    predicted: NDArray[np.int64]
    true: NDArray[np.int64]
    shared: NDArray[np.int64]
    predicted_sizes: NDArray[np.int64]
    true_sizes: NDArray[np.int64]
    ids: NDArray[np.int32]

    @property
    def iou(self) -> NDArray[np.float64]:
        """Intersection over union of each pair, (p,)."""
        unions = self.predicted_sizes[self.predicted] + self.true_sizes[self.true] - self.shared
        return np.asarray(self.shared / unions)


def overlaps(
    members: NDArray[np.integer], predicted_of_member: NDArray[np.integer], count: int, true: NDArray[np.integer]
) -> Overlaps:
    """Count the voxels that predicted and true instances share.

    Args:
        members: (m,) places of voxels of the truth that belong to a predicted instance. A voxel may come several times, but
            only once for each instance.
        predicted_of_member: (m,) predicted instance of each, in 0 .. count - 1.
        count: Number of predicted instances.
        true: (n,) true instance of each voxel, 0 for none.

    Raises:
        MapError: The arrays of members differ in length, or an instance is out of range.
    """
    if members.shape != predicted_of_member.shape:
        raise MapError(f"members: {members.shape} voxels do not go with {predicted_of_member.shape} instances")
    if len(members) and not 0 <= predicted_of_member.min() <= predicted_of_member.max() < count:
        raise MapError(f"members: instances must be in 0 to {count - 1}")
    numbers, place_of, sizes = np.unique(true, return_inverse=True, return_counts=True)
    kept = numbers > 0
    places = np.where(kept[place_of], np.cumsum(kept)[place_of] - 1, -1)
    predicted_sizes = np.bincount(predicted_of_member, minlength=count)
    true_of_member = places[members]
    inside = true_of_member >= 0
    width = max(int(kept.sum()), 1)
    pairs, shared = np.unique(
        predicted_of_member[inside].astype(np.int64) * width + true_of_member[inside], return_counts=True
    )
    return Overlaps(pairs // width, pairs % width, shared, predicted_sizes, sizes[kept], numbers[kept].astype(np.int32))


def average_precision(overlap: Overlaps, scores: NDArray[np.floating], min_iou: float) -> float:
    """Compute the average precision: the mean over true instances of the precision at the point where each is found.

    In order of falling score, each predicted instance takes the free true one with the highest IoU of at least ``min_iou``
    (ties: the lowest place) and is then right. If it takes none and most of its voxels belong to no true instance, it is
    left out, because unlabelled does not mean wrong. Predicted instances without any voxel of the truth are left out too.

    Args:
        overlap: Overlaps of the instances.
        scores: (a,) score of each predicted instance; ties: the lower place first.
        min_iou: Least IoU, in (0, 1].

    Returns:
        In [0, 1]; NaN if there is no true instance.
    """
    if not len(overlap.true_sizes):
        return float("nan")
    right, counted = _matched(overlap, scores, min_iou)
    right = right[counted]
    precision = np.cumsum(right) / np.arange(1, len(right) + 1)
    return float(precision[right].sum() / len(overlap.true_sizes))


@dataclass(frozen=True)
class Partition:
    """Over- and under-segmentation; 1 is perfect, NaN means that nothing is covered.

    Attributes:
        over_segmentation: Mean number of predicted instances per true one. A predicted instance counts for the true one
            that has more than half of its voxels; true ones without any do not count.
        under_segmentation: Mean number of true instances per predicted one. A true instance counts for the predicted one
            that has more than half of its voxels; predicted ones without any do not count.
    """

    over_segmentation: float
    under_segmentation: float


def partition(overlap: Overlaps) -> Partition:
    """Compute over- and under-segmentation of predicted instances."""
    in_true = 2 * overlap.shared > overlap.predicted_sizes[overlap.predicted]
    in_predicted = 2 * overlap.shared > overlap.true_sizes[overlap.true]
    return Partition(_mean_group(overlap.true[in_true]), _mean_group(overlap.predicted[in_predicted]))


def _mean_group(groups: NDArray[np.int64]) -> float:
    """Compute the mean size of the groups that have a member."""
    return len(groups) / len(np.unique(groups)) if len(groups) else float("nan")


def _matched(overlap: Overlaps, scores: NDArray[np.floating], min_iou: float) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return, by falling score, which predicted instances take a true one, and which are counted at all."""
    inside = np.bincount(overlap.predicted, weights=overlap.shared, minlength=len(overlap.predicted_sizes))
    counted = 2 * inside > overlap.predicted_sizes
    iou = overlap.iou
    reaches = iou >= min_iou
    predicted, true, iou = overlap.predicted[reaches], overlap.true[reaches], iou[reaches]
    best_first = np.lexsort((true, -iou, predicted))
    predicted, true = predicted[best_first], true[best_first]
    starts = np.searchsorted(predicted, np.arange(len(overlap.predicted_sizes) + 1))
    free = np.ones(len(overlap.true_sizes), bool)
    order = np.argsort(-np.asarray(scores, np.float64), kind="stable")
    right = np.zeros(len(order), bool)
    for turn, place in enumerate(order.tolist()):
        for candidate in true[starts[place] : starts[place + 1]].tolist():
            if free[candidate]:
                free[candidate], right[turn] = False, True
                break
    return right, counted[order] | right
