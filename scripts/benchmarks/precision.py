"""What a storage type costs in accuracy: the stored means against float64, and the order in which queries find things."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.boxes import VOXEL_SIZE_M
from benchmarks.embeddings import NOISE, KnownText, unit_vectors
from benchmarks.engine import Run
from benchmarks.measurements import Measurement
from fus3dmaps_core.answers.query import TextQuery, answer_query
from fus3dmaps_core.voxel_map.semantic_map import SemanticMap

VOXELS = 256
OBSERVATIONS_PER_UPDATE = 5
UPDATES = (1, 10, 1000)
_OBJECTS = 64
_DEVIATION = 0.3  # Of a voxel's true direction from that of its object.
_NOISES = 4096
_TEXTS = 64
_TOP = 10


def cosine_error(stored: NDArray[np.floating], exact: NDArray[np.float64]) -> NDArray[np.float64]:
    """Compute 1 - cosine of each row with the exact one, without cancellation: (n,) float64."""
    a, b = (values / np.linalg.norm(values, axis=1, keepdims=True) for values in (stored.astype(np.float64), exact))
    return np.asarray(0.5 * ((a - b) ** 2).sum(axis=1))


def rank_correlation(first: NDArray[np.floating], second: NDArray[np.floating]) -> float:
    """Compute Spearman's correlation of two scores (n,) of the same things; ties are broken by position."""
    ranks = [np.argsort(np.argsort(scores, kind="stable")) for scores in (first, second)]
    return float(np.corrcoef(ranks[0], ranks[1])[0, 1])


def top_overlap(first: NDArray[np.floating], second: NDArray[np.floating], count: int = _TOP) -> float:
    """Compute the share of the best ``count`` of one score (n,) that are among the best of the other."""
    best = [set(np.argsort(-scores, kind="stable")[:count].tolist()) for scores in (first, second)]
    return len(best[0] & best[1]) / count


def measure_precision(
    run: Run, dimension: int, dtypes: Sequence[str], updates: Sequence[int] = UPDATES
) -> list[Measurement]:
    """Measure precision_cosine_error after so many updates, and precision_rank_agreement with float32 after the last.

    Every map gets the same observations: unit vectors that have a cosine of about 0.8 with what their voxel shows.
    """
    run.say(f"precision, d {dimension}: {', '.join(dtypes)}")
    rng = np.random.default_rng([run.world.seed, dimension])
    names = list(dict.fromkeys(["float32", *dtypes]))
    maps = {dtype: run.new_map(dimension, dtype) for dtype in names}
    objects = unit_vectors(_OBJECTS, dimension, rng)[np.arange(VOXELS) % _OBJECTS]
    shown = objects + np.float32(_DEVIATION) * unit_vectors(VOXELS, dimension, rng)
    shown /= np.linalg.norm(shown, axis=1, keepdims=True)
    noises = unit_vectors(_NOISES, dimension, rng) * np.float32(NOISE)
    voxels = np.repeat(np.arange(VOXELS), OBSERVATIONS_PER_UPDATE)
    points_m = np.stack([voxels + 0.5, np.full(len(voxels), 0.5), np.full(len(voxels), 0.5)], axis=1) * VOXEL_SIZE_M
    weights, colors = np.ones(len(voxels), np.float32), np.zeros((len(voxels), 3), np.uint8)
    exact = np.zeros((VOXELS, dimension))
    measured = []
    for update in range(1, max(updates) + 1):
        observations = shown[voxels] + noises[rng.integers(0, _NOISES, len(voxels))]
        unit = observations / np.linalg.norm(observations, axis=1, keepdims=True).astype(np.float32)
        exact += unit.astype(np.float64).reshape(VOXELS, OBSERVATIONS_PER_UPDATE, dimension).sum(axis=1)
        for semantic_map in maps.values():
            semantic_map.integrate_dense(points_m, np.arange(len(voxels)), unit, weights, colors)
        if update in updates:
            for dtype, semantic_map in maps.items():
                errors = cosine_error(_stored(semantic_map), exact)
                params = _params(run, dimension, dtype, updates=update)
                spread = {"min": float(errors.min()), "max": float(errors.max()), "samples": len(errors)}
                measured.append(Measurement("precision_cosine_error", params, float(errors.mean()), "1", spread))
    texts = unit_vectors(_TEXTS, dimension, rng)
    scores = {dtype: [_scores(semantic_map, text) for text in texts] for dtype, semantic_map in maps.items()}
    for dtype in names[1:]:
        pairs = list(zip(scores["float32"], scores[dtype], strict=True))
        for measure, agreement in (("spearman", rank_correlation), (f"top_{_TOP}", top_overlap)):
            value = float(np.mean([agreement(*pair) for pair in pairs]))
            params = _params(run, dimension, dtype, updates=max(updates), measure=measure)
            measured.append(Measurement("precision_rank_agreement", params, value, "1"))
    return measured


def _params(run: Run, dimension: int, dtype: str, **further: Any) -> dict[str, Any]:
    return run.params(VOXELS, dimension, dtype, observations=OBSERVATIONS_PER_UPDATE, **further)


def _scores(semantic_map: SemanticMap, text: NDArray[np.float32]) -> NDArray[np.float32]:
    """Compute the cosine of every voxel with a text, in an order that maps of the same voxels share."""
    answer = answer_query(semantic_map, KnownText(text), TextQuery(["anything"], layer="dense"), 100.0)
    return np.asarray(answer.similarity[np.argsort(answer.points_m[:, 0])])


def _stored(semantic_map: SemanticMap) -> NDArray[np.float64]:
    """Return stored means in the order of their voxels along x, up to the scale of a row, which no cosine depends on."""
    state = semantic_map.export_state()
    order = np.argsort(state["voxel_coordinates"][state["dense_slot"], 0])
    return np.asarray(state["dense_embedding"][order], np.float64)
