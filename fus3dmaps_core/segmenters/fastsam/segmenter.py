"""Masks of everything in a frame, by FastSAM's network with pre- and post-processing of our own."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from fus3dmaps_core.encoders.network_graphs import Network
from fus3dmaps_core.masks import Masks
from fus3dmaps_core.segmenters.fastsam.decoding import masks_of, select
from fus3dmaps_core.segmenters.fastsam.letterbox import Letterbox


class FastSamSegmenter:
    """FastSAM's segmenter: masks at the image's own size, best first. As safe to use from several threads as its network."""

    def __init__(self, network: Network, shape: tuple[int, int], device: str) -> None:
        """Keep the network.

        Args:
            network: Takes a (1, 3, h, w) float32 RGB image in [0, 1] on the device; gives (1, 37, N) detections and
                (1, 32, h / 4, w / 4) prototypes there.
            shape: Its h and w, pixels.
            device: Torch device.
        """
        self._network, self._shape, self._device = network, shape, torch.device(device)

    def segment(self, rgb: NDArray[np.uint8], depth_m: NDArray[np.float32]) -> Masks:
        """Propose masks of an (H, W, 3) uint8 image; depth is not used."""
        height, width = rgb.shape[:2]
        letterbox = Letterbox.of((height, width), self._shape)
        with torch.inference_mode():
            image = torch.from_numpy(letterbox.fit(rgb)).to(self._device).permute(2, 0, 1)[None].float().div_(255.0)
            predictions, prototypes = self._network(image)
            return masks_of(select(predictions[0].float()), prototypes[0].float(), letterbox, height, width)
