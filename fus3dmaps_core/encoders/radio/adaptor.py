"""From RADIO's features into a vision-language space: the head that was trained to imitate a teacher's image embedding.

The head was trained on summary tokens alone. Patch features go through it as well: last-layer features of patches and of
summaries are alike enough that text finds them, which the heads for the teacher's patches do not offer (Alama et al. 2025,
"RayFronts"). They are projected at once, not when a query comes, since the fusion of the layers needs one space.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

import torch
from torch import nn
from torch.nn import functional

from fus3dmaps_core.encoders.radio.backbone import RadioBackbone
from fus3dmaps_core.encoders.radio.checkout import import_from
from fus3dmaps_core.encoders.radio.checkpoint import Checkpoint
from fus3dmaps_core.errors import EncoderError


class SummaryHead(nn.Module):
    """The head that imitates a teacher's image embedding.

    Attributes:
        token: Place of the summary token that it was trained on.
        dimension: Length of its output, d.
    """

    def __init__(self, mlp: Any, token: int, dimension: int) -> None:
        """Keep the network."""
        super().__init__()
        self._mlp, self.token, self.dimension = mlp, token, dimension

    @property
    def dtype(self) -> torch.dtype:
        """Precision of the weights."""
        return cast(torch.Tensor, next(self._mlp.parameters())).dtype

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        """Project (..., width) features: (..., d) float32, unit length."""
        # The length is taken in float32: half precision loses squares.
        return functional.normalize(self._mlp(features).float(), dim=-1)


class PatchNetwork(nn.Module):
    """The network from normalised images (n, 3, H, W) to patch embeddings (n, rows, columns, d) float32 of unit length."""

    def __init__(self, backbone: RadioBackbone, head: SummaryHead) -> None:
        """Join the two; both may be shared."""
        super().__init__()
        self.backbone, self.head = backbone, head

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        """Embed the patches of float32 images, in the precision of the weights up to the last step."""
        return cast(torch.Tensor, self.head(self.backbone.patches(images.to(self.head.dtype))))


class CropNetwork(nn.Module):
    """The network from normalised images (n, 3, H, W) to embeddings (n, d) float32 of unit length, one for each image."""

    def __init__(self, backbone: RadioBackbone, head: SummaryHead) -> None:
        """Join the two; both may be shared."""
        super().__init__()
        self.backbone, self.head = backbone, head

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        """Embed float32 images, in the precision of the weights up to the last step."""
        return cast(torch.Tensor, self.head(self.backbone.summary(images.to(self.head.dtype), self.head.token)))


def load_head(checkpoint: Checkpoint, name: str, checkout: Path, encoder: str) -> SummaryHead:
    """Load the head of a teacher with the checkpoint's weights onto the CPU.

    Args:
        checkpoint: The checkpoint that the head is in.
        name: Name of the teacher.
        checkout: RADIO's code.
        encoder: Name of the trio, for messages.

    Raises:
        EncoderError: The checkpoint has no such teacher, or its head is not as it should be.
    """
    options, known = checkpoint.options, [str(teacher["name"]) for teacher in checkpoint.options.teachers]
    if name not in known:
        raise EncoderError(
            f"weights '{checkpoint.path}': encoder '{encoder}' needs a RADIO checkpoint with the adaptor '{name}', "
            f"this one has {', '.join(known)}"
        )
    index = known.index(name)
    teacher = options.teachers[index]
    prefixes = (f"_heads.{index}.", f"_heads.{name}.")
    state = {
        f"summary.{key.removeprefix(prefix)}": value.float()
        for prefix in prefixes
        for key, value in checkpoint.state.items()
        if key.startswith(prefix)
    }
    factory = import_from(checkout, "radio.adaptor_module_factory", encoder)
    try:
        mlp = factory.create_mlp_from_state(
            teacher.get("mlp_version", options.mlp_version),
            state,
            "summary.",
            spectral_weights=getattr(options, "spectral_heads", False),
        )
        width = int(next(mlp.parameters()).shape[-1])
        dimension = int(mlp(torch.zeros(1, width)).shape[1])
    except (KeyError, ValueError, RuntimeError) as error:
        raise EncoderError(
            f"weights '{checkpoint.path}': the head of adaptor '{name}' is missing or another one's: {error}"
        ) from None
    # Either each teacher has a summary token of its own, in the order of its slot, or all share the first.
    token = int(teacher.get("token_slot", index)) if getattr(options, "cls_token_per_teacher", True) else 0
    return SummaryHead(mlp.eval().requires_grad_(False).float(), token, dimension)
