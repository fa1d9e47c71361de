"""The default segmenter ``lite``: classical over-segmentation, planes by depth, and the detector's boxes.

Three kinds of proposals, which overlap: the segments of Felzenszwalb and Huttenlocher (2004) on colour, at a quarter of the
pixels; planes joined from neighbouring segments by depth, which makes tables and floors whole that texture has shattered;
and the segments that fill a detected box. No learned segmentation: parts of objects and groups of them are to be expected.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from skimage.segmentation import felzenszwalb

from fus3dmaps_core.config.schema import EncoderConfig
from fus3dmaps_core.encoders.lite.detector import Detections, Detector, shared_detector
from fus3dmaps_core.encoders.lite.evidence import box_iou
from fus3dmaps_core.errors import EncoderError
from fus3dmaps_core.masks import Masks
from fus3dmaps_core.segmenters.coplanar import join_coplanar

_WORKING_PIXELS = 320 * 240
_SCALE, _SIGMA, _MIN_SEGMENT_PX = 150, 0.8, 80
_MIN_RADIUS_PX = 3.0  # Thinner segments are rims and shadows along edges.
_PLANE_ERROR = 0.01  # About twice the noise of a structured-light camera at two metres.
_MIN_SCORE = 0.2
_MAX_BOX_IOU = 0.5
_INSIDE = 0.7  # Share of a segment that lies in the box it belongs to.
_MIN_FILL = 0.2
_DEPTH_STEP = 1.2  # Ratio of mean depths from which a box shows a thing and something else behind it.
_SAME_IOU = 0.85


def load(encoder: EncoderConfig, weights: str) -> LiteSegmenter:
    """Load the segmenter, which runs on the CPU whatever the device and the runtime.

    Raises:
        EncoderError: Weights are asked for, of which it has none, or the detector's package is missing or altered.
    """
    if weights:
        raise EncoderError(
            f"parameter 'segmenter.weights': segmenter 'lite' has no weights but those of its pip package, got '{weights}'"
        )
    return LiteSegmenter(shared_detector())


class LiteSegmenter:
    """The segmenter ``lite``, which proposes segments, planes and filled detections. Safe to use from several threads."""

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

        areas = np.bincount(labels.ravel())
        radii = _inner_radii_px(labels)
        unions = [np.array([label]) for label in np.flatnonzero(radii >= _MIN_RADIUS_PX)]
        # A plane that one of its segments all but fills says nothing new.
        unions += [
            union
            for union in join_coplanar(labels, depth, _PLANE_ERROR)
            if areas[union].max() < _SAME_IOU * areas[union].sum()
        ]
        filled = self._filled_boxes(rgb, labels, areas, depth)
        chosen = np.zeros((len(unions), len(areas)), bool)
        for row, union in enumerate(unions):
            chosen[row, union] = True
        for mask in filled:
            chosen = chosen[_iou_with_unions(mask, labels, chosen, areas) < _SAME_IOU]
        return _enlarged(np.concatenate([filled, chosen[:, labels]]), height, width)

    def _filled_boxes(
        self, rgb: NDArray[np.uint8], labels: NDArray[np.int32], areas: NDArray[np.int_], depth_m: NDArray[np.float32]
    ) -> NDArray[np.bool_]:
        """Fill the boxes of the detections with segments: (k, h, w) masks at the size of ``labels``."""
        detections = self._detector.detect(rgb)
        scale = np.array(labels.shape[::-1] * 2, np.float32) / np.array(rgb.shape[1::-1] * 2, np.float32)
        masks = [
            _fill(np.round(box * scale).astype(int), labels, depth_m, areas)
            for box in detections.boxes[_strongest(detections)]
        ]
        return np.array([mask for mask in masks if mask.any()], bool).reshape(-1, *labels.shape)


def _strongest(detections: Detections) -> list[int]:
    """Return the rows of confident detections whose boxes do not overlap a stronger one's too much."""
    overlaps = box_iou(detections.boxes, detections.boxes)
    kept: list[int] = []
    for row in np.flatnonzero(detections.scores >= _MIN_SCORE):
        if not (overlaps[row, kept] > _MAX_BOX_IOU).any():
            kept.append(int(row))
    return kept


def _fill(
    box: NDArray[np.int_], labels: NDArray[np.int32], depth_m: NDArray[np.float32], areas: NDArray[np.int_]
) -> NDArray[np.bool_]:
    """Mark the object in a box: the segments that lie mostly inside and not far behind the nearest ones."""
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
    """Find the depth behind which a box shows background: where its inverse depths split best, if far apart."""
    readings = np.sort(depth_m[depth_m > 0].astype(np.float64))
    if len(readings) < 2:
        return float("inf")
    inverse = 1 / readings
    n = np.arange(1, len(inverse))
    sums = np.cumsum(inverse)
    near, far = sums[:-1] / n, (sums[-1] - sums[:-1]) / (len(inverse) - n)
    split = int(np.argmax(n * (len(inverse) - n) * (near - far) ** 2))
    return float(readings[split]) if near[split] > _DEPTH_STEP * far[split] else float("inf")


def _inner_radii_px(labels: NDArray[np.int32]) -> NDArray[np.float32]:
    """Estimate the radius of the largest disc inside each segment: (n,) float32, small for slivers along edges."""
    interior = np.ones(labels.shape, np.uint8)
    interior[:, 1:] &= labels[:, 1:] == labels[:, :-1]
    interior[1:] &= labels[1:] == labels[:-1]
    radii = np.zeros(int(labels.max()) + 1, np.float32)
    np.maximum.at(radii, labels, cv2.distanceTransform(interior, cv2.DIST_L2, 3))
    return radii


def _iou_with_unions(
    mask: NDArray[np.bool_], labels: NDArray[np.int32], chosen: NDArray[np.bool_], areas: NDArray[np.int_]
) -> NDArray[np.float64]:
    """Compute the intersection over union of a mask with unions of segments; ``chosen`` is (unions, segments)."""
    shared = chosen @ np.bincount(labels[mask], minlength=len(areas))
    return np.asarray(shared / (mask.sum() + chosen @ areas - shared), np.float64)


def _enlarged(masks: NDArray[np.bool_], height: int, width: int) -> Masks:
    """Bring masks to another size, each pixel taking the nearest one's value."""
    small_height, small_width = masks.shape[1:]
    columns = np.arange(width) * small_width // width
    rows = np.arange(height) * small_height // height
    bounds = np.array([cv2.boundingRect(mask.view(np.uint8)) for mask in masks], np.int64).reshape(-1, 4)
    bounds[:, 2:] += bounds[:, :2]
    # The first pixel that takes its value from column x is ceil(x * width / small_width), and so for rows.
    grown = -(-bounds * (width, height, width, height) // (small_width, small_height, small_width, small_height))
    return Masks(masks.take(columns, axis=2).take(rows, axis=1), grown.astype(np.int32))
