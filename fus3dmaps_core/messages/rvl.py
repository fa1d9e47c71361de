"""Decoder of RVL, the lossless code for depth images of A. D. Wilson (Fast Lossless Depth Image Compression, 2017).

The image is one row of pixels, coded as runs. A run is a number of zeros, a number of non-zeros, and for each non-zero its
difference to the last non-zero before it, anywhere in the image. Differences are folded to natural numbers (0, -1, 1, -2 ...
become 0, 1, 2, 3 ...). Every number is cut into groups of three bits, lowest first; each group is stored in a nibble whose
highest bit says that another follows. Eight nibbles, the first one highest, make a 32-bit word in the byte order of the
machine that wrote it: little-endian here.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from fus3dmaps_core.errors import FrameError

_MAX_NIBBLES = 11  # A number of 32 bits has this many.
_LARGEST = 65535


def decode_rvl(data: bytes, pixels: int) -> NDArray[np.uint16]:
    """Decode the pixels of an image.

    Args:
        data: Words of the code; what follows the last pixel is ignored.
        pixels: Number of pixels, positive.

    Returns:
        (pixels,) uint16.

    Raises:
        FrameError: Reason ``bad_compression``: the code ends before the last pixel or is not valid: a run passes the last
            pixel, or a value leaves the range 1 to 65535.
    """
    numbers = _numbers(data)
    zeros, others = _runs(numbers, pixels)
    runs = len(zeros)
    is_reading = np.tile([False, True], runs).repeat(np.stack([zeros, others], axis=1).ravel())
    is_folded = np.tile([False, True], runs).repeat(np.stack([np.full(runs, 2), others], axis=1).ravel())
    # Unfolding: an odd number is a negative difference. The bitwise form needs no branch.
    folded = numbers[: len(is_folded)][is_folded]
    readings = np.cumsum((folded >> 1) ^ -(folded & 1))
    if len(readings) and not (readings.min() >= 1 and readings.max() <= _LARGEST):
        raise _damaged(f"RVL data holds readings from {readings.min()} to {readings.max()}, not from 1 to {_LARGEST}")
    image = np.zeros(pixels, np.uint16)
    image[is_reading] = readings
    return image


def _numbers(data: bytes) -> NDArray[np.int64]:
    """Read all complete numbers of the code in order; stop at one of more than 32 bits."""
    words = np.frombuffer(data, "<u4", count=len(data) // 4)
    octets = words.astype(">u4").view(np.uint8)
    nibbles = np.stack([octets >> 4, octets & 0xF], axis=1).ravel()
    lasts = np.flatnonzero(nibbles < 8)
    firsts = np.concatenate([[0], lasts[:-1] + 1]) if len(lasts) else lasts
    lengths = lasts - firsts + 1
    too_long = np.flatnonzero(lengths > _MAX_NIBBLES)
    if len(too_long):
        firsts, lengths = firsts[: too_long[0]], lengths[: too_long[0]]
    numbers: NDArray[np.int64] = (nibbles[firsts] & 7).astype(np.int64)
    longer: NDArray[Any] = np.arange(len(firsts))
    for place in range(1, _MAX_NIBBLES):
        longer = longer[lengths[longer] > place]
        numbers[longer] |= (nibbles[firsts[longer] + place] & 7).astype(np.int64) << (3 * place)
    return numbers


def _runs(numbers: NDArray[np.int64], pixels: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Count the zeros and the non-zeros of each run."""
    row = numbers.tolist()
    runs = []
    pixel = at = 0
    while pixel < pixels:
        if at + 2 > len(row):
            raise _damaged(f"RVL data ends after {pixel} of {pixels} pixels")
        zeros, others = row[at], row[at + 1]
        length = zeros + others
        if not 0 < length <= pixels - pixel:
            raise _damaged(f"RVL data has a run of {length} pixels where 1 to {pixels - pixel} are left")
        at += 2 + others
        if at > len(row):
            raise _damaged(f"RVL data ends within a run at pixel {pixel} of {pixels}")
        pixel += length
        runs.append((zeros, others))
    table = np.array(runs, np.int64)
    return table[:, 0], table[:, 1]


def _damaged(message: str) -> FrameError:
    return FrameError(message, reason="bad_compression")
