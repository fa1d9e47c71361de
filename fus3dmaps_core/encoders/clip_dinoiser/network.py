"""The networks of the pair: built as published, and the one that turns images into patch embeddings."""

from __future__ import annotations

from typing import Any

import torch
from torch import nn
from torch.nn import functional

from fus3dmaps_core.encoders.clip_dinoiser.guided_pooling import guided_pooling
from fus3dmaps_core.encoders.clip_dinoiser.heads import DinoiserHeads
from fus3dmaps_core.encoders.clip_dinoiser.maskclip import MaskClip
from fus3dmaps_core.encoders.clip_dinoiser.published import ARCHITECTURE, CLIP, HEADS
from fus3dmaps_core.encoders.optional_packages import import_optional
from fus3dmaps_core.encoders.weights import find_weights, fit, local_path, read_state

MEAN = (0.48145466, 0.4578275, 0.40821073)
"""Of red, green and blue in [0, 1], which CLIP's images are normalised with."""
STD = (0.26862954, 0.26130258, 0.27577711)

_PARAMETER = "encoder.weights"


class ClipDinoiser(nn.Module):
    """Patch embeddings and saliencies of normalised images, in one pass.

    Attributes:
        maskclip: Patch features of CLIP.
        heads: CLIP-DINOiser's heads.
    """

    def __init__(self, visual: Any, heads: DinoiserHeads) -> None:
        """Join an ``open_clip`` image transformer and the heads."""
        super().__init__()
        self.maskclip = MaskClip(visual)
        self.heads = heads

    def forward(self, images: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Embed the patches of images whose sides are multiples of a patch's.

        Args:
            images: (n, 3, H, W) float, normalised with MEAN and STD.

        Returns:
            (n, rows, columns, 512) of unit length, and (n, rows, columns) saliencies in [0, 1].
        """
        features = self.maskclip(images)
        pooled = guided_pooling(features.projected, self.heads.correlations(features.intermediate))
        return functional.normalize(pooled.permute(0, 2, 3, 1), dim=3), self.heads.saliency(features.intermediate)


def build_clip() -> Any:
    """The CLIP model of the pair with random weights, on the CPU.

    Raises:
        EncoderError: The package ``open_clip`` is missing.
    """
    models = import_optional("open_clip.model", "clip_dinoiser")
    factory = import_optional("open_clip.factory", "clip_dinoiser")
    return models.CLIP(**factory.get_model_config(ARCHITECTURE)).eval().requires_grad_(False)


def load_clip(weights: str) -> Any:
    """The CLIP model with its published weights, or those that ``encoder.weights`` says, on the CPU.

    Raises:
        EncoderError: A package or the weights are missing, damaged, or another architecture's.
    """
    clip = build_clip()
    path = find_weights(_PARAMETER, weights, CLIP)
    fit(clip, read_state(path), f"weights '{path}'")
    return clip


def load_heads(weights: str) -> DinoiserHeads:
    """The heads with their published weights, or those in the directory that ``encoder.weights`` says, on the CPU.

    Raises:
        EncoderError: The weights are missing, damaged, or another architecture's.
    """
    # A file or a repository of the hub is CLIP's.
    place = local_path(weights)
    path = find_weights(_PARAMETER, weights if place is not None and place.is_dir() else "", HEADS)
    heads = DinoiserHeads().eval().requires_grad_(False)
    fit(heads, read_state(path), f"weights '{path}'")
    return heads
