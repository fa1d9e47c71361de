"""Crop embeddings: the classifier on the masked crops, and the detections that overlap them."""

from __future__ import annotations

from typing import cast

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from fus3dmaps_core.encoders.lite.detector import Detector
from fus3dmaps_core.encoders.lite.evidence import crop_evidence
from fus3dmaps_core.encoders.lite.network import CLASSES, MEAN, EfficientNetLite0
from fus3dmaps_core.encoders.lite.space import ConceptSpace
from fus3dmaps_core.encoders.network_graphs import Graph, Network
from fus3dmaps_core.masks import Masks

# The network was trained at 224 pixels; most crops are smaller than this, and results are as good in half the time.
_SIZE_PX = 160
_BATCH = 8  # Larger batches fall out of a small machine's cache and are slower.


class LiteCropEncoder:
    """The crop encoder of ``lite``: it embeds the objects behind masks, in batches."""

    def __init__(
        self, network: EfficientNetLite0, detector: Detector, space: ConceptSpace, padding: float, device: str
    ) -> None:
        """Keep the shared models and the padding around a box, as a share of its size."""
        self._network, self._detector, self._space = network, detector, space
        self._padding, self._device = padding, device
        self._run: Network = network

    def encode_crops(self, rgb: NDArray[np.uint8], masks: Masks) -> NDArray[np.float32]:
        """Embed one crop per mask of an (H, W, 3) uint8 image: (n, 385) float32, unit length."""
        evidence = crop_evidence(self._detector.detect(rgb), masks.boxes)
        with torch.inference_mode():
            logits = torch.zeros((len(masks), CLASSES), device=self._device)
            for start in range(0, len(masks), _BATCH):
                rows = range(start, min(start + _BATCH, len(masks)))
                crops = np.stack([self._crop(rgb, masks.masks[row], masks.boxes[row]) for row in rows])
                images = torch.from_numpy(crops).to(self._device).permute(0, 3, 1, 2).float()
                logits[start : start + _BATCH] = cast(torch.Tensor, self._run(images))
            return self._space.embed(logits, evidence)

    def graph(self, height: int, width: int) -> Graph:
        """Describe the classifier for a batch of crops, whatever the image's size; the detector is not part of it."""
        return Graph("crop", self._network, (_BATCH, 3, _SIZE_PX, _SIZE_PX), ("logits",))

    def run_with(self, network: Network) -> None:
        """Run this in place of the torch network, see :class:`fus3dmaps_core.encoders.network_graphs.GraphEncoder`."""
        self._run = network

    def _crop(self, rgb: NDArray[np.uint8], mask: NDArray[np.bool_], box: NDArray[np.int32]) -> NDArray[np.uint8]:
        height, width = mask.shape
        x0, y0, x1, y1 = (int(value) for value in box)
        pad_x, pad_y = int(self._padding * (x1 - x0)), int(self._padding * (y1 - y0))
        window = np.s_[max(0, y0 - pad_y) : min(height, y1 + pad_y), max(0, x0 - pad_x) : min(width, x1 + pad_x)]
        # An object's neighbours would be classified as well: outside the mask is what the network reads as zero.
        crop = np.where(mask[window][..., None], rgb[window], np.uint8(MEAN))
        shrinks = max(crop.shape[:2]) > _SIZE_PX
        interpolation = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
        return np.asarray(cv2.resize(crop, (_SIZE_PX, _SIZE_PX), interpolation=interpolation), np.uint8)
