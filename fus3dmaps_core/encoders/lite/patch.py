"""Patch embeddings: the classifier on every cell of its last feature map, and the detections around the cell."""

from __future__ import annotations

from typing import cast

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from fus3dmaps_core.encoders.lite.detector import Detector
from fus3dmaps_core.encoders.lite.evidence import patch_evidence
from fus3dmaps_core.encoders.lite.network import FEATURE_STRIDE, EfficientNetLite0, PatchLogits
from fus3dmaps_core.encoders.lite.space import ConceptSpace
from fus3dmaps_core.encoders.network_graphs import Graph, Network
from fus3dmaps_core.encoders.protocols import PatchEmbeddings

_UPSAMPLING = 2  # 16-pixel patches from a feature map of stride 32.
_PATCH_PX = FEATURE_STRIDE // _UPSAMPLING


class LitePatchEncoder:
    """The patch encoder of ``lite``: it embeds 16-pixel patches in one pass of the network."""

    def __init__(self, network: EfficientNetLite0, detector: Detector, space: ConceptSpace, device: str) -> None:
        """Keep the shared models."""
        self._network = PatchLogits(network, _UPSAMPLING).eval()
        self._detector, self._space, self._device = detector, space, device
        self._run: Network = self._network

    def grid(self, height: int, width: int) -> tuple[int, int]:
        """Return rows and columns of the patch grid; patches are 16 pixels where the image's sides are multiples of 32."""
        return _UPSAMPLING * -(-height // FEATURE_STRIDE), _UPSAMPLING * -(-width // FEATURE_STRIDE)

    def encode_patches(self, rgb: NDArray[np.uint8]) -> PatchEmbeddings:
        """Embed the patches of an (H, W, 3) uint8 image; all weights are 1."""
        rows, columns = self.grid(*rgb.shape[:2])
        height, width = rows * _PATCH_PX, columns * _PATCH_PX
        if rgb.shape[:2] != (height, width):
            rgb = np.asarray(cv2.resize(rgb, (width, height), interpolation=cv2.INTER_LINEAR), np.uint8)
        evidence = patch_evidence(self._detector.detect(rgb), rows, columns, _PATCH_PX)
        with torch.inference_mode():
            image = torch.from_numpy(np.ascontiguousarray(rgb)).to(self._device).permute(2, 0, 1)[None].float()
            logits = cast(torch.Tensor, self._run(image))
            embeddings = self._space.embed(logits[0].reshape(rows * columns, -1).contiguous(), evidence)
        return PatchEmbeddings(embeddings.reshape(rows, columns, -1), np.ones((rows, columns), np.float32))

    def graph(self, height: int, width: int) -> Graph:
        """Describe the classifier at the size that such an image is stretched to; the detector is not part of it."""
        rows, columns = self.grid(height, width)
        return Graph("patch", self._network, (1, 3, rows * _PATCH_PX, columns * _PATCH_PX), ("logits",))

    def run_with(self, network: Network) -> None:
        """Run this in place of the torch network, see :class:`fus3dmaps_core.encoders.network_graphs.GraphEncoder`."""
        self._run = network
