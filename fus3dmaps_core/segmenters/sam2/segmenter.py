"""Masks of everything in a frame, by asking SAM 2 at a grid of points."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn import functional

from fus3dmaps_core.masks import Masks
from fus3dmaps_core.segmenters.mask_tensors import (
    best_first,
    box_overlaps,
    first_of_overlapping,
    mask_overlaps,
    masks_at,
    tight_boxes,
)
from fus3dmaps_core.segmenters.sam2.points import PointSettings, masks_at_points, point_grid

MEAN = (0.485, 0.456, 0.406)
"""Mean of red, green and blue in [0, 1], with which SAM 2's images are normalised."""
STD = (0.229, 0.224, 0.225)

MAX_BOX_IOU = 0.7
MAX_MASK_IOU = 0.9
"""Masks that share more are one, though the tips of one make its box larger."""
MAX_PROPOSALS = 300


class Sam2Segmenter:
    """SAM 2's segmenter, which proposes masks at the image's own size, best first. Safe to use from several threads."""

    def __init__(self, network: Any, device: str, settings: PointSettings | None = None) -> None:
        """Keep the network.

        Args:
            network: ``Sam2Model`` in evaluation mode, on the device already.
            device: Torch device.
            settings: Points and thresholds; the defaults if None.
        """
        self._network, self._device = network, torch.device(device)
        self._settings = settings or PointSettings()
        self._side = int(network.config.prompt_encoder_config.image_size)
        self._points = point_grid(self._settings.per_side, self._side, self._device)
        self._mean = 255.0 * torch.tensor(MEAN, device=self._device).reshape(1, 3, 1, 1)
        self._std = 255.0 * torch.tensor(STD, device=self._device).reshape(1, 3, 1, 1)

    def segment(self, rgb: NDArray[np.uint8], depth_m: NDArray[np.float32]) -> Masks:
        """Propose masks of an (H, W, 3) uint8 image; depth is not used.

        The image is stretched to the network's square, as in training. Which masks go is decided on the decoder's grid, a
        quarter of that square's sides; those that stay are brought to the image's size.
        """
        height, width = rgb.shape[:2]
        with torch.inference_mode():
            features = self._network.get_image_embeddings(self._input(rgb))
            logits, scores = masks_at_points(self._network, features, self._points, self._settings)
            logits = logits[best_first(scores, len(scores))]
            masks = logits > 0
            kept = torch.nonzero(first_of_overlapping(box_overlaps(tight_boxes(masks).float(), MAX_BOX_IOU))).squeeze(1)
            kept = kept[first_of_overlapping(mask_overlaps(masks[kept], MAX_MASK_IOU))][:MAX_PROPOSALS]
            return masks_at(logits[kept], height, width)

    def _input(self, rgb: NDArray[np.uint8]) -> torch.Tensor:
        """Make the network's (1, 3, side, side) normalised input."""
        image = torch.from_numpy(np.ascontiguousarray(rgb)).to(self._device).permute(2, 0, 1)[None].float()
        size = (self._side, self._side)
        image = functional.interpolate(image, size, mode="bilinear", align_corners=False, antialias=True)
        return image.sub_(self._mean).div_(self._std)
