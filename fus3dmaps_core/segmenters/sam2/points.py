"""Masks that SAM 2 sees at a regular grid of points: the part of its work that runs on the device."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch

from fus3dmaps_core.segmenters.mask_tensors import stability


@dataclass(frozen=True)
class PointSettings:
    """The number of points, and the thresholds that choose among their masks, as SAM 2's authors use them.

    Attributes:
        per_side: Points along each side of the image.
        per_pass: Points that the decoder takes at once; bounds its memory, to about 1 GB.
        min_iou: Masks that the network itself expects to overlap the true one less are dropped.
        min_stability: Masks that change more with their threshold are dropped.
        stability_offset: By how much the threshold of the logits is raised and lowered for that.
    """

    per_side: int = 16
    per_pass: int = 16
    min_iou: float = 0.8
    min_stability: float = 0.95
    stability_offset: float = 1.0


class PointMasks(NamedTuple):
    """Masks in the order of their points, up to three a point.

    Attributes:
        logits: (n, h, w) float on the decoder's grid, which covers the whole image; a mask is where they are above 0.
        scores: (n,) float, the overlap with the true mask that the network expects.
    """

    logits: torch.Tensor
    scores: torch.Tensor


def point_grid(per_side: int, side: int, device: torch.device) -> torch.Tensor:
    """Place points at the centres of equal cells of a square image: (per_side^2, 2) float32 x, y, row by row."""
    centres = (torch.arange(per_side, dtype=torch.float32, device=device) + 0.5) * (side / per_side)
    y, x = torch.meshgrid(centres, centres, indexing="ij")
    return torch.stack([x.flatten(), y.flatten()], dim=1)


def masks_at_points(
    network: Any, features: Sequence[torch.Tensor], points: torch.Tensor, settings: PointSettings
) -> PointMasks:
    """Ask the decoder for masks at every point and take the good ones.

    Args:
        network: ``Sam2Model``.
        features: Its image embeddings of one image.
        points: (n, 2) x, y in pixels of the network's image.
        settings: What is taken.
    """
    taken = []
    for batch in torch.split(points, settings.per_pass):
        output = network(
            image_embeddings=list(features),
            input_points=batch[None, :, None],
            input_labels=torch.ones((1, len(batch), 1), dtype=torch.int32, device=batch.device),
            multimask_output=True,
        )
        scores, logits = output.iou_scores.flatten(), output.pred_masks.flatten(0, 2)
        promising = torch.nonzero(scores > settings.min_iou).squeeze(1)
        logits = logits[promising]
        good = stability(logits, settings.stability_offset) > settings.min_stability
        taken.append(PointMasks(logits[good], scores[promising[good]]))
    return PointMasks(torch.cat([part.logits for part in taken]), torch.cat([part.scores for part in taken]))
