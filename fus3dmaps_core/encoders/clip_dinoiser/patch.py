"""Patch embeddings of a frame: CLIP features pooled where CLIP-DINOiser sees one object."""

from __future__ import annotations

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from fus3dmaps_core.encoders.clip_dinoiser.network import MEAN, STD, ClipDinoiser
from fus3dmaps_core.encoders.graphs import Graph, Network
from fus3dmaps_core.encoders.protocols import PatchEmbeddings


class DinoiserPatchEncoder:
    """Embeds 16-pixel patches in one pass; the weight of a patch is its saliency."""

    def __init__(self, network: ClipDinoiser, device: str) -> None:
        """Keep the network, which is on the device already."""
        self._network, self._device = network, torch.device(device)
        self._run: Network = network
        self._mean = 255.0 * torch.tensor(MEAN, device=self._device).reshape(1, 3, 1, 1)
        self._std = 255.0 * torch.tensor(STD, device=self._device).reshape(1, 3, 1, 1)

    def grid(self, height: int, width: int) -> tuple[int, int]:
        """Rows and columns of the patch grid: one per 16 pixels, rounded up."""
        patch_px = self._network.maskclip.patch_px
        return -(-height // patch_px), -(-width // patch_px)

    def encode_patches(self, rgb: NDArray[np.uint8]) -> PatchEmbeddings:
        """Embed the patches of an (H, W, 3) uint8 image.

        Where its sides are no multiples of a patch's the image is stretched to the next ones, so that the grid covers the
        image and nothing else; padding would make the last patches smaller than the map takes them for.
        """
        height, width = self._stretched(*rgb.shape[:2])
        if rgb.shape[:2] != (height, width):
            rgb = np.asarray(cv2.resize(rgb, (width, height), interpolation=cv2.INTER_LINEAR), np.uint8)
        with torch.inference_mode():
            image = torch.from_numpy(np.ascontiguousarray(rgb)).to(self._device).permute(2, 0, 1)[None].float()
            embeddings, saliency = self._run(image.sub_(self._mean).div_(self._std))
            return PatchEmbeddings(embeddings[0].cpu().numpy(), saliency[0].cpu().numpy())

    def graph(self, height: int, width: int) -> Graph:
        """The network at the size that an image of this one is stretched to: embeddings and saliencies."""
        return Graph("patch", self._network, (1, 3, *self._stretched(height, width)), ("embeddings", "saliency"))

    def run_with(self, network: Network) -> None:
        """Run this in place of the torch network, see :class:`fus3dmaps_core.encoders.graphs.GraphEncoder`."""
        self._run = network

    def _stretched(self, height: int, width: int) -> tuple[int, int]:
        rows, columns = self.grid(height, width)
        return self._network.maskclip.patch_px * rows, self._network.maskclip.patch_px * columns
