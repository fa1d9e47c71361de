"""Patch and crop embeddings of frames through the RADIO networks; the one place where their images are normalised."""

from __future__ import annotations

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from fus3dmaps_core.encoders.crop_batches import CropBatcher
from fus3dmaps_core.encoders.protocols import PatchEmbeddings
from fus3dmaps_core.encoders.radio.adaptor import CropNetwork, PatchNetwork
from fus3dmaps_core.masks import Masks

_BATCH = 16  # Bounds the memory of a pass; a frame has up to 64 crops.


class RadioPatchEncoder:
    """Embeds 16-pixel patches in one pass; all weights are 1.

    Attributes:
        network: From normalised images to embeddings; another that gives the same may be put in its place.
    """

    def __init__(self, network: PatchNetwork, device: str, dtype: torch.dtype) -> None:
        """Keep the network, which is on the device already, its weights in the given precision."""
        self.network, self._device, self._dtype = network, torch.device(device), dtype
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
        height, width = (self.network.backbone.patch_px * side for side in (rows, columns))
        if rgb.shape[:2] != (height, width):
            rgb = np.asarray(cv2.resize(rgb, (width, height), interpolation=cv2.INTER_LINEAR), np.uint8)
        with torch.inference_mode():
            image = torch.from_numpy(np.ascontiguousarray(rgb)).to(self._device).permute(2, 0, 1)[None].float()
            embeddings = self.network(image.sub_(self._mean).div_(self._std).to(self._dtype))
            return PatchEmbeddings(embeddings[0].cpu().numpy(), np.ones((rows, columns), np.float32))


class RadioCropEncoder:
    """Embeds the boxes around masks by the summary of each crop.

    Attributes:
        network: From normalised images to embeddings.
    """

    def __init__(self, network: CropNetwork, size_px: int, padding: float, device: str, dtype: torch.dtype) -> None:
        """Keep the network, which is on the device already.

        Args:
            network: Its weights in the given precision.
            size_px: Edge of its input, a multiple of a patch's.
            padding: Around a mask's box, as a share of its size.
            device: Torch device.
            dtype: Precision of the weights.
        """
        self.network, self._dtype = network, dtype
        self._crops = CropBatcher(size_px, network.backbone.mean, network.backbone.std, padding, device)

    def encode_crops(self, rgb: NDArray[np.uint8], masks: Masks) -> NDArray[np.float32]:
        """Embed one crop per mask of an (H, W, 3) uint8 image: (n, d) float32, unit length."""
        if not len(masks):
            return np.zeros((0, self.network.head.dimension), np.float32)
        with torch.inference_mode():
            images = self._crops.batch(rgb, masks.boxes).to(self._dtype)
            parts = [self.network(batch) for batch in torch.split(images, _BATCH)]
            embeddings: NDArray[np.float32] = torch.cat(parts).cpu().numpy()
        return embeddings
