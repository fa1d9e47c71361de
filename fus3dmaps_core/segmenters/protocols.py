"""What the pipeline needs from a segmenter."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from fus3dmaps_core.masks import Masks


class Segmenter(Protocol):
    """A segmenter, which cuts an image into masks that may be objects, parts of objects or groups of them."""

    def segment(self, rgb: NDArray[np.uint8], depth_m: NDArray[np.float32]) -> Masks:
        """Propose masks.

        Args:
            rgb: (H, W, 3) uint8.
            depth_m: (H, W) float32 metres, 0 where there is no reading; a segmenter may ignore it.
        """
