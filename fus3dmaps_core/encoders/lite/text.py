"""Sentence embeddings of all-MiniLM-L6-v2: mean pooling over the tokens of a plain transformer, nothing else."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from fus3dmaps_core.encoders.lite.packaged_files import EXTRA, TEXT_CONFIG, TEXT_MODEL, TOKENIZER
from fus3dmaps_core.errors import EncoderError

WIDTH = 384
_MAX_TOKENS = 256  # What the model was trained with; longer prompts are cut.
_BATCH = 64


class SentenceModel:
    """A model of unit embeddings of sentences. Safe to use from several threads."""

    def __init__(self, device: str) -> None:
        """Load the model from the files of its pip package, never from a network.

        Raises:
            EncoderError: The package is missing or its files are altered.
        """
        try:  # Seconds of import, which only those who load the model pay.
            from safetensors.torch import load_file
            from tokenizers import Tokenizer
            from transformers import BertConfig, BertModel
        except ImportError as error:
            raise EncoderError(
                f"parameter 'encoder.name': encoder 'lite' needs '{error.name}', which is not installed; use {EXTRA}"
            ) from None
        model = BertModel(BertConfig.from_json_file(TEXT_CONFIG.locate()))
        state = load_file(TEXT_MODEL.locate())
        state.pop("embeddings.position_ids", None)  # A constant that older versions of the library stored with the weights.
        model.load_state_dict(state, strict=True)
        self._device = torch.device(device)
        self._model = model.eval().requires_grad_(False).to(self._device)
        self._tokenizer = Tokenizer.from_file(str(TOKENIZER.locate()))
        self._tokenizer.enable_truncation(_MAX_TOKENS)
        self._tokenizer.enable_padding()

    def embed(self, sentences: Sequence[str]) -> NDArray[np.float32]:
        """Embed n sentences of any Unicode text: (n, 384) float32, unit length."""
        # Python strings may hold lone surrogates, which no tokenizer takes.
        clean = [sentence.encode("utf-8", "replace").decode("utf-8") for sentence in sentences]
        rows = np.zeros((len(clean), WIDTH), np.float32)
        for start in range(0, len(clean), _BATCH):
            rows[start : start + _BATCH] = self._embed_batch(clean[start : start + _BATCH])
        return rows

    def _embed_batch(self, sentences: list[str]) -> NDArray[np.float32]:
        encodings = self._tokenizer.encode_batch(sentences)
        ids = torch.tensor([encoding.ids for encoding in encodings], device=self._device)
        mask = torch.tensor([encoding.attention_mask for encoding in encodings], device=self._device)
        with torch.inference_mode():
            hidden = self._model(input_ids=ids, attention_mask=mask).last_hidden_state
            weights = mask[..., None].to(hidden.dtype)
            pooled = (hidden * weights).sum(dim=1) / weights.sum(dim=1)
            unit = torch.nn.functional.normalize(pooled, dim=1)
        return unit.cpu().numpy()
