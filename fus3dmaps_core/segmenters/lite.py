"""The default segmenter ``lite``: classical over-segmentation, planes by depth, and the detector's boxes.

Three kinds of proposals, which overlap: the segments of Felzenszwalb and Huttenlocher (2004) on colour, at a quarter of the
pixels; planes joined from neighbouring segments by depth, which makes tables and floors whole that texture has shattered; and
the segments that fill a detected box. No learned segmentation: parts of objects and groups of them are to be expected.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from skimage.segmentation import felzenszwalb

from fus3dmaps_core.encoders.lite.detector import Detections, Detector, shared_detector
from fus3dmaps_core.encoders.lite.evidence import box_iou
from fus3dmaps_core.segmenters.coplanar import join_coplanar
from fus3dmaps_core.segmenters.protocols import Masks

_WORKING_PIXELS = 320 * 240
_SCALE, _SIGMA, _MIN_SEGMENT_PX = 150, 0.8, 80
_PLANE_ERROR = 0.01
_MIN_SCORE = 0.2
_MAX_BOX_IOU = 0.5
_INSIDE = 0.7
_MIN_FILL = 0.2
_DUPLICATE_IOU = 0.85
_DEPTH_STEP = 1.2


def load(device: str) -> LiteSegmenter:
    """Load the segmenter, which runs on the CPU whatever the device.

    Raises:
        EncoderError: The detector's package is missing or altered.
    """
    return LiteSegmenter(shared_detector())


class LiteSegmenter:
    """Proposes segments, planes and filled detections. Safe to use from several threads."""

    def __init__(self, detector: Detector) -> None:
        """Keep the detector."""
        self._detector = detector

    def segment(self, rgb: NDArray[np.uint8], depth_m: NDArray[np.float32]) -> Masks:
        """Propose masks of an (H, W, 3) image with its (H, W) depth in metres, 0 (or not finite) where there is none."""
        height, width = rgb.shape[:2]
        factor = min(1.0, (_WORKING_PIXELS / (height * width)) ** 0.5)
        size = max(1, round(width * factor)), max(1, round(height * factor))
        small = np.asarray(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA), np.uint8)
        depth = np.asarray(cv2.resize(depth_m, size, interpolation=cv2.INTER_NEAREST), np.float32)
        depth = np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(0))
        labels = felzenszwalb(small, scale=_SCALE, sigma=_SIGMA, min_size=_MIN_SEGMENT_PX).astype(np.int32)
        n = int(labels.max()) + 1

        unions = [np.array([label]) for label in range(n)] + join_coplanar(labels, depth, _PLANE_ERROR)
        chosen = np.zeros((len(unions), n), bool)
        for row, union in enumerate(unions):
            chosen[row, union] = True
        masks = _distinct(np.concatenate([self._filled_boxes(rgb, labels, depth), chosen[:, labels]]))
        if factor == 1.0:
            return Masks.from_masks(masks)
        columns = (np.arange(width) * size[0]) // width
        rows = (np.arange(height) * size[1]) // height
        return Masks.from_masks(masks[:, rows[:, None], columns[None, :]])

    def _filled_boxes(
        self, rgb: NDArray[np.uint8], labels: NDArray[np.int32], depth_m: NDArray[np.float32]
    ) -> NDArray[np.bool_]:
        """(k, h, w) masks of the detections at the size of ``labels``."""
        detections = self._detector.detect(rgb)
        scale = np.array(labels.shape[::-1] * 2, np.float32) / np.array(rgb.shape[1::-1] * 2, np.float32)
        areas = np.bincount(labels.ravel())
        masks = [
            _fill(np.round(box * scale).astype(int), labels, depth_m, areas)
            for box in detections.boxes[_strongest(detections)]
        ]
        return np.array([mask for mask in masks if mask.any()], bool).reshape(-1, *labels.shape)


def _strongest(detections: Detections) -> list[int]:
    """Rows of confident detections whose boxes do not overlap a stronger one's too much."""
    overlaps = box_iou(detections.boxes, detections.boxes)
    kept: list[int] = []
    for row in np.flatnonzero(detections.scores >= _MIN_SCORE):
        if not (overlaps[row, kept] > _MAX_BOX_IOU).any():
            kept.append(int(row))
    return kept


def _fill(
    box: NDArray[np.int_], labels: NDArray[np.int32], depth_m: NDArray[np.float32], areas: NDArray[np.int_]
) -> NDArray[np.bool_]:
    """The part of a box that shows its object: segments that lie mostly inside and not far behind the nearest ones."""
    window = np.s_[max(0, box[1]) : box[3], max(0, box[0]) : box[2]]
    mask = np.zeros(labels.shape, bool)
    inside, depth = labels[window], depth_m[window]
    if not inside.size:
        return mask
    near = (depth == 0) | (depth <= _background_depth_m(depth))
    counts = np.bincount(inside.ravel(), minlength=len(areas))
    near_counts = np.bincount(inside[near], minlength=len(areas))
    belongs = (counts >= _INSIDE * areas) & (near_counts > 0.5 * counts)
    filled = belongs[inside]
    # An object without segments of its own, such as a slatted chair back, is what stands out in depth.
    mask[window] = filled if filled.mean() >= _MIN_FILL else near
    return mask


def _background_depth_m(depth_m: NDArray[np.float32]) -> float:
    """Depth behind which a box shows background: the split of its inverse depths that separates them best, if far apart."""
    readings = np.sort(depth_m[depth_m > 0].astype(np.float64))
    if len(readings) < 2:
        return float("inf")
    inverse = 1 / readings
    n = np.arange(1, len(inverse))
    sums = np.cumsum(inverse)
    near, far = sums[:-1] / n, (sums[-1] - sums[:-1]) / (len(inverse) - n)
    split = int(np.argmax(n * (len(inverse) - n) * (near - far) ** 2))
    return float(readings[split]) if near[split] > _DEPTH_STEP * far[split] else float("inf")


def _distinct(masks: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The masks without those that nearly equal an earlier one."""
    flat = masks.reshape(len(masks), -1).astype(np.float32)
    shared = flat @ flat.T
    areas = np.diag(shared)
    near = shared > _DUPLICATE_IOU * (areas[:, None] + areas[None, :] - shared)
    kept: list[int] = []
    for row in range(len(masks)):
        if not near[row, kept].any():
            kept.append(row)
    return masks[kept]
