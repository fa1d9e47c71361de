"""Which masks become proposals [sec: Segmentation and Embedding Extraction]."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from fus3dmaps_core.config.schema import SegmenterConfig
from fus3dmaps_core.masks import Masks

_CROSS = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))


def filter_masks(masks: Masks, config: SegmenterConfig) -> Masks:
    """Drop masks that are small or cut by the image border; order the rest by area.

    A mask's contour is made of its pixels with a 4-neighbour outside it, beyond the image included; its border contact is
    the share of the contour that lies on the image's outermost pixels.

    Args:
        masks: Masks of one image.
        config: ``min_area_px``, ``max_border_contact`` and ``max_masks``.

    Returns:
        At most ``max_masks`` masks, largest first; equal areas keep their order.
    """
    if not len(masks):
        return masks
    areas = np.array([np.count_nonzero(mask) for mask in masks.masks])
    kept = [
        row
        for row in np.argsort(-areas, kind="stable")
        if areas[row] >= config.min_area_px
        and border_contact(masks.masks[row], masks.boxes[row]) <= config.max_border_contact
    ]
    return masks.take(np.array(kept[: config.max_masks], dtype=np.int64))


def border_contact(mask: NDArray[np.bool_], box: NDArray[np.int32]) -> float:
    """Share of a mask's contour that lies on the border of its (H, W) image; ``box`` are its tight bounds."""
    height, width = mask.shape
    x0, y0, x1, y1 = (int(value) for value in box)
    if x0 > 0 and y0 > 0 and x1 < width and y1 < height:
        return 0.0
    inside = np.pad(mask[y0:y1, x0:x1], 1).astype(np.uint8)
    contour = (inside - cv2.erode(inside, _CROSS))[1:-1, 1:-1].astype(bool)
    on_border = np.zeros_like(contour)
    on_border[0, :] |= y0 == 0
    on_border[-1, :] |= y1 == height
    on_border[:, 0] |= x0 == 0
    on_border[:, -1] |= x1 == width
    return float((contour & on_border).sum() / contour.sum())
