"""What detections say about patches and crops, per COCO category."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fus3dmaps_core.encoders.lite.detector import Detections
from fus3dmaps_core.encoders.lite.vocabulary import COCO_CATEGORIES

_SCORE_GAIN = 2.0  # The detector is underconfident: a score of a half is as good as certain.
_NO_MATCH_IOU, _FULL_MATCH_IOU = 0.2, 0.7
_SOFT_MARGIN = 0.3


def crop_evidence(detections: Detections, boxes: NDArray[np.int32]) -> NDArray[np.float32]:
    """Compute evidence for crops: the better a detection and a box coincide, the more it counts.

    Args:
        detections: Detections of the image.
        boxes: (n, 4), x0, y0, x1, y1 in pixels, x1 and y1 exclusive.

    Returns:
        (n, 91) float32 in [0, 1] by category id.
    """
    evidence = np.zeros((len(boxes), COCO_CATEGORIES), np.float32)
    strengths = np.minimum(1.0, _SCORE_GAIN * detections.scores)
    overlaps = box_iou(boxes.astype(np.float32), detections.boxes)
    matches = np.clip((overlaps - _NO_MATCH_IOU) / (_FULL_MATCH_IOU - _NO_MATCH_IOU), 0.0, 1.0)
    for label, strength, match in zip(detections.labels, strengths, matches.T, strict=True):
        evidence[:, label] = np.maximum(evidence[:, label], strength * match)
    return evidence


def patch_evidence(detections: Detections, rows: int, columns: int, patch_px: int) -> NDArray[np.float32]:
    """Compute evidence for patches: a detection counts for the patches inside its box, less towards the border.

    Where boxes of different categories overlap, the smaller takes precedence: a cup on a table is not a table.

    Args:
        detections: Detections of the image.
        rows: Rows of the patch grid.
        columns: Columns of the patch grid.
        patch_px: Side of a patch, pixels.

    Returns:
        (rows * columns, 91) float32 in [0, 1] by category id.
    """
    x = (np.tile(np.arange(columns), rows) + 0.5) * patch_px
    y = (np.repeat(np.arange(rows), columns) + 0.5) * patch_px
    said = np.zeros((rows * columns, COCO_CATEGORIES), np.float32)
    evidence = np.zeros_like(said)
    sides = detections.boxes[:, 2:] - detections.boxes[:, :2]
    for row in np.argsort(sides.prod(axis=1), kind="stable"):
        label, (width, height) = detections.labels[row], sides[row] / 2
        center_x, center_y = detections.boxes[row, :2] + (width, height)
        outwards = np.maximum(np.abs(x - center_x) / width, np.abs(y - center_y) / height)
        strength = min(1.0, _SCORE_GAIN * float(detections.scores[row])) * np.clip((1 - outwards) / _SOFT_MARGIN, 0, 1)
        others = np.delete(said, label, axis=1).max(axis=1)
        evidence[:, label] = np.maximum(evidence[:, label], strength * (1 - others))
        said[:, label] = np.maximum(said[:, label], strength)
    return evidence


def box_iou(first: NDArray[np.float32], second: NDArray[np.float32]) -> NDArray[np.float32]:
    """Compute the intersection over union of n and m boxes (x0, y0, x1, y1) with positive sides: (n, m) float32."""
    low = np.maximum(first[:, None, :2], second[None, :, :2])
    high = np.minimum(first[:, None, 2:], second[None, :, 2:])
    shared = np.clip(high - low, 0, None).prod(axis=2)
    areas = [(boxes[:, 2:] - boxes[:, :2]).prod(axis=1) for boxes in (first, second)]
    iou: NDArray[np.float32] = shared / (areas[0][:, None] + areas[1][None, :] - shared)
    return iou
