"""RADSeg's self-correlating recursive attention: the output of the last block's attention decides where a second one looks.

The attention of the block is run as trained. Its output, after the output projection, is cut into as many parts as there
are heads; the cosines between two tokens' parts, times a scale, are the logits of a second attention over the same values,
where tokens of negative cosine have no share (Alama et al. 2025, "RADSeg"). All tokens take part, those before the patches
too.
"""

from __future__ import annotations

from typing import Any, cast

import torch
from torch import nn
from torch.nn import functional

SCALE = 10.0
"""Of the cosines, as the authors use it."""


class RecursiveAttention(nn.Module):
    """The attention above with the weights of a ``timm`` attention, which itself is left as it is."""

    def __init__(self, attention: Any, scale: float = SCALE) -> None:
        """Share the weights of the attention whose place this one takes.

        Args:
            attention: A ``timm`` attention with one projection to queries, keys and values.
            scale: Factor of the cosines.
        """
        super().__init__()
        self.qkv, self.q_norm, self.k_norm, self.proj = attention.qkv, attention.q_norm, attention.k_norm, attention.proj
        self._heads, self._scale = int(attention.num_heads), scale

    def forward(self, tokens: torch.Tensor, rows: int, columns: int) -> torch.Tensor:
        """Attend, twice.

        Args:
            tokens: (n, prefix + rows * columns, width).
            rows: Rows of the patch grid; where a patch lies has no influence.
            columns: Columns of the patch grid.

        Returns:
            The same shape.
        """
        count, length, width = tokens.shape
        parts = (count, length, self._heads, width // self._heads)
        queries, keys, values = self.qkv(tokens).reshape(count, length, 3, *parts[2:]).permute(2, 0, 3, 1, 4)
        attended = functional.scaled_dot_product_attention(self.q_norm(queries), self.k_norm(keys), values)
        first = self.proj(attended.transpose(1, 2).reshape(count, length, width))

        units = functional.normalize(first.reshape(parts).transpose(1, 2), dim=-1)
        logits = self._scale * (units @ units.transpose(-2, -1))
        shares = logits.masked_fill(logits < 0, -torch.inf).softmax(dim=-1)
        return cast(torch.Tensor, self.proj((shares @ values).transpose(1, 2).reshape(count, length, width)))
