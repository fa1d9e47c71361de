"""Arrays that are needed for a moment, again and again.

The system makes the memory of a fresh array page by page as it is touched. For megabytes that takes longer than what is
computed in them, and it stops other threads meanwhile. So memory that was used is kept for the next call.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

_KEPT_BYTES = 48 * 2**20


class Scratch:
    """Lends arrays; safe to use from several threads."""

    def __init__(self, kept_bytes: int = _KEPT_BYTES) -> None:
        """Keep at most ``kept_bytes`` while nobody uses them."""
        self._kept_bytes = kept_bytes
        self._kept: list[NDArray[np.uint8]] = []
        self._lock = threading.Lock()

    @contextmanager
    def lend(self, shape: tuple[int, ...], dtype: DTypeLike) -> Iterator[NDArray[Any]]:
        """Lend an array of undefined content for as long as the context lasts."""
        nbytes = math.prod(shape) * np.dtype(dtype).itemsize
        buffer = self._take(1 << max(nbytes - 1, 63).bit_length())  # Few sizes, so that what is kept fits the next one.
        try:
            yield buffer[:nbytes].view(dtype).reshape(shape)
        finally:
            self._give_back(buffer)

    @property
    def nbytes(self) -> int:
        """Bytes kept while nobody uses them."""
        with self._lock:
            return sum(buffer.nbytes for buffer in self._kept)

    def _take(self, nbytes: int) -> NDArray[np.uint8]:
        with self._lock:
            for place in range(len(self._kept) - 1, -1, -1):  # The last one used may still be in the processor's cache.
                if self._kept[place].nbytes == nbytes:
                    return self._kept.pop(place)
        return np.empty(nbytes, np.uint8)

    def _give_back(self, buffer: NDArray[np.uint8]) -> None:
        with self._lock:
            self._kept.append(buffer)
            while sum(each.nbytes for each in self._kept) > self._kept_bytes:
                self._kept.pop(0)  # The one that has waited longest.
