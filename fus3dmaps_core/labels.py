"""Labels for the whole map: every voxel gets the name that fits it best."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fus3dmaps_core.encoders.protocols import TextEncoder
from fus3dmaps_core.errors import QueryError
from fus3dmaps_core.query import check_layer, check_texts
from fus3dmaps_core.semantic_map import SemanticMap

DEFAULT_LABEL_LAYER = "fused_dense"
_COORDINATE_BITS = 21


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
    """Give every voxel of a layer its label. The map is not changed, and may be changed by others meanwhile.

    The map is asked once for each name, so that its lock is never held for long. Voxels that appear or vanish between
    these are left out: a label is always the best of all names.

    Args:
        semantic_map: The map.
        text_encoder: Encodes the names.
        labels: The names.
        layer: One of LAYERS.

    Raises:
        QueryError: A name is empty or too long, the layer is unknown or empty; the message names the field.
    """
    if not labels:
        raise QueryError("labels: at least one label is needed")
    check_texts("labels", labels)
    check_layer(layer)
    if semantic_map.voxel_count == 0:
        raise QueryError("the map is empty: nothing has been mapped yet")
    best: LabelledVoxels | None = None
    for index, embedding in enumerate(text_encoder.encode_text(labels)):
        found = semantic_map.search(layer, embedding[None], top_k=1)
        here = LabelledVoxels(layer, found.points_m, np.full(len(found.points_m), index, np.int32), found.similarity)
        best = here if best is None else _better(best, here, semantic_map.config.voxel_size_m)
    if best is None or not len(best.points_m):
        raise QueryError(f"layer: '{layer}' is empty in this map")
    return best


def _better(first: LabelledVoxels, second: LabelledVoxels, voxel_size_m: float) -> LabelledVoxels:
    """Of the voxels that both have, the label with the higher score; the first's where they are equal."""
    if not np.array_equal(first.points_m, second.points_m):
        _, in_first, in_second = np.intersect1d(
            _keys(first.points_m, voxel_size_m),
            _keys(second.points_m, voxel_size_m),
            assume_unique=True,
            return_indices=True,
        )
        first, second = _taken(first, in_first), _taken(second, in_second)
    wins = second.scores > first.scores
    return LabelledVoxels(
        first.layer,
        first.points_m,
        np.where(wins, second.labels, first.labels),
        np.where(wins, second.scores, first.scores),
    )


def _taken(voxels: LabelledVoxels, places: NDArray[np.int64]) -> LabelledVoxels:
    return LabelledVoxels(voxels.layer, voxels.points_m[places], voxels.labels[places], voxels.scores[places])


def _keys(points_m: NDArray[np.float32], voxel_size_m: float) -> NDArray[np.int64]:
    """One number per voxel, from its centre."""
    x, y, z = np.floor(points_m.astype(np.float64) / voxel_size_m).astype(np.int64).T & (2**_COORDINATE_BITS - 1)
    return np.asarray(x << 2 * _COORDINATE_BITS | y << _COORDINATE_BITS | z, dtype=np.int64)
