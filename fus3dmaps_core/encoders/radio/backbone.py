"""RADIO's image transformer, with two ends: its own last block for whole pictures, and one that keeps patches apart.

Patches come from the last block with another attention (:mod:`.neighbourhood_attention`, :mod:`.recursive_attention`), its
norms and its MLP unchanged; summaries come from the block as it was trained. Both ends share all weights, and the network
that was handed in is not altered.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import torch
from torch import nn

from fus3dmaps_core.errors import EncoderError

DenseAttention = Callable[[Any, int], nn.Module]
"""Makes the attention of the patches' end from that of the last block and the number of prefix tokens; the module is called
with tokens, rows and columns of the patch grid."""


class RadioBackbone(nn.Module):
    """RADIO's transformer, which turns normalised images into tokens.

    Attributes:
        patch_px: Edge of a patch, pixels; both sides of an image must be multiples of it.
        width: Length of a token.
        mean: Mean of red, green and blue in [0, 1], which an image is normalised with, once and outside of this module: what
            RADIO's input conditioner holds, which is therefore not run.
        std: Their deviation, likewise.
    """

    def __init__(self, radio: Any, attention: DenseAttention) -> None:
        """Take RADIO's network apart.

        Args:
            radio: ``RADIOModel`` over a ``timm`` vision transformer.
            attention: See :data:`DenseAttention`.

        Raises:
            EncoderError: It is another kind of network.
        """
        super().__init__()
        vit = radio.model
        if not all(hasattr(vit, name) for name in ("patch_generator", "blocks", "norm")):
            raise EncoderError(f"encoder.weights: RADIO network '{type(vit).__name__}' is no vision transformer of timm's")
        self._prefix = int(radio.num_summary_tokens)
        self._embed = vit.patch_generator
        self._blocks = nn.ModuleList(vit.blocks[:-1])
        self._last = vit.blocks[-1]
        self._dense_attention = attention(self._last.attn, self._prefix)
        self._norm, self._feature_norm = vit.norm, radio.feature_normalizer
        self.patch_px, self.width = int(radio.patch_size), int(vit.embed_dim)
        self.mean = _colour(radio.input_conditioner.norm_mean)
        self.std = _colour(radio.input_conditioner.norm_std)

    def patches(self, images: torch.Tensor) -> torch.Tensor:
        """Compute the features of all patches.

        Args:
            images: (n, 3, H, W) float, normalised with ``mean`` and ``std``.

        Returns:
            (n, H / patch_px, W / patch_px, width).
        """
        rows, columns = (side // self.patch_px for side in images.shape[2:])
        block, tokens = self._last, self._tokens(images)
        # A block of timm's, for inference, with the attention exchanged.
        tokens = tokens + block.ls1(self._dense_attention(block.norm1(tokens), rows, columns))
        tokens = tokens + block.ls2(block.mlp(block.norm2(tokens)))
        features = self._feature_norm(self._norm(tokens)[:, self._prefix :])
        return cast(torch.Tensor, features.reshape(len(images), rows, columns, self.width))

    def summary(self, images: torch.Tensor, token: int) -> torch.Tensor:
        """Compute one of the tokens before the patches, which describe the whole image.

        Args:
            images: As for :meth:`patches`.
            token: Its place.

        Returns:
            (n, width).
        """
        return cast(torch.Tensor, self._norm(self._last(self._tokens(images)))[:, token])

    def _tokens(self, images: torch.Tensor) -> torch.Tensor:
        tokens = self._embed(images)
        for block in self._blocks:
            tokens = block(tokens)
        return cast(torch.Tensor, tokens)


def _colour(values: torch.Tensor) -> tuple[float, float, float]:
    red, green, blue = (float(value) for value in values.flatten())
    return red, green, blue
