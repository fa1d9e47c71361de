"""Crop embeddings: CLIP's image embedding of each object's box."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import torch
from numpy.typing import NDArray

from fus3dmaps_core.encoders.clip_dinoiser.network import MEAN, STD, ClipCrops
from fus3dmaps_core.encoders.crop_batches import CropBatcher
from fus3dmaps_core.encoders.graphs import Graph, Network
from fus3dmaps_core.masks import Masks

_BATCH = 16  # Bounds the memory of a pass; a frame has up to 64 crops.


class ClipCropEncoder:
    """Embeds the boxes around masks at the size that CLIP was trained on."""

    def __init__(self, visual: Any, padding: float, device: str) -> None:
        """Keep an ``open_clip`` image transformer, on the device already, and the padding as a share of a box's size."""
        self._network, self._dimension = ClipCrops(visual).eval(), int(visual.output_dim)
        self._size_px = int(visual.image_size[0])
        self._run: Network = self._network
        self._crops = CropBatcher(self._size_px, MEAN, STD, padding, device)

    def encode_crops(self, rgb: NDArray[np.uint8], masks: Masks) -> NDArray[np.float32]:
        """Embed one crop per mask of an (H, W, 3) uint8 image: (n, 512) float32, unit length."""
        if not len(masks):
            return np.zeros((0, self._dimension), np.float32)
        with torch.inference_mode():
            images = self._crops.batch(rgb, masks.boxes)
            parts = [cast(torch.Tensor, self._run(batch)) for batch in torch.split(images, _BATCH)]
            embeddings: NDArray[np.float32] = torch.cat(parts).cpu().numpy()
        return embeddings

    def graph(self, height: int, width: int) -> Graph:
        """The network for a batch of crops, whose size is that of no image."""
        return Graph("crop", self._network, (_BATCH, 3, self._size_px, self._size_px), ("embeddings",))

    def run_with(self, network: Network) -> None:
        """Run this in place of the torch network, see :class:`fus3dmaps_core.encoders.graphs.GraphEncoder`."""
        self._run = network
