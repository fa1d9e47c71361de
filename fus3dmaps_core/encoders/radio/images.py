"""Patch and crop embeddings of frames through the RADIO networks; the one place where their images are normalised."""

from __future__ import annotations

from typing import cast

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from fus3dmaps_core.encoders.crop_batches import CropBatcher
from fus3dmaps_core.encoders.graphs import Graph, Network
from fus3dmaps_core.encoders.protocols import PatchEmbeddings
from fus3dmaps_core.encoders.radio.adaptor import CropNetwork, PatchNetwork
from fus3dmaps_core.masks import Masks

_BATCH = 16  # Bounds the memory of a pass; a frame has up to 64 crops.


class RadioPatchEncoder:
    """Embeds 16-pixel patches in one pass; all weights are 1.

    Attributes:
        network: From normalised images to embeddings, in torch.
    """

    def __init__(self, network: PatchNetwork, device: str, dtype: torch.dtype) -> None:
        """Keep the network, on the device already, and bring its weights to the given precision."""
        self.network, self._device = network.to(dtype), torch.device(device)
        self._run: Network = self.network
        # Pixels are bytes: (x / 255 - mean) / std in one step.
        self._mean = 255.0 * torch.tensor(network.backbone.mean, device=self._device).reshape(1, 3, 1, 1)
        self._std = 255.0 * torch.tensor(network.backbone.std, device=self._device).reshape(1, 3, 1, 1)

    def grid(self, height: int, width: int) -> tuple[int, int]:
        """Rows and columns of the patch grid: one per 16 pixels, rounded up."""
        patch_px = self.network.backbone.patch_px
        return -(-height // patch_px), -(-width // patch_px)

    def encode_patches(self, rgb: NDArray[np.uint8]) -> PatchEmbeddings:
        """Embed the patches of an (H, W, 3) uint8 image.

        Where its sides are no multiples of a patch's the image is stretched to the next ones, so that the grid covers the
        image and nothing else.
        """
        rows, columns = self.grid(*rgb.shape[:2])
        height, width = self._stretched(*rgb.shape[:2])
        if rgb.shape[:2] != (height, width):
            rgb = np.asarray(cv2.resize(rgb, (width, height), interpolation=cv2.INTER_LINEAR), np.uint8)
        with torch.inference_mode():
            image = torch.from_numpy(np.ascontiguousarray(rgb)).to(self._device).permute(2, 0, 1)[None].float()
            embeddings = cast(torch.Tensor, self._run(image.sub_(self._mean).div_(self._std)))
            return PatchEmbeddings(embeddings[0].cpu().numpy(), np.ones((rows, columns), np.float32))

    def graph(self, height: int, width: int) -> Graph:
        """The network at the size that an image of this one is stretched to."""
        return Graph("patch", self.network, (1, 3, *self._stretched(height, width)), ("embeddings",))

    def run_with(self, network: Network) -> None:
        """Run this in place of the torch network, see :class:`fus3dmaps_core.encoders.graphs.GraphEncoder`."""
        self._run = network

    def _stretched(self, height: int, width: int) -> tuple[int, int]:
        rows, columns = self.grid(height, width)
        return self.network.backbone.patch_px * rows, self.network.backbone.patch_px * columns


class RadioCropEncoder:
    """Embeds the boxes around masks by the summary of each crop.

    Attributes:
        network: From normalised images to embeddings, in torch.
    """

    def __init__(self, network: CropNetwork, size_px: int, padding: float, device: str, dtype: torch.dtype) -> None:
        """Keep the network, which is on the device already.

        Args:
            network: Its weights are brought to the given precision.
            size_px: Edge of its input, a multiple of a patch's.
            padding: Around a mask's box, as a share of its size.
            device: Torch device.
            dtype: Precision of the weights.
        """
        self.network, self._size_px = network.to(dtype), size_px
        self._run: Network = self.network
        self._crops = CropBatcher(size_px, network.backbone.mean, network.backbone.std, padding, device)

    def encode_crops(self, rgb: NDArray[np.uint8], masks: Masks) -> NDArray[np.float32]:
        """Embed one crop per mask of an (H, W, 3) uint8 image: (n, d) float32, unit length."""
        if not len(masks):
            return np.zeros((0, self.network.head.dimension), np.float32)
        with torch.inference_mode():
            images = self._crops.batch(rgb, masks.boxes)
            parts = [cast(torch.Tensor, self._run(batch)) for batch in torch.split(images, _BATCH)]
            embeddings: NDArray[np.float32] = torch.cat(parts).cpu().numpy()
        return embeddings

    def graph(self, height: int, width: int) -> Graph:
        """The network for a batch of crops, whose size is that of no image."""
        return Graph("crop", self.network, (_BATCH, 3, self._size_px, self._size_px), ("embeddings",))

    def run_with(self, network: Network) -> None:
        """Run this in place of the torch network, see :class:`fus3dmaps_core.encoders.graphs.GraphEncoder`."""
        self._run = network
