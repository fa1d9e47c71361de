"""What the pipeline needs from an encoder trio. Encoders know images and text, never the map.

All three encoders of a trio write into one d-dimensional vision-language space [sec: Vision Models]: the cosine of any two
of their outputs is a similarity.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from fus3dmaps_core.masks import Masks


@dataclass(frozen=True)
class PatchEmbeddings:
    """Embeddings of a regular grid of patches that covers the whole image.

    Attributes:
        embeddings: (rows, columns, d) float32, unit length.
        weights: (rows, columns) float32 in [0, 1], the weight of one observation of a patch (1, or a saliency).
    """

    embeddings: NDArray[np.float32]
    weights: NDArray[np.float32]


class PatchEncoder(Protocol):
    """An encoder of every patch of an image, in one pass."""

    def grid(self, height: int, width: int) -> tuple[int, int]:
        """Return rows and columns of the patch grid for an image of this size, without running the model."""

    def encode_patches(self, rgb: NDArray[np.uint8]) -> PatchEmbeddings:
        """Embed the patches of an (H, W, 3) image."""


class CropEncoder(Protocol):
    """An encoder of the masked objects of an image."""

    def encode_crops(self, rgb: NDArray[np.uint8], masks: Masks) -> NDArray[np.float32]:
        """Embed one crop per mask.

        Args:
            rgb: (H, W, 3) uint8.
            masks: n masks of this image; ``masks.boxes`` bound the crops, before padding.

        Returns:
            (n, d) float32, unit length.
        """


class TextEncoder(Protocol):
    """An encoder of prompts."""

    @property
    def space(self) -> str:
        """Registry name of its trio; a map of another one refuses its queries."""

    def encode_text(self, prompts: Sequence[str]) -> NDArray[np.float32]:
        """Embed n prompts; templates, where the trio uses them, are applied in here.

        Returns:
            (n, d) float32, unit length.
        """


@dataclass(frozen=True)
class EncoderTrio:
    """Three encoders of one space.

    Attributes:
        name: Registry name; a saved map remembers it and refuses the queries of another.
        dimension: Embedding width d.
        variance_ratio: lambda = R^D / R^I, the per-observation variance of the patch embeddings over that of the crops.
        logit_scale: Factor before the softmax over cosines (100 for CLIP-like spaces).
        patch: Patch encoder.
        crop: Crop encoder.
        text: Text encoder.
    """

    name: str
    dimension: int
    variance_ratio: float
    logit_scale: float
    patch: PatchEncoder
    crop: CropEncoder
    text: TextEncoder
