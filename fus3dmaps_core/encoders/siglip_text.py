"""SigLIP's text towers: ``transformers`` builds them, one file holds their weights, another the words that they know.

Several trios embed into the space of such a tower; each says which tower it is and which templates it uses.
"""

from __future__ import annotations

import logging
import string
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn import functional

from fus3dmaps_core.encoders.optional_packages import import_optional
from fus3dmaps_core.encoders.weights import WeightFile, fit, read_state
from fus3dmaps_core.errors import EncoderError

TEXT_PREFIX = "text_model."
"""Of a tower's weights in the file of the whole model."""

_log = logging.getLogger(__name__)

_SLOW_PRODUCTS = 1e12  # Of a prompt, minutes on a few cores; SO400M has 2e12, the base model with its 7 templates 4e10.
_SAFETENSORS = ".safetensors"
_PUNCTUATION = str.maketrans("", "", string.punctuation)


@dataclass(frozen=True)
class TextTower:
    """A published text tower of SigLIP's kind.

    Attributes:
        weights: File of the whole model, as the package ``transformers`` names its weights.
        tokenizer: Its tokenizer.
        vocabulary: How many tokens it knows.
        end_id: Token that ends a sentence.
        pad_id: Token that fills the context, and that the embedding is read from.
        dimension: Length of an embedding.
        width: Length of a token inside.
        hidden: Width inside the MLPs.
        layers: How many blocks.
        heads: Number of attention heads.
        context: Tokens of a sentence.
        templates: Name of the list of sentences in ``open_clip.zero_shot_metadata`` that a prompt is put into.
    """

    weights: WeightFile
    tokenizer: WeightFile
    vocabulary: int
    end_id: int
    pad_id: int
    dimension: int = 1152
    width: int = 1152
    hidden: int = 4304
    layers: int = 27
    heads: int = 16
    context: int = 64
    templates: str = "OPENAI_IMAGENET_TEMPLATES"


class SiglipTextEncoder:
    """A text encoder that puts prompts into templates made for ImageNet's class names.

    The unit embeddings of a prompt's sentences are averaged, and the mean is brought to unit length.

    Attributes:
        space: Name of the trio.
    """

    def __init__(self, tower: Any, tokenizer: Any, published: TextTower, device: str, encoder: str) -> None:
        """Keep the models.

        Args:
            tower: ``SiglipTextModel`` of ``transformers``, on the device already.
            tokenizer: ``tokenizers.Tokenizer``.
            published: What the two are.
            device: Torch device.
            encoder: Name of the trio.

        Raises:
            EncoderError: The package ``open_clip``, which has the templates, is missing.
        """
        self._tower, self._tokenizer, self._device = tower, tokenizer, torch.device(device)
        self._published, self.space = published, encoder
        self._places = torch.arange(published.context, device=self._device)[None]
        metadata = import_optional("open_clip.zero_shot_metadata", encoder)
        self._templates: Sequence[Callable[[str], str]] = getattr(metadata, published.templates)

    @property
    def products(self) -> float:
        """Multiplications that a prompt takes in the linear layers, which are nearly all."""
        tower = self._published
        weights = tower.layers * (4 * tower.width**2 + 2 * tower.width * tower.hidden)
        return float(weights * tower.context * len(self._templates))

    def encode_text(self, prompts: Sequence[str]) -> NDArray[np.float32]:
        """Embed n prompts of any Unicode text: (n, d) float32, unit length."""
        rows = np.zeros((len(prompts), self._published.dimension), np.float32)
        for row, prompt in zip(rows, prompts, strict=True):
            # Python strings may hold lone surrogates, which tokenizers do not take.
            clean = prompt.encode("utf-8", "replace").decode("utf-8")
            row[:] = self._embed([canonical(template(clean)) for template in self._templates])
        return rows

    def _embed(self, sentences: list[str]) -> NDArray[np.float32]:
        """Average the unit embeddings of some sentences and normalise the mean: (d,)."""
        with torch.inference_mode():
            # All of the context is attended to, what fills it too: so the tower was trained.
            embeddings = self._tower(input_ids=self._tokens(sentences), position_ids=self._places).pooler_output
            units = functional.normalize(embeddings.float(), dim=1)
            mean: NDArray[np.float32] = functional.normalize(units.mean(dim=0), dim=0).cpu().numpy()
        return mean

    def _tokens(self, sentences: list[str]) -> torch.Tensor:
        """Tokenize sentences: (n, context). A sentence that is too long is cut before its end token."""
        context, rows = self._published.context, []
        for encoding in self._tokenizer.encode_batch(sentences, add_special_tokens=False):
            row = [*encoding.ids[: context - 1], self._published.end_id]
            rows.append(row + [self._published.pad_id] * (context - len(row)))
        return torch.tensor(rows, device=self._device)


def canonical(text: str) -> str:
    """Write a text as SigLIP's authors do in zero-shot tests: lower case, no punctuation, single spaces.

    SigLIP 2's own tokenizer brings texts to lower case, which is done already then, and leaves the rest as it is.
    """
    return " ".join(text.replace("_", " ").translate(_PUNCTUATION).lower().split())


def read_text(
    published: TextTower, model: Path, tokenizer: Path, device: str, encoder: str, dtype: torch.dtype = torch.float32
) -> SiglipTextEncoder:
    """Load a text tower with the weights of a file.

    Args:
        published: What is known of it.
        model: File of the whole model.
        tokenizer: JSON file of the package ``tokenizers``.
        device: Torch device.
        encoder: Name of the trio, for messages.
        dtype: Precision of the tower; embeddings are averaged and handed out in float32.

    Raises:
        EncoderError: A package is missing, or a file is damaged or another model's.

    Logs a warning where the device is the CPU and the tower so large that answers take long.
    """
    tower = build_tower(published, encoder).to_empty(device="cpu")
    words = _read_tokenizer(tokenizer, encoder)
    # Versions of the package differ in whether the tower itself has the prefix.
    prefix = TEXT_PREFIX if next(iter(tower.state_dict())).startswith(TEXT_PREFIX) else ""
    state = read_part(model, TEXT_PREFIX, encoder)
    fit(tower, {prefix + name: value for name, value in state.items()}, f"weights '{model}'")
    text = SiglipTextEncoder(tower.to(device, dtype), words, published, device, encoder)
    if torch.device(device).type == "cpu" and text.products > _SLOW_PRODUCTS:
        _log.warning(
            "encoder '%s': its text tower is large and runs on the CPU, where a prompt may take more than a minute the first"
            " time; on a GPU ('encoder.device') it takes a moment",
            encoder,
        )
    return text


def build_tower(published: TextTower, encoder: str) -> Any:
    """Build a text tower without memory for its weights, on torch's device ``meta``.

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


def read_part(path: Path, prefix: str, encoder: str) -> dict[str, torch.Tensor]:
    """Read the weights of one tower alone, in float32 and without their prefix.

    Of a safetensors file nothing else is read.

    Args:
        path: File of the whole model.
        prefix: Before the names of these weights.
        encoder: Name of the trio, for messages.

    Raises:
        EncoderError: The package ``safetensors`` is missing, or the file is no weight file.
    """
    if path.suffix != _SAFETENSORS:
        state = read_state(path)
        return {name.removeprefix(prefix): value.float() for name, value in state.items() if name.startswith(prefix)}
    with _opened(path, encoder) as file:
        names = [name for name in file.keys() if name.startswith(prefix)]  # noqa: SIM118 (it is no mapping)
        return {name.removeprefix(prefix): file.get_tensor(name).float() for name in names}


def weight_names(path: Path, encoder: str) -> list[str]:
    """List the names of all weights in a file.

    Raises:
        EncoderError: As :func:`read_part`.
    """
    if path.suffix != _SAFETENSORS:
        return list(read_state(path))
    with _opened(path, encoder) as file:
        return list(file.keys())


@contextmanager
def _opened(path: Path, encoder: str) -> Iterator[Any]:
    safetensors = import_optional("safetensors", encoder)
    try:
        with safetensors.safe_open(path, "pt") as file:
            yield file
    except (safetensors.SafetensorError, OSError) as error:
        raise EncoderError(f"weights '{path}': not a safetensors file, or cut short: {error}") from None


def _read_tokenizer(path: Path, encoder: str) -> Any:
    tokenizers = import_optional("tokenizers", encoder)
    try:
        return tokenizers.Tokenizer.from_file(str(path))
    except Exception as error:  # The library raises bare exceptions.
        raise EncoderError(f"tokenizer '{path}': cannot be read: {error}") from None
