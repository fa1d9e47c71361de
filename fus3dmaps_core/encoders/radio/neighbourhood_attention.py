"""NARADIO's attention: a patch attends to those whose keys are like its own, and to its neighbours a little more.

In place of softmax(Q K^T / sqrt(d)) V of the last block stands softmax(K K^T / sqrt(d) + G) V (Hajimiri et al. 2024,
"NACLIP", as Alama et al. 2025, "RayFronts", put it into RADIO). G is a Gaussian of the distance on the patch grid, 1 at the
patch itself. It is added as it is, not as its logarithm, so distant patches lose at most a factor of e; at prefix tokens it
is 0.
"""

from __future__ import annotations

from typing import Any, cast

import torch
from torch import nn
from torch.nn import functional

SIGMA_PATCHES = 7.0
"""Deviation of the Gaussian, in patches."""

_CACHED = 4  # Patch grids whose windows are kept; a camera has one.


class NeighbourhoodAttention(nn.Module):
    """The attention above with the weights of a ``timm`` attention, which itself is left as it is."""

    def __init__(self, attention: Any, prefix_tokens: int, sigma_patches: float = SIGMA_PATCHES) -> None:
        """Share the weights of the attention whose place this one takes.

        Args:
            attention: A ``timm`` attention with one projection to queries, keys and values.
            prefix_tokens: Tokens before the patches.
            sigma_patches: Deviation of the Gaussian.
        """
        super().__init__()
        self.qkv, self.k_norm, self.proj = attention.qkv, attention.k_norm, attention.proj
        self._heads, self._prefix, self._sigma = int(attention.num_heads), prefix_tokens, sigma_patches
        self._windows: dict[tuple[int, int, torch.dtype, torch.device], torch.Tensor] = {}

    def forward(self, tokens: torch.Tensor, rows: int, columns: int) -> torch.Tensor:
        """Attend.

        Args:
            tokens: (n, prefix + rows * columns, width), the patches row by row.
            rows: Rows of the patch grid.
            columns: Columns of the patch grid.

        Returns:
            The same shape.
        """
        count, length, width = tokens.shape
        parts = (count, length, 3, self._heads, width // self._heads)
        _, keys, values = self.qkv(tokens).reshape(parts).permute(2, 0, 3, 1, 4)
        keys = self.k_norm(keys)
        window = self._window(rows, columns, tokens.dtype, tokens.device)
        attended = functional.scaled_dot_product_attention(keys, keys, values, attn_mask=window)
        return cast(torch.Tensor, self.proj(attended.transpose(1, 2).reshape(count, length, width)))

    def _window(self, rows: int, columns: int, dtype: torch.dtype, device: torch.device) -> torch.Tensor:
        if torch.compiler.is_compiling():  # What is made while a graph is recorded holds no numbers to keep.
            return gaussian_window(rows, columns, self._prefix, self._sigma).to(device, dtype)
        key = (rows, columns, dtype, device)
        window = self._windows.get(key)
        if window is None:
            window = gaussian_window(rows, columns, self._prefix, self._sigma).to(device, dtype)
            while len(self._windows) >= _CACHED:
                self._windows.pop(next(iter(self._windows)))
            self._windows[key] = window
        return window


def gaussian_window(rows: int, columns: int, prefix_tokens: int, sigma_patches: float) -> torch.Tensor:
    """Compute exp(-r^2 / 2 sigma^2) between any two patches at distance r on the grid; 0 for prefix tokens.

    Args:
        rows: Rows of the patch grid.
        columns: Columns of the patch grid.
        prefix_tokens: Tokens before the patches.
        sigma_patches: sigma.

    Returns:
        (prefix + rows * columns, the same) float32.
    """
    down = _gaussian(rows, sigma_patches)
    across = _gaussian(columns, sigma_patches)
    # The Gaussian of a squared distance is the product of those of its two parts: entry (row, column; row, column).
    patches = (down[:, None, :, None] * across[None, :, None, :]).reshape(rows * columns, rows * columns)
    return functional.pad(patches, (prefix_tokens, 0, prefix_tokens, 0))


def _gaussian(length: int, sigma: float) -> torch.Tensor:
    places = torch.arange(length, dtype=torch.float32)
    return torch.exp(-((places[:, None] - places[None, :]) ** 2) / (2.0 * sigma**2))
