"""Patch embeddings: the classifier on every cell of its last feature map, and the detections around the cell."""

from __future__ import annotations

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn import functional

from fus3dmaps_core.encoders.lite.detector import Detector
from fus3dmaps_core.encoders.lite.evidence import patch_evidence
from fus3dmaps_core.encoders.lite.network import FEATURE_STRIDE, EfficientNetLite0
from fus3dmaps_core.encoders.lite.space import ConceptSpace
from fus3dmaps_core.encoders.protocols import PatchEmbeddings

_UPSAMPLING = 2  # 16-pixel patches from a feature map of stride 32.
_POOLING = 3


class LitePatchEncoder:
    """Embeds 16-pixel patches in one pass of the network."""

    def __init__(self, network: EfficientNetLite0, detector: Detector, space: ConceptSpace, device: str) -> None:
        """Keep the shared models."""
        self._network, self._detector, self._space, self._device = network, detector, space, device

    def grid(self, height: int, width: int) -> tuple[int, int]:
        """Rows and columns of the patch grid; patches are 16 pixels where the image's sides are multiples of 32."""
        return _UPSAMPLING * -(-height // FEATURE_STRIDE), _UPSAMPLING * -(-width // FEATURE_STRIDE)

    def encode_patches(self, rgb: NDArray[np.uint8]) -> PatchEmbeddings:
        """Embed the patches of an (H, W, 3) uint8 image; all weights are 1."""
        rows, columns = self.grid(*rgb.shape[:2])
        cell = FEATURE_STRIDE // _UPSAMPLING
        if rgb.shape[:2] != (rows * cell, columns * cell):
            rgb = np.asarray(cv2.resize(rgb, (columns * cell, rows * cell), interpolation=cv2.INTER_LINEAR), np.uint8)
        evidence = patch_evidence(self._detector.detect(rgb), rows, columns, cell)
        with torch.inference_mode():
            image = torch.from_numpy(np.ascontiguousarray(rgb)).to(self._device).permute(2, 0, 1)[None].float()
            features = functional.avg_pool2d(
                self._network.features(image), _POOLING, 1, _POOLING // 2, count_include_pad=False
            )
            logits = self._network.logits(features.permute(0, 2, 3, 1)).permute(0, 3, 1, 2)
            # The classifier is linear and the weights of the interpolation sum to one: logits of the interpolated features.
            logits = functional.interpolate(logits, scale_factor=_UPSAMPLING, mode="bilinear", align_corners=False)
            embeddings = self._space.embed(logits[0].flatten(1).T.contiguous(), evidence)
        return PatchEmbeddings(embeddings.reshape(rows, columns, -1), np.ones((rows, columns), np.float32))
