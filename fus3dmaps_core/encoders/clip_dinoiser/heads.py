"""The two convolutions of CLIP-DINOiser (Wysoczanska et al. 2024): which patches belong together, and which to an object."""

from __future__ import annotations

import torch
from torch import nn
from torch.nn import functional

WIDTH = 768
"""Channels of the CLIP features that the heads read."""

_CORRELATION_WIDTH = 256
_KERNEL = 3


class DinoiserHeads(nn.Module):
    """Two layers that imitate, from CLIP's own features, what DINO and FOUND say of an image.

    Attributes:
        obj_proj: Projects into a space in which patches of one object are alike, as DINO's are.
        bkg_decoder: Tells whether a patch belongs to an object, as FOUND does. Both names are the published file's.
    """

    def __init__(self) -> None:
        """Make both layers; their weights are loaded from elsewhere."""
        super().__init__()
        self.obj_proj = nn.Conv2d(WIDTH, _CORRELATION_WIDTH, _KERNEL, padding=_KERNEL // 2, padding_mode="replicate")
        self.bkg_decoder = nn.Conv2d(WIDTH, 1, 1)

    def correlations(self, features: torch.Tensor) -> torch.Tensor:
        """Compute the cosines between the patches of each image.

        Args:
            features: (n, 768, rows, columns).

        Returns:
            (n, rows * columns, rows * columns), patches in row-major order.
        """
        unit = functional.normalize(self.obj_proj(features).flatten(2), dim=1)
        return unit.transpose(1, 2) @ unit

    def saliency(self, features: torch.Tensor) -> torch.Tensor:
        """Compute the probability that a patch belongs to an object.

        Args:
            features: (n, 768, rows, columns).

        Returns:
            (n, rows, columns) in [0, 1].
        """
        logits: torch.Tensor = self.bkg_decoder(functional.normalize(features, dim=1))
        return torch.sigmoid(logits[:, 0])
