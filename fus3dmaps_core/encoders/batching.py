"""Encoders that run out of GPU memory: their batches are halved, and only a single image that does not fit is an error."""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
import torch
from numpy.typing import NDArray

from fus3dmaps_core.errors import EncoderError

_log = logging.getLogger(__name__)

RETRY_AFTER = 100
"""How many batches of the largest size must fit before twice the size is tried again."""


class Batches:
    """The batches in which an encoder embeds many images, as large as its device's memory allows.

    A batch that does not fit is halved, and later ones keep to that size. After ``RETRY_AFTER`` of them twice the size is
    tried, since the memory may be free again. A try that fails loses no image, and as many batches must fit before the next
    one. The limit is lifted once a batch fits that is as large as the first one that did not.

    Attributes:
        largest: Images that are encoded together at most; None while no limit is known.
    """

    def __init__(self, name: str) -> None:
        """Start without a limit; ``name`` says in messages which encoder it is."""
        self._name = name
        self.largest: int | None = None
        self._too_large = 0  # Images of the first batch that did not fit.
        self._fitted = 0  # Batches of the largest size since memory last ran out, or since the size last grew.

    def run(self, encode: Callable[[slice], NDArray[np.float32]], count: int) -> NDArray[np.float32]:
        """Encode images 0 .. count - 1, in one call where memory allows it.

        Where the device is out of memory, the batch is halved, see above.

        Args:
            encode: Encodes the images of a slice: (n, d) float32.
            count: How many images there are.

        Returns:
            (count, d) float32, what ``encode`` returned, in order.

        Raises:
            EncoderError: There is not even memory for one image.
        """
        parts: list[NDArray[np.float32]] = []
        start = 0
        while start < count or not parts:
            size = min(self._size(), count - start)
            images = slice(start, start + size)
            if size <= 1:
                with naming_out_of_memory(self._name):
                    parts.append(encode(images))
                self._fits(size)
                start += 1
                continue
            try:
                parts.append(encode(images))
            except torch.cuda.OutOfMemoryError:
                self._halve(size)
            else:
                self._fits(size)
                start += size
                continue
            # After the except clause: its exception holds the frames, and those what they had allocated.
            free_cached_memory()
            _log.warning("%s: out of memory with %d images at once, going on with %d", self._name, size, self.largest)
        return parts[0] if len(parts) == 1 else np.concatenate(parts)

    def _size(self) -> int:
        """Return how many images the next batch may have."""
        if self.largest is None:
            return sys.maxsize
        return 2 * self.largest if self._fitted >= RETRY_AFTER else self.largest

    def _halve(self, size: int) -> None:
        self._fitted = 0
        if self.largest is None:
            self._too_large = size
        elif size > self.largest:
            return  # A try; what fitted before still does.
        self.largest = size // 2

    def _fits(self, size: int) -> None:
        if self.largest is None or size < self.largest:
            return  # Says nothing about larger ones.
        if size == self.largest:
            self._fitted += 1
            return
        self.largest, self._fitted = (None if size >= self._too_large else size), 0


@contextmanager
def naming_out_of_memory(name: str) -> Iterator[None]:
    """Turn a device's lack of memory inside into an EncoderError that names the encoder or segmenter.

    Raises:
        EncoderError: The device was out of memory; its cached memory was given back.
    """
    cause: str | None = None
    try:
        yield
    except torch.cuda.OutOfMemoryError as error:
        cause = str(error)
    if cause is not None:
        free_cached_memory()
        raise EncoderError(f"{name}: out of memory with a single image: {cause}")


def free_cached_memory() -> None:
    """Give GPU memory that torch keeps for later back to the device, where a GPU is in use."""
    torch.cuda.empty_cache()
