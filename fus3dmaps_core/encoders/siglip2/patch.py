"""Patch embeddings of a frame: SigLIP 2's tokens, each through the pooling head by itself."""

from __future__ import annotations

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from fus3dmaps_core.encoders.graphs import Graph, Network
from fus3dmaps_core.encoders.protocols import PatchEmbeddings
from fus3dmaps_core.encoders.siglip2.network import MEAN, PATCH_PX, STD, PatchNetwork


class Siglip2PatchEncoder:
    """Embeds 16-pixel patches in one pass; all weights are 1."""

    def __init__(self, network: PatchNetwork, device: str) -> None:
        """Keep the network, which is on the device already; it brings images to the precision of its weights."""
        self._module, self._device = network, torch.device(device)
        self._network: Network = network
        # Pixels are bytes: (x / 255 - mean) / std in one step.
        self._mean = 255.0 * torch.tensor(MEAN, device=self._device).reshape(1, 3, 1, 1)
        self._std = 255.0 * torch.tensor(STD, device=self._device).reshape(1, 3, 1, 1)

    def grid(self, height: int, width: int) -> tuple[int, int]:
        """Rows and columns of the patch grid: one per 16 pixels, rounded up."""
        return -(-height // PATCH_PX), -(-width // PATCH_PX)

    def encode_patches(self, rgb: NDArray[np.uint8]) -> PatchEmbeddings:
        """Embed the patches of an (H, W, 3) uint8 image.

        Where its sides are no multiples of a patch's the image is stretched to the next ones, so that the grid covers the
        image and nothing else.
        """
        rows, columns = self.grid(*rgb.shape[:2])
        height, width = rows * PATCH_PX, columns * PATCH_PX
        if rgb.shape[:2] != (height, width):
            rgb = np.asarray(cv2.resize(rgb, (width, height), interpolation=cv2.INTER_LINEAR), np.uint8)
        with torch.inference_mode():
            image = torch.from_numpy(np.ascontiguousarray(rgb)).to(self._device).permute(2, 0, 1)[None].float()
            output = self._network(image.sub_(self._mean).div_(self._std))
            embeddings = output if isinstance(output, torch.Tensor) else output[0]
            return PatchEmbeddings(embeddings[0].cpu().numpy(), np.ones((rows, columns), np.float32))

    def graph(self, height: int, width: int) -> Graph:
        """Its network at the shape it is run at for an image of this size, pixels."""
        rows, columns = self.grid(height, width)
        return Graph("patch", self._module, (1, 3, rows * PATCH_PX, columns * PATCH_PX), ("embeddings",))

    def run_with(self, network: Network) -> None:
        """Run this in place of the network; it takes and returns tensors of the encoder's device."""
        self._network = network
