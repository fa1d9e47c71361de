"""The space that pixels and prompts share: convex combinations of semantic embeddings (ConSE, Norouzi et al. 2013).

What a network believes about a piece of image is a distribution over class names; the embedding of the piece is the mean of
the names' text embeddings under it, to which detections add the embeddings of their categories as further evidence. The mean
embedding of all names is subtracted on both sides.

One more component holds the doubt. A mean over classes that disagree is short; scaled to unit length it would point
somewhere by accident and answer some prompt loudly. The constant last component takes up that length instead, and as it is
zero for prompts, the cosine of an undecided embedding with every prompt is small.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from fus3dmaps_core.encoders.lite.text import WIDTH, SentenceModel
from fus3dmaps_core.encoders.lite.vocabulary import Vocabulary, embed_in_forms, possible_classes

DIMENSION = WIDTH + 1

_DOUBT = 0.5
_TEMPERATURE = 2.0
_TOP_CLASSES = 50


class ConceptSpace:
    """The space of ``lite``, which turns class scores into embeddings. Immutable, so safe to use from several threads."""

    def __init__(self, vocabulary: Vocabulary, device: str) -> None:
        """Put the vocabulary on the device of the classifier."""
        possible = np.flatnonzero(possible_classes())
        self._possible = torch.from_numpy(possible).to(device)
        self._imagenet = torch.from_numpy(vocabulary.imagenet[possible]).to(device)
        self._coco = torch.from_numpy(vocabulary.coco).to(device)

    def embed(self, logits: Tensor, evidence: NDArray[np.float32]) -> NDArray[np.float32]:
        """Embed n pieces of image.

        Args:
            logits: (n, 1000) float32 of the classifier, on the device of this space.
            evidence: (n, 91) float32 in [0, 1], how surely a piece shows a COCO category.

        Returns:
            (n, 385) float32, unit length.
        """
        best, classes = logits[:, self._possible].topk(_TOP_CLASSES, dim=1)
        probabilities = torch.softmax(best / _TEMPERATURE, dim=1)
        dense = torch.zeros((len(logits), len(self._possible)), device=logits.device).scatter_(1, classes, probabilities)
        known = dense @ self._imagenet + torch.from_numpy(evidence).to(logits.device) @ self._coco
        doubt = torch.full((len(known), 1), _DOUBT, device=logits.device)
        rows: NDArray[np.float32] = torch.nn.functional.normalize(torch.cat([known, doubt], dim=1), dim=1).cpu().numpy()
        return rows


class LiteTextEncoder:
    """The text encoder of ``lite``, for prompts in the shared space. Safe to use from several threads.

    Attributes:
        space: Name of the trio.
    """

    space = "lite"

    def __init__(self, model: SentenceModel, vocabulary: Vocabulary) -> None:
        """Keep the sentence model and the mean to subtract."""
        self._model = model
        self._mean = vocabulary.mean

    def encode_text(self, prompts: Sequence[str]) -> NDArray[np.float32]:
        """Embed n prompts, as they are and as "a photo of" them: (n, 385) float32, unit length.

        Any Unicode text will do; what exceeds the model's 256 tokens is cut.
        """
        rows = np.zeros((len(prompts), DIMENSION), np.float32)
        rows[:, :WIDTH] = embed_in_forms(self._model, prompts) - self._mean
        rows /= np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-12)
        return rows
