"""A cache of prompts' embeddings: large text towers take seconds for one prompt on a CPU, and users ask again."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fus3dmaps_core.encoders.protocols import TextEncoder

_CAPACITY = 1000  # Prompts; at d = 1152 they take 5 MB.
_LONGEST = 1000  # Characters of a prompt that is kept.


class CachedTextEncoder:
    """A text encoder that asks another one once for each prompt. Safe to use from several threads if that one is.

    Attributes:
        space: Name of that encoder's trio.
    """

    def __init__(self, encoder: TextEncoder, capacity: int = _CAPACITY) -> None:
        """Keep the encoder.

        Args:
            encoder: The encoder to ask.
            capacity: Prompts that are kept; the one that was not asked for the longest time goes first.
        """
        self._encoder, self._capacity, self.space = encoder, capacity, encoder.space
        self._known: OrderedDict[str, NDArray[np.float32]] = OrderedDict()
        self._lock = threading.Lock()

    def encode_text(self, prompts: Sequence[str]) -> NDArray[np.float32]:
        """Embed n prompts: (n, d) float32, unit length; all unknown ones in one call of the encoder."""
        with self._lock:
            rows = {prompt: self._known[prompt] for prompt in prompts if prompt in self._known}
        unknown = [prompt for prompt in dict.fromkeys(prompts) if prompt not in rows]
        if unknown or not prompts:
            embedded = self._encoder.encode_text(unknown)
            if not prompts:
                return embedded
            rows |= zip(unknown, embedded, strict=True)
        with self._lock:
            for prompt in rows:
                if len(prompt) <= _LONGEST:
                    # A copy: a row would keep the memory of all prompts that were embedded with it.
                    self._known[prompt] = self._known.get(prompt, rows[prompt].copy())
                    self._known.move_to_end(prompt)
            while len(self._known) > self._capacity:
                self._known.popitem(last=False)
        return np.stack([rows[prompt] for prompt in prompts])
