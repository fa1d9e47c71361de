"""Masks as tensors: which of many overlapping ones stay, and how they are brought to the image's own size.

All of it runs on the tensors' own device and gives the same result every time; equal scores keep the order they came in.
"""

from __future__ import annotations

import math

import torch
from torch.nn import functional

from fus3dmaps_core.masks import Masks

_CHUNK_PIXELS = 1 << 21  # Of masks brought to the image's size at once; their logits stay in a processor's cache.


def best_first(scores: torch.Tensor, most: int) -> torch.Tensor:
    """Return the rows of the ``most`` highest of (n,) scores, highest first; equal ones in their order."""
    return torch.argsort(scores, descending=True, stable=True)[:most]


def first_of_overlapping(overlaps: torch.Tensor) -> torch.Tensor:
    """Drop every row that overlaps a remaining one before it, and tell which rows remain.

    Args:
        overlaps: (n, n) bool, symmetric.

    Returns:
        (n,) bool.
    """
    before = overlaps.triu(1)
    kept = torch.ones(len(overlaps), dtype=torch.bool, device=overlaps.device)
    # The first rows are settled after as many rounds at the latest, and all of them where a round changes nothing; the
    # rounds needed are as many as the longest chain of rows that drop one another.
    while True:
        settled = ~(before & kept[:, None]).any(dim=0)
        if torch.equal(settled, kept):
            return kept
        kept = settled


def box_overlaps(boxes: torch.Tensor, iou: float) -> torch.Tensor:
    """Tell which pairs of (n, 4) boxes x0, y0, x1, y1 have a larger intersection over union: (n, n) bool."""
    x0, y0, x1, y1 = boxes.unbind(dim=1)
    across = torch.minimum(x1[:, None], x1) - torch.maximum(x0[:, None], x0)
    down = torch.minimum(y1[:, None], y1) - torch.maximum(y0[:, None], y0)
    shared = across.clamp_(min=0) * down.clamp_(min=0)
    areas = (x1 - x0) * (y1 - y0)
    return shared / (areas[:, None] + areas[None] - shared) > iou


def mask_overlaps(masks: torch.Tensor, iou: float) -> torch.Tensor:
    """Tell which pairs of (n, h, w) bool masks have a larger intersection over union: (n, n) bool; empty masks have none."""
    flat = masks.flatten(1).float()  # Counts below 2^24 are exact in float32.
    shared = flat @ flat.T
    areas = flat.sum(dim=1)
    return shared / (areas[:, None] + areas[None] - shared) > iou


def stability(logits: torch.Tensor, offset: float) -> torch.Tensor:
    """Measure how little masks change with their threshold (Kirillov et al. 2023).

    Args:
        logits: (n, h, w), a mask is where they are above 0.
        offset: By how much the threshold is raised and lowered.

    Returns:
        (n,) float32, the intersection over union of the two masks; 0 where both are empty.
    """
    small = (logits > offset).flatten(1).sum(dim=1)
    large = (logits > -offset).flatten(1).sum(dim=1)
    return small / large.clamp(min=1)


def tight_boxes(masks: torch.Tensor) -> torch.Tensor:
    """Bound (n, h, w) bool masks by (n, 4) int32 x0, y0, x1, y1, the last two exclusive; empty masks have x1 <= x0."""
    bounds = []
    values = masks.view(torch.uint8)  # The largest of bytes is found many times faster than any of truth values.
    for occupied in (values.amax(dim=1) > 0, values.amax(dim=2) > 0):
        places = torch.arange(occupied.shape[1], dtype=torch.int32, device=masks.device)
        bounds.append(torch.where(occupied, places, occupied.shape[1]).amin(dim=1))
        bounds.append(torch.where(occupied, places + 1, 0).amax(dim=1))
    x0, x1, y0, y1 = bounds
    return torch.stack([x0, y0, x1, y1], dim=1).to(torch.int32)


def masks_at(
    logits: torch.Tensor,
    height: int,
    width: int,
    region: tuple[float, float, float, float] | None = None,
    boxes: torch.Tensor | None = None,
) -> Masks:
    """Make masks at the size of the image from logits on a coarser grid.

    Args:
        logits: (n, h, w) float, a mask is where their bilinear interpolation at a pixel's centre is above 0; at the edges of
            the region the nearest cells count.
        height: Height of the image, pixels.
        width: Width of the image, pixels.
        region: Part of the grid that the image fills, x0, y0, x1, y1 in its cells; all of it if None.
        boxes: (n, 4) x0, y0, x1, y1 in pixels of the image, to which the masks are cut; a pixel with its upper left corner
            in the box is inside.

    Returns:
        Masks with at least a pixel, in their order.
    """
    x0, y0, x1, y1 = region or (0.0, 0.0, float(logits.shape[2]), float(logits.shape[1]))
    # What is beside the image must not leak into the masks at its edges.
    left_cell, top_cell = math.floor(x0), math.floor(y0)
    logits = logits[:, top_cell : math.ceil(y1), left_cell : math.ceil(x1)]
    rows, columns = logits.shape[1:]
    device = logits.device
    across = torch.arange(width, device=device)
    down = torch.arange(height, device=device)
    # Of grid_sample, whose -1 and 1 are the outer edges of the grid.
    x = 2 * (x0 - left_cell + (across + 0.5) * ((x1 - x0) / width)) / columns - 1
    y = 2 * (y0 - top_cell + (down + 0.5) * ((y1 - y0) / height)) / rows - 1
    grid = torch.stack([x.expand(height, width), y[:, None].expand(height, width)], dim=2)[None].to(logits.dtype)
    masks = torch.empty((len(logits), height, width), dtype=torch.bool, device=device)
    step = max(1, _CHUNK_PIXELS // (height * width))
    for start in range(0, len(logits), step):
        part = logits[None, start : start + step]
        values = functional.grid_sample(part, grid, mode="bilinear", padding_mode="border", align_corners=False)[0]
        torch.gt(values, 0, out=masks[start : start + step])
    if boxes is not None:
        left, top, right, bottom = boxes[:, :, None].unbind(dim=1)
        masks &= ((across >= left) & (across < right))[:, None, :]
        masks &= ((down >= top) & (down < bottom))[:, :, None]
    bounds = tight_boxes(masks)
    filled = bounds[:, 2] > bounds[:, 0]
    if not filled.all():
        masks, bounds = masks[filled], bounds[filled]
    return Masks(masks.cpu().numpy(), bounds.cpu().numpy())
