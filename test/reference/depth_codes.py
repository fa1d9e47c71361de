"""Plain encoders of compressed depth images: number by number, nibble by nibble."""

from __future__ import annotations

import struct

import cv2
import numpy as np


def rvl(pixels: np.ndarray) -> bytes:
    """RVL words of an image of uint16."""
    values = [int(value) for value in pixels.ravel()]
    nibbles: list[int] = []
    previous = at = 0
    while at < len(values):
        zeros = _length(values, at, zero=True)
        others = _length(values, at + zeros, zero=False)
        nibbles += _nibbles(zeros) + _nibbles(others)
        for value in values[at + zeros : at + zeros + others]:
            difference = value - previous
            nibbles += _nibbles(2 * difference if difference >= 0 else -2 * difference - 1)
            previous = value
        at += zeros + others
    nibbles += [0] * (-len(nibbles) % 8)
    words = [int("".join(f"{nibble:x}" for nibble in nibbles[i : i + 8]), 16) for i in range(0, len(nibbles), 8)]
    return b"".join(struct.pack("<I", word) for word in words)


def png(pixels: np.ndarray) -> bytes:
    return cv2.imencode(".png", pixels)[1].tobytes()


def transport(pixels: np.ndarray, code: str, a: float = 0.0, b: float = 0.0) -> bytes:
    """What the compressedDepth plugin sends of an image of uint16."""
    height, width = pixels.shape
    image = png(pixels) if code == "png" else struct.pack("<II", width, height) + rvl(pixels)
    return struct.pack("<iff", 0, a, b) + image


def quantised(depth_m: np.ndarray, depth_max_m: float, quantisation: float) -> tuple[np.ndarray, float, float]:
    """Inverse depth as the plugin stores it, with its A and B."""
    a = quantisation * (quantisation + 1)
    b = 1 - a / depth_max_m
    stored = np.zeros(depth_m.shape, np.uint16)
    for place, depth in np.ndenumerate(depth_m):
        if depth < depth_max_m:  # False for NaN.
            stored[place] = int(a / depth + b)
    return stored, a, b


def _length(values: list[int], start: int, *, zero: bool) -> int:
    stop = start
    while stop < len(values) and (values[stop] == 0) == zero:
        stop += 1
    return stop - start


def _nibbles(value: int) -> list[int]:
    nibbles = [value & 7]
    while value := value >> 3:
        nibbles[-1] |= 8
        nibbles.append(value & 7)
    return nibbles
