"""The colour scale of similarities, one for pictures, files and published clouds."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray


def similarity_colors(similarity: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Color similarities (n,) on the turbo scale between their smallest and largest value: (n, 3) uint8 RGB."""
    if not len(similarity):
        return np.zeros((0, 3), np.uint8)
    low, high = float(similarity.min()), float(similarity.max())
    shares = (similarity.astype(np.float64) - low) / (high - low) if high > low else np.zeros(len(similarity))
    levels = np.rint(255 * shares).astype(np.uint8)
    return np.ascontiguousarray(cv2.applyColorMap(levels[:, None], cv2.COLORMAP_TURBO)[:, 0, ::-1], dtype=np.uint8)
