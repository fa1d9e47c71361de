"""Text embeddings of a simulated vision-language space: similar within a group of meanings, less so between groups.

Every vector is a sum of three orthogonal directions: one that all texts share (texts of CLIP-like spaces fill a narrow
cone), one that a group of related things shares, and one of its own. With a the cosine of unrelated and b that of related
texts, their squared shares are a, b - a and 1 - b; for a text without a group they are a, 0 and 1 - a.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fus3dmaps_core.errors import ConfigError

GROUPS: tuple[frozenset[str], ...] = tuple(
    frozenset(words.split())
    for words in (
        "chair stool armchair sofa couch bench seat seating ottoman pouf",
        "table desk counter worktop sideboard nightstand",
        "cabinet shelf shelving bookshelf bookcase cupboard wardrobe drawer drawers dresser locker chest",
        "cup mug bottle vase glass bowl jug pot plate kettle",
        "monitor screen tv television laptop computer keyboard mouse printer",
        "book books magazine paper folder notebook",
        "lamp light lighting lantern chandelier",
        "bed mattress pillow cushion blanket duvet",
        "sink toilet bathtub bath shower basin faucet",
        "refrigerator fridge oven stove microwave dishwasher washer machine",
        "wall ceiling floor column pillar beam stair stairs",
        "door window curtain blind blinds",
        "plant flower tree cactus",
        "picture painting poster photograph mirror",
        "box basket bin can bag suitcase bucket crate",
        "rug carpet mat towel",
    )
)
"""Groups of words with related meanings. A text belongs to the group of its last word that is in any group."""

_KIND_COMMON, _KIND_GROUP, _KIND_TEXT = 11, 12, 13


@dataclass(frozen=True)
class TextSimilarity:
    """Mean cosine of two texts, 0 <= ``unrelated`` <= ``related`` < 1.

    Single cosines scatter around the mean, because the texts' own directions are random: by (1 - related) / sqrt(dimension)
    within a group, by no more than (1 - unrelated) / sqrt(dimension) between texts of different groups.

    Attributes:
        unrelated: Cosine of texts of different groups or of no group. For short prompts, CLIP-like models have 0.5 to 0.7.
        related: Cosine of texts of one group.
    """

    unrelated: float = 0.6
    related: float = 0.8

    def __post_init__(self) -> None:
        """Raise ConfigError unless the numbers are in order."""
        if not 0.0 <= self.unrelated <= self.related < 1.0:
            raise ConfigError(f"text similarity needs 0 <= unrelated <= related < 1, got {self}")


class ClassTexts:
    """The text embeddings of a simulation.

    A vector depends only on its text, the seed, the dimension and the similarity, not on the other classes.
    """

    def __init__(
        self, class_names: Sequence[str], dimension: int, seed: int, similarity: TextSimilarity | None = None
    ) -> None:
        """Embed the classes.

        Args:
            class_names: As in ``Truth``. The first is empty and stands for nothing; it has an embedding too, for pixels that
                show nothing.
            dimension: Width d of the embeddings, at least 4.
            seed: Seed of all directions.
            similarity: Mean cosines; None takes the defaults.

        Raises:
            ConfigError: The dimension is too small, or the seed negative.
        """
        if dimension < 4 or seed < 0:
            raise ConfigError(f"class texts need a dimension >= 4 and a seed >= 0, got {dimension} and {seed}")
        self._dimension, self._seed = dimension, seed
        self._similarity = similarity or TextSimilarity()
        self._common = self._direction(_KIND_COMMON, 0)
        self._known: dict[str, NDArray[np.float32]] = {}
        self.vectors: NDArray[np.float32] = self.encode(class_names)

    def encode(self, prompts: Sequence[str]) -> NDArray[np.float32]:
        """Embed n texts as (n, d) float32 unit vectors. Case and outer spaces do not matter.

        A text that is no class name is embedded like one: by its group, with a seeded direction of its own.
        """
        rows = np.empty((len(prompts), self._dimension), np.float32)
        for row, prompt in enumerate(prompts):
            text = prompt.strip().lower()
            if text not in self._known:
                self._known[text] = self._compose(text)
            rows[row] = self._known[text]
        return rows

    def _compose(self, text: str) -> NDArray[np.float32]:
        unrelated, related = self._similarity.unrelated, self._similarity.related
        vector = np.sqrt(unrelated) * self._common
        taken, group = [self._common], group_of(text)
        if group is not None:
            taken.append(self._direction(_KIND_GROUP, group, taken))
            vector = vector + np.sqrt(related - unrelated) * taken[-1]
        own_share = 1.0 - (unrelated if group is None else related)
        vector = vector + np.sqrt(own_share) * self._direction(_KIND_TEXT, zlib.crc32(text.encode()), taken)
        return np.asarray(vector / np.linalg.norm(vector), np.float32)

    def _direction(self, kind: int, number: int, orthogonal_to: Sequence[NDArray[np.float64]] = ()) -> NDArray[np.float64]:
        """Draw a random unit vector that is orthogonal to the given orthonormal vectors."""
        vector = np.random.default_rng((self._seed, kind, number)).standard_normal(self._dimension)
        for other in orthogonal_to:
            vector -= (vector @ other) * other
        direction: NDArray[np.float64] = vector / np.linalg.norm(vector)
        return direction


def group_of(text: str) -> int | None:
    """Return the group of a text: that of its last word that is in one, as in "office chair"; None without one."""
    for word in reversed(text.lower().replace("-", " ").replace("_", " ").split()):
        for number, words in enumerate(GROUPS):
            if word in words:
                return number
    return None
