"""Crops of a frame as one tensor: padded, resized with their aspect, copied to the device at once and normalised there."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import torch
from numpy.typing import NDArray


class CropBatcher:
    """A cutter of boxes from an image into square inputs of a network.

    A crop keeps its aspect and is not cut: its longer side is scaled to the network's, it is centred along the shorter one,
    and the rest has the mean colour, which the network reads as zero. Pixels around the object inside its box stay: the
    networks were trained on whole pictures [sec: Instance-level mapping].
    """

    def __init__(self, size_px: int, mean: Sequence[float], std: Sequence[float], padding: float, device: str) -> None:
        """Keep what the network expects.

        Args:
            size_px: Edge of its square input, pixels.
            mean: Mean of red, green and blue in [0, 1], which is subtracted.
            std: Standard deviation of the three, which is divided by.
            padding: Added on every side of a box, as a share of its width or height; it ends at the image's border.
            device: Torch device of the network.
        """
        self._size_px, self._padding, self._device = size_px, padding, torch.device(device)
        self._fill = np.rint(255.0 * np.asarray(mean)).astype(np.uint8)
        self._mean = 255.0 * torch.tensor(mean, device=self._device).reshape(1, 3, 1, 1)
        self._std = 255.0 * torch.tensor(std, device=self._device).reshape(1, 3, 1, 1)

    def batch(self, rgb: NDArray[np.uint8], boxes: NDArray[np.int32]) -> torch.Tensor:
        """Cut out n boxes.

        Args:
            rgb: (H, W, 3) uint8.
            boxes: (n, 4) x0, y0, x1, y1 in pixels, x1 and y1 exclusive, each with at least one pixel of the image.

        Returns:
            (n, 3, size, size) float32 on the network's device, normalised.
        """
        pixels = torch.empty((len(boxes), self._size_px, self._size_px, 3), dtype=torch.uint8, pin_memory=self._pinned)
        crops = pixels.numpy()
        crops[:] = self._fill
        for crop, box in zip(crops, boxes, strict=True):
            self._place(rgb, box, crop)
        # As bytes, a quarter of what the device would otherwise be sent.
        images = pixels.to(self._device, non_blocking=self._pinned).permute(0, 3, 1, 2).float()
        return images.sub_(self._mean).div_(self._std)

    @property
    def _pinned(self) -> bool:
        return self._device.type == "cuda"

    def _place(self, rgb: NDArray[np.uint8], box: NDArray[np.int32], crop: NDArray[np.uint8]) -> None:
        height, width = rgb.shape[:2]
        x0, y0, x1, y1 = (int(value) for value in box)
        pad_x, pad_y = int(self._padding * (x1 - x0)), int(self._padding * (y1 - y0))
        window = rgb[max(0, y0 - pad_y) : min(height, y1 + pad_y), max(0, x0 - pad_x) : min(width, x1 + pad_x)]
        scale = self._size_px / max(window.shape[:2])
        rows, columns = (max(1, round(scale * side)) for side in window.shape[:2])
        top, left = (self._size_px - rows) // 2, (self._size_px - columns) // 2
        interpolation = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
        crop[top : top + rows, left : left + columns] = cv2.resize(window, (columns, rows), interpolation=interpolation)
