"""The image tower of SigLIP 2 with two ends: one embedding for each patch, or one for the whole image."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, cast

import torch
from torch import nn
from torch.nn import functional

from fus3dmaps_core.encoders.optional_packages import import_optional
from fus3dmaps_core.encoders.siglip_text import TEXT_PREFIX, read_part, weight_names
from fus3dmaps_core.encoders.weights import fit
from fus3dmaps_core.errors import EncoderError

MEAN = STD = (0.5, 0.5, 0.5)
"""Mean and deviation of red, green and blue in [0, 1], with which SigLIP's images are normalised."""

PATCH_PX = 16
WIDTH = 768
"""Length of a token, and of an embedding: the tower has no projection at its end."""

_ENCODER = "siglip2"
_PREFIX = "vision_model."  # Of the tower's weights in the file of the whole model.
_POSITIONS = "embeddings.position_embedding.weight"
_OTHERS = ("logit_bias", "logit_scale")  # Of the loss; cosines are compared as they are.


class SiglipTokens(nn.Module):
    """The tower without its pooling head, at any size.

    Attributes:
        vision: ``SiglipVisionModel`` of ``transformers``; nothing of it is changed.
        size_px: Edge of the square images that it was trained on.
    """

    def __init__(self, vision: Any) -> None:
        """Share the modules of a tower."""
        super().__init__()
        self.vision = vision
        self.size_px = int(vision.config.image_size)

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        """Turn (n, 3, H, W) normalised images, with sides of whole patches, into (n, rows * columns, width) tokens.

        Where the grid is not the trained one the positions are interpolated to it.
        """
        hidden = self.vision.embeddings(images, interpolate_pos_encoding=True)
        hidden = self.vision.encoder(inputs_embeds=hidden).last_hidden_state
        return cast(torch.Tensor, self.vision.post_layernorm(hidden))


class PatchNetwork(nn.Module):
    """The network from normalised images (n, 3, H, W) to patch embeddings (n, rows, columns, d) float32 of unit length.

    SigLIP has no class token: a learned probe attends to all tokens, and what it gathers is the image's embedding after a
    residual MLP. Here it attends, for each patch, to the token of this patch alone. The softmax over one token is 1
    whatever the probe asks, so that the values, the output projection and the MLP are left. This is to SigLIP what MaskCLIP
    (Zhou et al. 2022) is to CLIP: the attention that pools is taken out, the way into the space of the text is kept. The
    attention before it stays as trained. SigLIP 2 was taught what is local in its last phase, by self-distillation and
    masked prediction (Tschannen et al. 2025), which CLIP was not.
    """

    def __init__(self, tokens: SiglipTokens) -> None:
        """Share a tower."""
        super().__init__()
        self.tokens = tokens

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        """Embed the patches, in the precision of the weights up to the last step."""
        rows, columns = images.shape[2] // PATCH_PX, images.shape[3] // PATCH_PX
        embeddings = _unit(token_embeddings(self.tokens.vision.head, self.tokens(images)))
        return embeddings.reshape(len(images), rows, columns, WIDTH)


class CropNetwork(nn.Module):
    """The network from normalised images (n, 3, H, W) to embeddings (n, d) float32 of unit length, one for each image."""

    def __init__(self, tokens: SiglipTokens) -> None:
        """Share a tower."""
        super().__init__()
        self.tokens = tokens

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        """Embed the images, in the precision of the weights up to the last step."""
        return _unit(self.tokens.vision.head(self.tokens(images)))


def token_embeddings(head: Any, tokens: torch.Tensor) -> torch.Tensor:
    """Apply the pooling head to each token as if it were the only one.

    Args:
        head: ``SiglipMultiheadAttentionPoolingHead`` of ``transformers``.
        tokens: (..., width).

    Returns:
        The same shape, of any length.
    """
    attention = head.attention
    width = attention.embed_dim
    values = functional.linear(tokens, attention.in_proj_weight[2 * width :], attention.in_proj_bias[2 * width :])
    pooled = attention.out_proj(values)
    return cast(torch.Tensor, pooled + head.mlp(head.layernorm(pooled)))


def build_vision(size_px: int) -> Any:
    """Build the image tower without memory for its weights, on torch's device ``meta``.

    Args:
        size_px: Edge of the square images that it is trained on.

    Raises:
        EncoderError: The package ``transformers`` is missing.
    """
    transformers = import_optional("transformers", _ENCODER)
    config = transformers.SiglipVisionConfig(
        hidden_size=WIDTH,
        intermediate_size=3072,
        num_hidden_layers=12,
        num_attention_heads=12,
        image_size=size_px,
        patch_size=PATCH_PX,
    )
    with torch.device("meta"):
        vision = transformers.SiglipVisionModel(config).eval().requires_grad_(False)
    return getattr(vision, "vision_model", vision)  # Versions of the package differ in whether a shell is around it.


def read_vision(path: Path) -> SiglipTokens:
    """Load the image tower with the weights of a file, on the CPU in float32.

    Args:
        path: File of the whole model. Its positions say which size it was trained on: all of SigLIP 2's B/16
            models with a fixed size are welcome.

    Raises:
        EncoderError: The package ``transformers`` is missing, or the file is damaged or another model's.
    """
    others = [
        name for name in weight_names(path, _ENCODER) if not name.startswith((_PREFIX, TEXT_PREFIX)) and name not in _OTHERS
    ]
    state = read_part(path, _PREFIX, _ENCODER)
    positions = len(state[_POSITIONS]) if _POSITIONS in state else 0
    side = math.isqrt(positions)
    if others or not positions or side * side != positions:
        found = ", ".join(sorted(others)[:3]) or f"{positions} positions"
        raise EncoderError(f"weights '{path}': not a SigLIP 2 B/16 model of a fixed square size, it has {found}")
    vision = build_vision(side * PATCH_PX)
    # Positions are numbered in a buffer that no file has; the tower makes it anew, with its memory.
    vision = vision.to_empty(device="cpu")
    vision.embeddings.position_ids = torch.arange(positions).expand((1, -1))
    fit(vision, state, f"weights '{path}'")
    return SiglipTokens(vision)


def _unit(embeddings: torch.Tensor) -> torch.Tensor:
    # The length is taken in float32: half precision loses squares.
    return functional.normalize(embeddings.float(), dim=-1)
