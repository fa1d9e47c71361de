"""Pooling of patch features over the patches that belong together."""

from __future__ import annotations

import torch

THRESHOLD = 0.2
"""Patches that correlate less are of different things (gamma of Wysoczanska et al. 2024)."""

_EPSILON = 1e-6


def guided_pooling(features: torch.Tensor, correlations: torch.Tensor, threshold: float = THRESHOLD) -> torch.Tensor:
    """Replace the features of each patch by a mean over all patches, weighted by their correlation with it.

    Args:
        features: (n, d, rows, columns).
        correlations: (n, rows * columns, rows * columns), patches in row-major order; 1 on the diagonal.
        threshold: Smaller correlations count as 0.

    Returns:
        (n, d, rows, columns).
    """
    weights = torch.where(correlations < threshold, 0.0, correlations)
    pooled = weights @ features.flatten(2).transpose(1, 2) / (weights.sum(dim=2, keepdim=True) + _EPSILON)
    return pooled.transpose(1, 2).reshape(features.shape)
