"""Patch and crop encoders around one torch network each, which takes normalised images and gives unit embeddings.

The trios differ in their networks. How frames and crops are prepared, and how another runtime takes over, is the same.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from fus3dmaps_core.encoders.crop_batches import CropBatcher
from fus3dmaps_core.encoders.network_graphs import Graph, Network
from fus3dmaps_core.encoders.protocols import PatchEmbeddings
from fus3dmaps_core.masks import Masks

_BATCH = 16  # Bounds the memory of a pass; a frame has up to 64 crops.


class NetworkPatchEncoder:
    """A patch encoder that embeds a frame in one pass of a network.

    Attributes:
        network: From (1, 3, H, W) normalised images to (1, rows, columns, d) embeddings and, where it has them, (1, rows,
            columns) saliencies in [0, 1].
    """

    def __init__(
        self,
        network: nn.Module,
        patch_px: int,
        mean: Sequence[float],
        std: Sequence[float],
        device: str,
        outputs: tuple[str, ...] = ("embeddings",),
    ) -> None:
        """Keep the network.

        Args:
            network: On the device, in evaluation mode; it brings images to the precision of its weights.
            patch_px: Edge of a patch, pixels.
            mean: Mean of red, green and blue in [0, 1], which is subtracted.
            std: Standard deviation of the three, which is divided by.
            device: Torch device.
            outputs: Names of the network's outputs; a second one has the weights of the patches, which are 1 otherwise.
        """
        self.network, self._patch_px, self._outputs = network, patch_px, outputs
        self._run: Network = network
        self._device = torch.device(device)
        # Pixels are bytes: (x / 255 - mean) / std in one step.
        self._mean = 255.0 * torch.tensor(mean, device=self._device).reshape(1, 3, 1, 1)
        self._std = 255.0 * torch.tensor(std, device=self._device).reshape(1, 3, 1, 1)

    def grid(self, height: int, width: int) -> tuple[int, int]:
        """Return rows and columns of the patch grid, rounded up."""
        return -(-height // self._patch_px), -(-width // self._patch_px)

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
            found = self._run(image.sub_(self._mean).div_(self._std))
            embeddings, *others = (found,) if isinstance(found, torch.Tensor) else found
            weights = others[0][0].cpu().numpy() if others else np.ones(embeddings.shape[1:3], np.float32)
            return PatchEmbeddings(embeddings[0].cpu().numpy(), weights)

    def graph(self, height: int, width: int) -> Graph:
        """Describe the network at the size that such an image is stretched to."""
        return Graph("patch", self.network, (1, 3, *self._stretched(height, width)), self._outputs)

    def run_with(self, network: Network) -> None:
        """Run this in place of the torch network, see :class:`fus3dmaps_core.encoders.network_graphs.GraphEncoder`."""
        self._run = network

    def _stretched(self, height: int, width: int) -> tuple[int, int]:
        rows, columns = self.grid(height, width)
        return self._patch_px * rows, self._patch_px * columns


class NetworkCropEncoder:
    """A crop encoder that embeds the boxes around masks, in batches.

    Attributes:
        network: From (n, 3, side, side) normalised images to (n, d) embeddings of unit length.
    """

    def __init__(
        self,
        network: nn.Module,
        dimension: int,
        size_px: int,
        mean: Sequence[float],
        std: Sequence[float],
        padding: float,
        device: str,
    ) -> None:
        """Keep the network.

        Args:
            network: On the device, in evaluation mode; it brings images to the precision of its weights.
            dimension: Embedding width d.
            size_px: Edge of its input, pixels.
            mean: Mean of red, green and blue in [0, 1], which is subtracted.
            std: Standard deviation of the three, which is divided by.
            padding: Padding around a mask's box, as a share of its size.
            device: Torch device.
        """
        self.network, self._dimension, self._size_px = network, dimension, size_px
        self._run: Network = network
        self._crops = CropBatcher(size_px, mean, std, padding, device)

    def encode_crops(self, rgb: NDArray[np.uint8], masks: Masks) -> NDArray[np.float32]:
        """Embed one crop per mask of an (H, W, 3) uint8 image: (n, d) float32, unit length."""
        if not len(masks):
            return np.zeros((0, self._dimension), np.float32)
        with torch.inference_mode():
            outputs = [self._run(batch) for batch in torch.split(self._crops.batch(rgb, masks.boxes), _BATCH)]
            parts = [output if isinstance(output, torch.Tensor) else output[0] for output in outputs]
            embeddings: NDArray[np.float32] = torch.cat(parts).cpu().numpy()
        return embeddings

    def graph(self, height: int, width: int) -> Graph:
        """Describe the network for a batch of crops, whose size does not depend on the image's."""
        return Graph("crop", self.network, (_BATCH, 3, self._size_px, self._size_px), ("embeddings",))

    def run_with(self, network: Network) -> None:
        """Run this in place of the torch network, see :class:`fus3dmaps_core.encoders.network_graphs.GraphEncoder`."""
        self._run = network
