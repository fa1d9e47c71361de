"""Patch features of a CLIP image transformer in its image-text space (MaskCLIP, Zhou et al. 2022).

CLIP's last block pools what it attends to into the class token. Without its attention, with the values alone, each patch's
token stays about the patch and still lands in the space of the text embeddings.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import nn
from torch.nn import functional

_INTERMEDIATE_BLOCK = -3  # Whose normalised tokens CLIP-DINOiser's heads were trained on.


class PatchFeatures(NamedTuple):
    """Features of the patches of n images.

    Attributes:
        projected: (n, d, rows, columns), in the image-text space, of any length.
        intermediate: (n, width, rows, columns), input of the heads.
    """

    projected: torch.Tensor
    intermediate: torch.Tensor


class MaskClip(nn.Module):
    """The image transformer of an OpenCLIP model, run at any size.

    Attributes:
        patch_px: Edge of a patch, pixels.
    """

    def __init__(self, visual: Any) -> None:
        """Share the modules of an ``open_clip.transformer.VisionTransformer``; nothing of it is changed."""
        super().__init__()
        self.visual = visual
        self.patch_px = int(visual.patch_size[0])

    def forward(self, images: torch.Tensor) -> PatchFeatures:
        """Compute features of (n, 3, H, W) normalised images whose sides are multiples of ``patch_px``."""
        visual = self.visual
        blocks = list(visual.transformer.resblocks)
        tokens, rows, columns = self._embed(images)
        intermediate = tokens
        for block in blocks[:-1]:
            tokens = tokens + block.ls_1(block.attention(block.ln_1(tokens)))
            normalised = block.ln_2(tokens)
            if block is blocks[_INTERMEDIATE_BLOCK]:
                intermediate = normalised
            tokens = tokens + block.ls_2(block.mlp(normalised))
        last = blocks[-1]
        tokens = tokens + last.ls_1(_values(last, tokens))
        tokens = tokens + last.ls_2(last.mlp(last.ln_2(tokens)))
        projected = visual.ln_post(tokens) @ visual.proj
        return PatchFeatures(_as_grid(projected, rows, columns), _as_grid(intermediate, rows, columns))

    def positions(self, rows: int, columns: int) -> torch.Tensor:
        """Interpolate the position embeddings to a grid of patches, class token first: (1 + rows * columns, width)."""
        embedding = self.visual.positional_embedding
        trained = embedding[1:].T.unflatten(1, tuple(self.visual.grid_size))[None]
        resized = functional.interpolate(trained, (rows, columns), mode="bicubic", align_corners=False)
        return torch.cat([embedding[:1], resized[0].flatten(1).T])

    def _embed(self, images: torch.Tensor) -> tuple[torch.Tensor, int, int]:
        patches = self.visual.conv1(images)
        rows, columns = int(patches.shape[2]), int(patches.shape[3])
        class_token = self.visual.class_embedding.expand(patches.shape[0], 1, -1)
        tokens = torch.cat([class_token, patches.flatten(2).transpose(1, 2)], dim=1)
        return self.visual.ln_pre(tokens + self.positions(rows, columns)), rows, columns


def _values(block: Any, tokens: torch.Tensor) -> torch.Tensor:
    """Compute what a block's attention would give if each token attended to itself alone."""
    attention = block.attn
    width = attention.embed_dim
    values = functional.linear(
        block.ln_1(tokens), attention.in_proj_weight[2 * width :], attention.in_proj_bias[2 * width :]
    )
    output: torch.Tensor = attention.out_proj(values)
    return output


def _as_grid(tokens: torch.Tensor, rows: int, columns: int) -> torch.Tensor:
    """Reshape (n, 1 + rows * columns, c) tokens to (n, c, rows, columns), without the class token."""
    return tokens[:, 1:].transpose(1, 2).reshape(len(tokens), -1, rows, columns)
