"""Text embeddings: CLIP's, averaged over the prompt templates that were made for ImageNet's class names."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn import functional

from fus3dmaps_core.encoders.optional_packages import import_optional

_BATCH = 80  # Sentences of a pass; a prompt has as many templates.


class ClipTextEncoder:
    """CLIP's text encoder with CLIP-DINOiser's templates: a prompt is 80 sentences, whose unit embeddings are averaged.

    Attributes:
        space: Name of the trio.
    """

    space = "clip_dinoiser"

    def __init__(self, clip: Any, device: str) -> None:
        """Keep an ``open_clip`` CLIP model, on the device already, and make its tokenizer, which comes with the package.

        Raises:
            EncoderError: The package ``open_clip`` is missing.
        """
        self._clip, self._device = clip, torch.device(device)
        self._dimension = int(clip.text_projection.shape[1])
        self._tokenizer = import_optional("open_clip.tokenizer", "clip_dinoiser").SimpleTokenizer()
        metadata = import_optional("open_clip.zero_shot_metadata", "clip_dinoiser")
        self._templates: Sequence[Any] = metadata.OPENAI_IMAGENET_TEMPLATES

    def encode_text(self, prompts: Sequence[str]) -> NDArray[np.float32]:
        """Embed n prompts of any Unicode text: (n, 512) float32, unit length."""
        rows = np.zeros((len(prompts), self._dimension), np.float32)
        for row, prompt in zip(rows, prompts, strict=True):
            # Python strings may hold lone surrogates, which the tokenizer does not take.
            clean = prompt.encode("utf-8", "replace").decode("utf-8")
            row[:] = self._embed([template(clean) for template in self._templates])
        return rows

    def _embed(self, sentences: list[str]) -> NDArray[np.float32]:
        """Average the unit embeddings of some sentences and normalise the mean: (512,)."""
        with torch.inference_mode():
            tokens = self._tokenizer(sentences).to(self._device)
            parts = [functional.normalize(self._sentences(batch), dim=1) for batch in torch.split(tokens, _BATCH)]
            mean: NDArray[np.float32] = functional.normalize(torch.cat(parts).mean(dim=0), dim=0).cpu().numpy()
        return mean

    def _sentences(self, tokens: torch.Tensor) -> torch.Tensor:
        """Embed (n, context) tokens with CLIP: (n, 512).

        No token attends to later ones and the end token is what counts, so the positions after the longest sentence are
        left out: the numbers are the same in a fifth of the time.
        """
        clip = self._clip
        ends = tokens.argmax(dim=1)  # The end token has the highest number.
        length = int(ends.max()) + 1
        hidden = clip.token_embedding(tokens[:, :length]) + clip.positional_embedding[:length]
        hidden = clip.transformer(hidden, attn_mask=clip.attn_mask[:length, :length])
        last: torch.Tensor = clip.ln_final(hidden[torch.arange(len(tokens), device=self._device), ends])
        projection: torch.Tensor = clip.text_projection
        return last @ projection
