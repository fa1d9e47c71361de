"""Stand-ins for the encoders: every object has a direction of its own, every observation of it is that plus noise."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

_DIRECTIONS = 1024
_NOISES = 2048
NOISE = 0.75
"""Length of the noise beside a unit direction: the cosine of the two is 1 / sqrt(1 + 0.75^2) = 0.8 on average."""


def unit_vectors(count: int, dimension: int, rng: np.random.Generator) -> NDArray[np.float32]:
    """Draw random directions, (count, dimension) float32."""
    vectors = rng.standard_normal((count, dimension), np.float32)
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


class ObservedObjects:
    """Observations of objects; cheap to make, since both parts come from tables."""

    def __init__(self, dimension: int, seed: int) -> None:
        """Draw the tables.

        Args:
            dimension: Embedding width d.
            seed: Same seed, same observations.
        """
        self._rng = np.random.default_rng([seed, dimension])
        self.directions = unit_vectors(_DIRECTIONS, dimension, self._rng)
        self._noise = unit_vectors(_NOISES, dimension, self._rng) * np.float32(NOISE)

    def observe(self, objects: NDArray[np.int64]) -> NDArray[np.float32]:
        """Draw one observation of each object: (n, d) float32, not of unit length."""
        noise = self._noise[self._rng.integers(0, _NOISES, len(objects))]
        return np.asarray(self.directions[objects % _DIRECTIONS] + noise)


class KnownText:
    """A text encoder that answers every prompt with one vector.

    Attributes:
        space: Empty, as in maps that do not say whose embeddings they hold.
    """

    space = ""

    def __init__(self, vector: NDArray[np.float32]) -> None:
        """Hold the answer, (d,) float32."""
        self._vector = vector

    def encode_text(self, prompts: Sequence[str]) -> NDArray[np.float32]:
        """Return the vector once per prompt: (n, d)."""
        return np.repeat(self._vector[None], len(prompts), axis=0)
