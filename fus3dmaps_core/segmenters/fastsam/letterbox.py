"""An image fitted into the fixed input of a network with its aspect kept, grey beside it; as FastSAM was trained."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

_GREY = 114


@dataclass(frozen=True)
class Letterbox:
    """Where an image lies in the network's input.

    Attributes:
        shape: Height and width of the input, pixels.
        height: Height of the image in the input, pixels.
        width: Width of the image in the input, pixels.
        top: Rows of grey above it.
        left: Columns of grey on its left.
    """

    shape: tuple[int, int]
    height: int
    width: int
    top: int
    left: int

    @classmethod
    def of(cls, image: tuple[int, int], shape: tuple[int, int]) -> Letterbox:
        """Fit an image of this height and width into an input of that height and width, centred."""
        gain = min(shape[0] / image[0], shape[1] / image[1])
        height, width = (max(1, round(side * gain)) for side in image)
        # An odd row or column of grey goes below, or to the right.
        return cls(shape, height, width, (shape[0] - height) // 2, (shape[1] - width) // 2)

    def fit(self, rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Make the (height, width, 3) uint8 input for an (H, W, 3) uint8 image."""
        if rgb.shape[:2] != (self.height, self.width):
            rgb = np.asarray(cv2.resize(rgb, (self.width, self.height), interpolation=cv2.INTER_LINEAR), np.uint8)
        if (self.height, self.width) == self.shape:
            return np.ascontiguousarray(rgb)
        fitted = np.full((*self.shape, 3), _GREY, np.uint8)
        fitted[self.top : self.top + self.height, self.left : self.left + self.width] = rgb
        return fitted
