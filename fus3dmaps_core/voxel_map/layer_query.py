"""A query in embeddings: what a layer of the map is asked."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class LayerQuery:
    """What to compare a layer with, and how much of the result to return.

    Attributes:
        layer: One of LAYERS.
        prompts: (p, d) embeddings of what is searched, any length but 0.
        negatives: (q, d) embeddings of what is not meant. With them a score is a probability, without them a cosine.
        logit_scale: Factor of the cosines in that probability.
        threshold: Voxels with a lower score are left out; None leaves none out.
        top_k: At most this many instances per prompt.
        min_voxels: Instances that occupy fewer voxels are not ranked.
    """

    layer: str
    prompts: NDArray[np.floating]
    negatives: NDArray[np.floating] | None = None
    logit_scale: float = 1.0
    threshold: float | None = None
    top_k: int = 5
    min_voxels: int = 1
