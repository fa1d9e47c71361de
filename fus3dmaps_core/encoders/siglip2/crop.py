"""Crop embeddings: SigLIP 2's image embedding of each object's box."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from fus3dmaps_core.encoders.crop_batches import CropBatcher
from fus3dmaps_core.encoders.graphs import Graph, Network
from fus3dmaps_core.encoders.siglip2.network import MEAN, STD, WIDTH, CropNetwork
from fus3dmaps_core.masks import Masks

_BATCH = 16  # Bounds the memory of a pass; a frame has up to 64 crops.


class Siglip2CropEncoder:
    """Embeds the boxes around masks at the size that the tower was trained on."""

    def __init__(self, network: CropNetwork, padding: float, device: str) -> None:
        """Keep the network, which is on the device already, and the padding as a share of a box's size."""
        self._module, self._size_px = network, network.tokens.size_px
        self._network: Network = network
        self._crops = CropBatcher(self._size_px, MEAN, STD, padding, device)

    def encode_crops(self, rgb: NDArray[np.uint8], masks: Masks) -> NDArray[np.float32]:
        """Embed one crop per mask of an (H, W, 3) uint8 image: (n, 768) float32, unit length."""
        if not len(masks):
            return np.zeros((0, WIDTH), np.float32)
        with torch.inference_mode():
            outputs = [self._network(batch) for batch in torch.split(self._crops.batch(rgb, masks.boxes), _BATCH)]
            parts = [output if isinstance(output, torch.Tensor) else output[0] for output in outputs]
            embeddings: NDArray[np.float32] = torch.cat(parts).cpu().numpy()
        return embeddings

    def graph(self, height: int, width: int) -> Graph:
        """Its network at the shape it is run at, whatever the size of the image."""
        return Graph("crop", self._module, (_BATCH, 3, self._size_px, self._size_px), ("embeddings",))

    def run_with(self, network: Network) -> None:
        """Run this in place of the network; it takes and returns tensors of the encoder's device."""
        self._network = network
