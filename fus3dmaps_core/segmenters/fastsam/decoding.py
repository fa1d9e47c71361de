"""From the raw outputs of FastSAM to masks: scores, boxes, and sums of prototypes as in YOLACT (Bolya et al. 2019).

The thresholds are those that FastSAM's authors run it with.
"""

from __future__ import annotations

from typing import NamedTuple

import torch

from fus3dmaps_core.masks import Masks
from fus3dmaps_core.segmenters.fastsam.letterbox import Letterbox
from fus3dmaps_core.segmenters.mask_tensors import best_first, box_overlaps, first_of_overlapping, mask_overlaps, masks_at

PROTOTYPES = 32
"""Masks whose weighted sums are the masks of objects."""
STRIDE = 4
"""Pixels of the input to a cell of the prototypes."""

MIN_SCORE = 0.4
MAX_BOX_IOU = 0.9
MAX_PROPOSALS = 300
MAX_CANDIDATES = 3000
"""Boxes of the highest scores that are compared with one another; bounds time and memory."""
MAX_MASK_IOU = 0.9
"""Masks that share more are one, though the tips of one make its box larger."""


class Candidates(NamedTuple):
    """Detections, highest score first.

    Attributes:
        boxes: (n, 4) float, x0, y0, x1, y1 in pixels of the network's input.
        coefficients: (n, 32) float, weights of the prototypes.
    """

    boxes: torch.Tensor
    coefficients: torch.Tensor


def select(predictions: torch.Tensor) -> Candidates:
    """Select the confident detections whose boxes do not nearly coincide with a better one's.

    Args:
        predictions: (37, N): for every anchor centre x, y, width, height in pixels of the input, score in [0, 1], weights of
            the prototypes.
    """
    scores = predictions[4]
    confident = torch.nonzero(scores > MIN_SCORE).squeeze(1)
    rows = confident[best_first(scores[confident], MAX_CANDIDATES)]
    chosen = predictions[:, rows].T
    halves = chosen[:, 2:4] / 2
    boxes = torch.cat([chosen[:, :2] - halves, chosen[:, :2] + halves], dim=1)
    kept = torch.nonzero(first_of_overlapping(box_overlaps(boxes, MAX_BOX_IOU))).squeeze(1)[:MAX_PROPOSALS]
    return Candidates(boxes[kept], chosen[kept, 5:])


def masks_of(candidates: Candidates, prototypes: torch.Tensor, letterbox: Letterbox, height: int, width: int) -> Masks:
    """Make masks at the image's own size, each cut to its box; of masks that nearly coincide the best stays.

    Args:
        candidates: Detections.
        prototypes: (32, h / 4, w / 4) of an (h, w) input.
        letterbox: Where the image lies in the input.
        height: Height of the image, pixels.
        width: Width of the image, pixels.
    """
    logits = torch.tensordot(candidates.coefficients, prototypes, dims=1)
    kept = first_of_overlapping(mask_overlaps(_coarse(logits, candidates.boxes), MAX_MASK_IOU))
    x0, y0 = letterbox.left, letterbox.top
    origin = candidates.boxes.new_tensor([x0, y0, x0, y0])
    scale = candidates.boxes.new_tensor([width / letterbox.width, height / letterbox.height] * 2)
    region = (x0 / STRIDE, y0 / STRIDE, (x0 + letterbox.width) / STRIDE, (y0 + letterbox.height) / STRIDE)
    return masks_at(logits[kept], height, width, region, (candidates.boxes[kept] - origin) * scale)


def _coarse(logits: torch.Tensor, boxes: torch.Tensor) -> torch.Tensor:
    """Make (n, h / 4, w / 4) bool masks on the prototypes' grid, of the cells whose centres are in their boxes."""
    x = (torch.arange(logits.shape[2], device=logits.device) + 0.5) * STRIDE
    y = (torch.arange(logits.shape[1], device=logits.device) + 0.5) * STRIDE
    left, top, right, bottom = boxes[:, :, None].unbind(dim=1)
    inside = ((y >= top) & (y < bottom))[:, :, None] & ((x >= left) & (x < right))[:, None, :]
    return (logits > 0) & inside
