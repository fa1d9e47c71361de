"""Scores from cosines."""

from __future__ import annotations

import torch
from torch import Tensor

from fus3dmaps_core.voxel_map.kernels.protocols import Texts


def scores_of(cosines: Tensor, texts: Texts) -> Tensor:
    """Convert cosines (n, p + q) with prompts and negatives to scores (n, p) float32, as :class:`Texts` defines them."""
    positive, negative = cosines[:, : texts.prompts], cosines[:, texts.prompts :]
    if not negative.shape[1]:
        return positive
    # The smallest relevancy is that of the largest negative; the logistic function is its two-way softmax.
    margin = texts.logit_scale * (positive - negative.amax(dim=1, keepdim=True)).to(torch.float64)
    return (0.5 * (1.0 + torch.tanh(0.5 * margin))).to(torch.float32)
