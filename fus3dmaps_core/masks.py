"""Masks of one image: what a segmenter hands to the crop encoder and the map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Masks:
    """Class-agnostic masks of one image; they may overlap.

    Attributes:
        masks: (n, H, W) bool.
        boxes: (n, 4) int32, tight bounds x0, y0, x1, y1 in pixels, x1 and y1 exclusive.
    """

    masks: NDArray[np.bool_]
    boxes: NDArray[np.int32]

    @classmethod
    def from_masks(cls, masks: NDArray[np.bool_]) -> Masks:
        """Bound masks by their tight boxes; every mask must hold at least one pixel."""
        n = len(masks)
        boxes = np.zeros((n, 4), np.int32)
        for row, mask in enumerate(masks):
            ys, xs = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
            boxes[row] = xs[0], ys[0], xs[-1] + 1, ys[-1] + 1
        return cls(masks, boxes)

    def __len__(self) -> int:
        """Return the number of masks."""
        return len(self.masks)

    def take(self, rows: NDArray[np.integer] | NDArray[np.bool_]) -> Masks:
        """Return the masks of the given rows, in that order."""
        return Masks(self.masks[rows], self.boxes[rows])
