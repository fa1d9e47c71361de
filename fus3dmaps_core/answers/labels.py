"""Labels for the whole map: every voxel gets the name that fits it best."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fus3dmaps_core.answers.query import check_layer, check_space, check_texts
from fus3dmaps_core.encoders.protocols import TextEncoder
from fus3dmaps_core.errors import QueryError
from fus3dmaps_core.voxel_map.semantic_map import SemanticMap

DEFAULT_LABEL_LAYER = "fused_dense"


@dataclass(frozen=True)
class LabelledVoxels:
    """Voxels with a label each.

    Attributes:
        layer: The layer that was asked.
        points_m: (n, 3) float32 voxel centres, metres, map frame.
        labels: (n,) int32, which of the names fits best; of equal ones the first.
        scores: (n,) float32 cosine similarity with that name.
    """

    layer: str
    points_m: NDArray[np.float32]
    labels: NDArray[np.int32]
    scores: NDArray[np.float32]


def label_voxels(
    semantic_map: SemanticMap, text_encoder: TextEncoder, labels: Sequence[str], layer: str = DEFAULT_LABEL_LAYER
) -> LabelledVoxels:
    """Give every voxel of a layer its label, at one moment. The map is not changed.

    Args:
        semantic_map: The map.
        text_encoder: Encodes the names.
        labels: The names.
        layer: One of LAYERS.

    Raises:
        QueryError: A name is empty or too long, the layer is unknown or empty, or the encoder is another trio's; the message
            names the field.
    """
    if not labels:
        raise QueryError("labels: at least one label is needed")
    check_texts("labels", labels)
    check_layer(layer)
    check_space(semantic_map, text_encoder)
    if semantic_map.voxel_count == 0:
        raise QueryError("the map is empty: nothing has been mapped yet")
    found = semantic_map.label(layer, text_encoder.encode_text(labels))
    if not len(found.points_m):
        raise QueryError(f"layer: '{layer}' is empty in this map")
    return LabelledVoxels(layer, found.points_m, found.labels, found.scores)
