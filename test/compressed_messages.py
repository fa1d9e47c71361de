"""Images as image_transport compresses them: JPEG, PNG, and depth as PNG or RVL under the header of ``compressedDepth``."""

from __future__ import annotations

import struct
from collections.abc import Iterator

import cv2
import numpy as np


def jpeg(rgb: np.ndarray, quality: int = 95) -> tuple[str, bytes]:
    """Format and data of a colour image."""
    data = cv2.imencode(".jpg", rgb[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    return "rgb8; jpeg compressed bgr8", data.tobytes()


def png(rgb: np.ndarray) -> tuple[str, bytes]:
    return "rgb8; png compressed bgr8", cv2.imencode(".png", rgb[:, :, ::-1])[1].tobytes()


def depth_png(depth_mm: np.ndarray) -> tuple[str, bytes]:
    """Depth under the ``compressed`` transport."""
    return "16UC1; png compressed ", cv2.imencode(".png", depth_mm)[1].tobytes()


def compressed_depth_png(depth_mm: np.ndarray) -> tuple[str, bytes]:
    return "16UC1; compressedDepth png", bytes(12) + cv2.imencode(".png", depth_mm)[1].tobytes()


def compressed_depth_rvl(depth_mm: np.ndarray) -> tuple[str, bytes]:
    height, width = depth_mm.shape
    return "16UC1; compressedDepth rvl", bytes(12) + struct.pack("<II", width, height) + _rvl(depth_mm.ravel().tolist())


def _rvl(pixels: list[int]) -> bytes:
    nibbles = list(_nibbles(pixels))
    nibbles += [0] * (-len(nibbles) % 8)
    words = (nibbles[i : i + 8] for i in range(0, len(nibbles), 8))
    return b"".join(struct.pack("<I", sum(nibble << (28 - 4 * i) for i, nibble in enumerate(word))) for word in words)


def _nibbles(pixels: list[int]) -> Iterator[int]:
    """Of each number three bits at a time, lowest first, the fourth says that more follow."""
    for number in _numbers(pixels):
        while number > 7:
            yield (number & 7) | 8
            number >>= 3
        yield number


def _numbers(pixels: list[int]) -> Iterator[int]:
    position, previous = 0, 0
    while position < len(pixels):
        start = position
        while position < len(pixels) and pixels[position] == 0:
            position += 1
        yield position - start
        start = position
        while position < len(pixels) and pixels[position]:
            position += 1
        yield position - start
        for value in pixels[start:position]:
            delta, previous = value - previous, value
            yield 2 * delta if delta >= 0 else -2 * delta - 1
