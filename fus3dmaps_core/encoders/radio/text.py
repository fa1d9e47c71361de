"""SigLIP's text towers: ``transformers`` builds them, one file holds their weights, another the words that they know."""

from __future__ import annotations

import string
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn import functional

from fus3dmaps_core.encoders.optional_packages import import_optional
from fus3dmaps_core.encoders.radio.published import TextTower
from fus3dmaps_core.encoders.weights import find_weights, fit
from fus3dmaps_core.errors import EncoderError

_PREFIX = "text_model."  # Of the tower's weights in the file of the whole model.
_PUNCTUATION = str.maketrans("", "", string.punctuation)


class SiglipTextEncoder:
    """Embeds prompts in the 80 templates that were made for ImageNet's class names.

    The unit embeddings of a prompt's sentences are averaged, and the mean is brought to unit length.
    """

    def __init__(self, tower: Any, tokenizer: Any, published: TextTower, device: str, encoder: str) -> None:
        """Keep the models.

        Args:
            tower: ``SiglipTextModel`` of ``transformers``, on the device already.
            tokenizer: ``tokenizers.Tokenizer``.
            published: What the two are.
            device: Torch device.
            encoder: Name of the pair, for messages.

        Raises:
            EncoderError: The package ``open_clip``, which has the templates, is missing.
        """
        self._tower, self._tokenizer, self._device = tower, tokenizer, torch.device(device)
        self._published = published
        self._places = torch.arange(published.context, device=self._device)[None]
        self._templates: Sequence[Any] = import_optional("open_clip.zero_shot_metadata", encoder).OPENAI_IMAGENET_TEMPLATES

    def encode_text(self, prompts: Sequence[str]) -> NDArray[np.float32]:
        """Embed n prompts of any Unicode text: (n, d) float32, unit length."""
        rows = np.zeros((len(prompts), self._published.dimension), np.float32)
        for row, prompt in zip(rows, prompts, strict=True):
            # Python strings may hold lone surrogates, which tokenizers do not take.
            clean = prompt.encode("utf-8", "replace").decode("utf-8")
            row[:] = self._embed([canonical(template(clean)) for template in self._templates])
        return rows

    def _embed(self, sentences: list[str]) -> NDArray[np.float32]:
        """Unit mean of the unit embeddings of some sentences: (d,)."""
        with torch.inference_mode():
            # All of the context is attended to, what fills it too: so the tower was trained.
            embeddings = self._tower(input_ids=self._tokens(sentences), position_ids=self._places).pooler_output
            units = functional.normalize(embeddings.float(), dim=1)
            mean: NDArray[np.float32] = functional.normalize(units.mean(dim=0), dim=0).cpu().numpy()
        return mean

    def _tokens(self, sentences: list[str]) -> torch.Tensor:
        """(n, context) tokens; a sentence that is too long is cut, not its end."""
        context, rows = self._published.context, []
        for encoding in self._tokenizer.encode_batch(sentences, add_special_tokens=False):
            row = [*encoding.ids[: context - 1], self._published.end_id]
            rows.append(row + [self._published.pad_id] * (context - len(row)))
        return torch.tensor(rows, device=self._device)


def canonical(text: str) -> str:
    """A text as SigLIP was trained on it: lower case, no punctuation, single spaces."""
    return " ".join(text.replace("_", " ").translate(_PUNCTUATION).lower().split())


def load_text(published: TextTower, weights: str, device: str, encoder: str) -> SiglipTextEncoder:
    """A published text tower with its weights, or those in the directory that ``encoder.weights`` names.

    Raises:
        EncoderError: A package, the weights or the tokenizer are missing, damaged or another model's.
    """
    # A file or a repository of the hub is RADIO's.
    directory = weights if weights and Path(weights).expanduser().is_dir() else ""
    import_optional("open_clip", encoder)
    tower = build_tower(published, encoder).to_empty(device="cpu")
    tokenizer = _read_tokenizer(find_weights("encoder.weights", directory, published.tokenizer), encoder)
    path = find_weights("encoder.weights", directory, published.weights)
    # Versions of the package differ in whether the tower itself has the prefix.
    has_prefix = next(iter(tower.state_dict())).startswith(_PREFIX)
    fit(tower, _read_tower(path, _PREFIX if has_prefix else "", encoder), f"weights '{path}'")
    return SiglipTextEncoder(tower.to(device), tokenizer, published, device, encoder)


def build_tower(published: TextTower, encoder: str) -> Any:
    """A text tower without memory for its weights: on torch's device ``meta``.

    Raises:
        EncoderError: The package ``transformers`` is missing.
    """
    transformers = import_optional("transformers", encoder)
    config = transformers.SiglipTextConfig(
        vocab_size=published.vocabulary,
        hidden_size=published.width,
        intermediate_size=published.hidden,
        num_hidden_layers=published.layers,
        num_attention_heads=published.heads,
        max_position_embeddings=published.context,
        projection_size=published.dimension,
        bos_token_id=None,
        eos_token_id=published.end_id,
        pad_token_id=published.pad_id,
    )
    with torch.device("meta"):
        return transformers.SiglipTextModel(config).eval().requires_grad_(False)


def _read_tower(path: Path, prefix: str, encoder: str) -> dict[str, torch.Tensor]:
    """The tower's weights alone, under another prefix; the file holds gigabytes of others."""
    safetensors = import_optional("safetensors", encoder)
    try:
        with safetensors.safe_open(path, "pt") as file:
            names = [name for name in file.keys() if name.startswith(_PREFIX)]  # noqa: SIM118 (it is no mapping)
            return {prefix + name.removeprefix(_PREFIX): file.get_tensor(name).float() for name in names}
    except (safetensors.SafetensorError, OSError) as error:
        raise EncoderError(f"weights '{path}': not a safetensors file, or cut short: {error}") from None


def _read_tokenizer(path: Path, encoder: str) -> Any:
    tokenizers = import_optional("tokenizers", encoder)
    try:
        return tokenizers.Tokenizer.from_file(str(path))
    except Exception as error:  # The library raises bare exceptions.
        raise EncoderError(f"tokenizer '{path}': cannot be read: {error}") from None
