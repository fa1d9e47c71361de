"""Metrics of semantic segmentation over voxels, and the choice of evaluated classes."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fus3dmaps_core.errors import MapError


@dataclass(frozen=True)
class ClassSubset:
    """A choice of classes with new numbers 1 .. m, in the order of their old ones.

    Attributes:
        names: (m,) names of the classes, which are the prompts.
        old_numbers: (m,) int32 old number of each class.
        new_numbers: (c + 1,) int32 new number by old number, 0 for nothing and for classes left out.
    """

    names: tuple[str, ...]
    old_numbers: NDArray[np.int32]
    new_numbers: NDArray[np.int32]


def without_background(class_names: Sequence[str], background: Iterable[int]) -> ClassSubset:
    """Leave out the background classes: their names are not prompted, and their numbers become 0.

    Args:
        class_names: Name of each class; the first stands for nothing and is never queried.
        background: Numbers of the classes to leave out; if empty, all remain.

    Raises:
        MapError: A number is not a class, or no class is left.
    """
    ignored = set(background)
    if not ignored <= set(range(1, len(class_names))):
        raise MapError(f"background: {sorted(ignored)} are not all among the classes 1 to {len(class_names) - 1}")
    kept = [number for number in range(1, len(class_names)) if number not in ignored]
    if not kept:
        raise MapError("class_names: no class is left to be evaluated")
    new_numbers = np.zeros(len(class_names), np.int32)
    new_numbers[kept] = np.arange(1, len(kept) + 1)
    return ClassSubset(tuple(class_names[number] for number in kept), np.array(kept, np.int32), new_numbers)


@dataclass(frozen=True)
class SegmentationScores:
    """Scores over the voxels that have a true class.

    Attributes:
        iou: (c,) float64 of classes 1 .. c, TP / (TP + FP + FN); NaN if the class does not occur (TP + FN = 0).
        miou: Mean over the classes that occur; NaN without any.
        f_miou: Mean over these, weighted by their frequency.
        accuracy: Share of voxels with the right class; a voxel without a prediction counts as wrong.
        mean_accuracy: Mean of TP / (TP + FN) over the classes that occur.
    """

    iou: NDArray[np.float64]
    miou: float
    f_miou: float
    accuracy: float
    mean_accuracy: float


def confusion(true: NDArray[np.integer], predicted: NDArray[np.integer], class_count: int) -> NDArray[np.int64]:
    """Count the voxels by true and predicted class: (c + 1, c + 1) int64, nothing first.

    Args:
        true: (n,) classes in 0 .. c.
        predicted: (n,) classes in 0 .. c.
        class_count: c.

    Raises:
        MapError: The arrays differ in shape, or a class is out of range.
    """
    if true.shape != predicted.shape or true.ndim != 1:
        raise MapError(f"true, predicted: must be of one length, got {true.shape} and {predicted.shape}")
    for name, classes in (("true", true), ("predicted", predicted)):
        if len(classes) and not 0 <= classes.min() <= classes.max() <= class_count:
            raise MapError(f"{name}: classes must be in 0 to {class_count}, got {classes.min()} to {classes.max()}")
    width = class_count + 1
    pairs = true.astype(np.int64) * width + predicted
    return np.bincount(pairs, minlength=width * width).reshape(width, width)


def score_segmentation(true: NDArray[np.integer], predicted: NDArray[np.integer], class_count: int) -> SegmentationScores:
    """Score a prediction over the voxels with a true class.

    Args:
        true: (n,) classes in 1 .. c; voxels of 0 are ignored.
        predicted: (n,) classes in 1 .. c, 0 for none.
        class_count: c.

    Raises:
        MapError: The arrays differ in shape, or a class is out of range.
    """
    counts = confusion(true, predicted, class_count)[1:]
    occurs = counts.sum(axis=1)
    right = np.diagonal(counts, offset=1)
    present = occurs > 0
    iou, recall = np.full(class_count, np.nan), np.full(class_count, np.nan)
    iou[present] = right[present] / (occurs + counts[:, 1:].sum(axis=0) - right)[present]
    recall[present] = right[present] / occurs[present]
    if not present.any():
        return SegmentationScores(iou, np.nan, np.nan, np.nan, np.nan)
    return SegmentationScores(
        iou,
        float(iou[present].mean()),
        float(np.average(iou[present], weights=occurs[present])),
        float(right.sum() / occurs.sum()),
        float(recall[present].mean()),
    )
