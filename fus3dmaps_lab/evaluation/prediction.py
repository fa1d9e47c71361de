"""Prediction of classes from similarities: the class of each voxel, and its probability.

The published protocol takes softmax probabilities over the cosines with all class texts and drops classes that are nowhere
likely. It works in chunks of 10,000 voxels, so its predictions depend on the order of voxels. The rule ``chunked`` does the
same, for comparison. Our rule, ``global``, looks at the whole layer at once and does not depend on the order.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from fus3dmaps_core.errors import MapError
from fus3dmaps_core.voxel_map.layer_query import LayerQuery
from fus3dmaps_core.voxel_map.semantic_map import SemanticMap

Rule = Literal["global", "chunked"]
"""Where a class must be likely at some voxel to be predicted at all: in the whole layer, or in each chunk of it."""

_BLOCK_ROWS = 2**14


def layer_cosines(
    semantic_map: SemanticMap, layer: str, text_vectors: NDArray[np.floating]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Compute the cosine of every voxel of a layer with every text. The dense layer of a map with a window is the window.

    The map is asked for one text at a time, so that only the result grows with the number of texts.

    Args:
        semantic_map: The map, which must not change meanwhile.
        layer: One of LAYERS.
        text_vectors: (c, d) embeddings, any length but 0.

    Returns:
        (n, 3) centres of the layer's voxels, metres, map frame; and (n, c) cosines.

    Raises:
        QueryError: The layer is unknown.
        MapError: The texts have the wrong shape, or the map was changed meanwhile.
    """
    columns: NDArray[np.float32] | None = None
    centers_m = np.empty((0, 3), np.float32)
    for number, text in enumerate(text_vectors):
        found = semantic_map.search(LayerQuery(layer, text[None], top_k=1))
        if columns is None:
            centers_m = found.points_m
            columns = np.empty((len(text_vectors), len(centers_m)), np.float32)
        elif not np.array_equal(centers_m, found.points_m):
            raise MapError(f"layer '{layer}' was changed while it was evaluated")
        columns[number] = found.similarity
    if columns is None:
        raise MapError("text_vectors: at least one text is needed")
    return centers_m, columns.T


def predict_classes(
    cosines: NDArray[np.floating],
    logit_scale: float = 100.0,
    min_probability: float = 0.1,
    rule: Rule = "global",
    chunk: int = 10_000,
    min_peak: float = 0.5,
) -> NDArray[np.int32]:
    """Predict the class of each voxel: the likeliest kept one, with p = softmax over all classes of ``logit_scale`` cos.

    A class is kept if its p reaches ``min_peak`` at any voxel of the layer or, by the rule ``chunked``, of the chunk.
    Dropping a class does not change the p of the others. Ties go to the lowest class.

    Args:
        cosines: (n, c), one column per class.
        logit_scale: Factor of the cosines.
        min_probability: Least probability of a voxel's best class; otherwise the voxel gets none.
        rule: Where a class must reach ``min_peak``.
        chunk: Number of voxels (rows) in a chunk, for ``chunked``.
        min_peak: See above; 0 keeps all.

    Returns:
        (n,) int32 in 1 .. c, 0 for none.
    """
    predicted = np.zeros(len(cosines), np.int32)
    if not cosines.size:
        return predicted
    step = chunk if rule == "chunked" else len(cosines)
    for first in range(0, len(cosines), step):
        part, target = cosines[first : first + step], predicted[first : first + step]
        peaks = np.max([block.max(axis=0) for _, block in _probabilities(part, logit_scale)], axis=0)
        dropped = np.flatnonzero(peaks < min_peak)
        for rows, block in _probabilities(part, logit_scale):
            block[:, dropped] = -np.inf
            best = block.argmax(axis=1)
            sure = block[np.arange(len(block)), best] >= min_probability
            target[rows] = np.where(sure, best + 1, 0)
    return predicted


def top_classes(cosines: NDArray[np.floating], logit_scale: float = 100.0) -> tuple[NDArray[np.int32], NDArray[np.float64]]:
    """Return the likeliest of all classes for each voxel and its probability, from which calibration is computed.

    Args:
        cosines: (n, c), one column per class.
        logit_scale: Factor of the cosines in the softmax.

    Returns:
        (n,) int32 in 1 .. c, 0 if there is no class at all; and (n,) float64 in [0, 1].
    """
    classes, probabilities = np.zeros(len(cosines), np.int32), np.zeros(len(cosines))
    if not cosines.size:
        return classes, probabilities
    for rows, block in _probabilities(cosines, logit_scale):
        best = block.argmax(axis=1)
        classes[rows], probabilities[rows] = best + 1, block[np.arange(len(block)), best]
    return classes, probabilities


def _probabilities(cosines: NDArray[np.floating], logit_scale: float) -> Iterator[tuple[slice, NDArray[np.float64]]]:
    """Yield the softmax of each row, block by block."""
    for first in range(0, len(cosines), _BLOCK_ROWS):
        rows = slice(first, first + _BLOCK_ROWS)
        logits = np.array(cosines[rows], np.float64, order="C")
        logits *= logit_scale
        logits -= logits.max(axis=1, keepdims=True)
        np.exp(logits, out=logits)
        logits /= logits.sum(axis=1, keepdims=True)
        yield rows, logits
