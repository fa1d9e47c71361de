"""The networks of the trio: built as published, and the one that turns images into patch embeddings."""

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
from fus3dmaps_core.encoders.weights import find_weights, fit, only_directory, read_state, saying_what_to_get

MEAN = (0.48145466, 0.4578275, 0.40821073)
"""Mean of red, green and blue in [0, 1], with which CLIP's images are normalised."""
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


class ClipCrops(nn.Module):
    """Unit embeddings of normalised images, each as a whole."""

    def __init__(self, visual: Any) -> None:
        """Share an ``open_clip`` image transformer."""
        super().__init__()
        self.visual = visual

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        """Embed (n, 3, side, side) images, normalised with MEAN and STD, as (n, 512)."""
        return functional.normalize(self.visual(images), dim=1)


def build_clip() -> Any:
    """Build the CLIP model of the trio with random weights, on the CPU.

    Raises:
        EncoderError: The package ``open_clip`` is missing.
    """
    models = import_optional("open_clip.model", "clip_dinoiser")
    factory = import_optional("open_clip.factory", "clip_dinoiser")
    return models.CLIP(**factory.get_model_config(ARCHITECTURE)).eval().requires_grad_(False)


def load_clip(weights: str) -> Any:
    """Load the CLIP model onto the CPU, with its published weights or those that ``encoder.weights`` names.

    Raises:
        EncoderError: A package or the weights are missing, damaged, or another architecture's.
    """
    clip = build_clip()
    path = find_weights(_PARAMETER, weights, CLIP)
    with saying_what_to_get(_PARAMETER, CLIP):
        fit(clip, read_state(path), f"weights '{path}'")
    return clip


def load_heads(weights: str) -> DinoiserHeads:
    """Load the heads onto the CPU, with their published weights or those in the directory that ``encoder.weights`` names.

    Raises:
        EncoderError: The weights are missing, damaged, or another architecture's.
    """
    path = find_weights(_PARAMETER, only_directory(weights), HEADS)  # A file or a repository of the hub is CLIP's.
    heads = DinoiserHeads().eval().requires_grad_(False)
    with saying_what_to_get(_PARAMETER, HEADS):
        fit(heads, read_state(path), f"weights '{path}'")
    return heads
