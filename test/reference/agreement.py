"""Where the package's map and the reference meet: build both, compare everything they hold and answer."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from fus3dmaps_core.answers.query import TextQuery, answer_query
from fus3dmaps_core.config.schema import MapConfig
from fus3dmaps_core.errors import QueryError
from fus3dmaps_core.voxel_map.semantic_map import SemanticMap
from reference.objects import box_m, centroid_m, occupied_voxels
from reference.queries import layer_embeddings, ranking, similarity_of_voxels
from reference.semantic_map import Fusion, ReferenceMap
from reference.steps import DropStep, Setting, Step
from reference.vectors import Key, center_of, voxel_of

FLOAT32_TOLERANCE = 2e-5
ROUNDING = {
    "float32": 0.0,
    # Components are below one, where halves are at most 2^-11 apart, and a stored one is rounded up or down.
    "float16": 2.0**-11,
    # A step is 1/112 of the largest component that a mean had when it got its scale, which rounding may have made longer.
    "int8": 1.01 / 112,
}
"""How far one write can move a component."""


def engine_of(setting: Setting) -> SemanticMap:
    """The package's map."""
    config = MapConfig(
        voxel_size_m=setting.voxel_size_m,
        max_hypotheses=setting.max_hypotheses,
        iou_threshold=setting.iou_threshold,
        dtype=setting.dtype,
        backend=setting.backend,
        device=setting.device,
        association=setting.association,
        merge_overlap=setting.merge_overlap,
        merge_cosine=setting.merge_cosine,
    )
    return SemanticMap(
        setting.dimension, config, setting.variance_ratio, setting.window_radius_m, setting.keep_most_evidence
    )


def reference_of(setting: Setting) -> ReferenceMap:
    """The reference's map."""
    return ReferenceMap(
        setting.voxel_size_m,
        setting.max_hypotheses,
        setting.iou_threshold,
        setting.variance_ratio,
        setting.window_radius_m,
        setting.keep_most_evidence,
        setting.association,
        setting.merge_overlap,
        setting.merge_cosine,
    )


def apply_to_both(step: Step, engine: SemanticMap, reference: ReferenceMap) -> None:
    """Take one step with both; what they return must be the same (ids, dropped and removed voxels, fused instances)."""
    if isinstance(step, DropStep):
        reference.slot_order = keys_of(engine.export_state()["voxel_coordinates"])
    expected, got = step.apply(reference), step.apply(engine)
    if isinstance(expected, list):
        assert got.dtype == np.int64
        assert got.tolist() == expected
    elif isinstance(expected, Fusion):
        assert (got.instances, got.voxels) == (len(reference.instances), len(reference.voxels))
        assert got.updated == expected.updated
        assert expected.recomputed in (None, got.recomputed)
    else:
        assert got == expected


def tolerance_of(setting: Setting, reference: ReferenceMap) -> float:
    """How far a component of an embedding may be off: each write to low precision adds at most one rounding."""
    return FLOAT32_TOLERANCE + ROUNDING[setting.dtype] * max(reference.most_dense_roundings, 1.0)


def keys_of(coordinates: np.ndarray) -> list[Key]:
    """Voxel coordinates (n, 3) as dictionary keys."""
    return [tuple(row) for row in coordinates.tolist()]


def dense_embeddings(state: dict[str, np.ndarray]) -> np.ndarray:
    """Dense means of an exported state of any storage type: (m, d) float64."""
    stored = state["dense_embedding"].astype(np.float64)
    return stored * state["dense_scale"][:, None] if "dense_scale" in state else stored


def assert_close(got: np.ndarray, expected: Sequence[Any], rtol: float = 0.0, atol: float = 0.0) -> None:
    """Rows of an array against plain values, NaN equal to NaN."""
    assert len(got) == len(expected)
    if len(expected):
        np.testing.assert_allclose(got.astype(np.float64), np.array(expected, dtype=np.float64), rtol=rtol, atol=atol)


def assert_same_map(engine: SemanticMap, reference: ReferenceMap, setting: Setting) -> None:
    """Compare the whole content of both maps."""
    state = engine.export_state()
    tolerance = tolerance_of(setting, reference)
    keys = keys_of(state["voxel_coordinates"])
    _assert_same_voxels(state, keys, reference)
    _assert_same_dense_layer(state, keys, reference, tolerance)
    _assert_same_instance_layer(state, keys, reference, tolerance)
    _assert_same_snapshots(engine, keys, reference)


def _assert_same_voxels(state: dict[str, np.ndarray], keys: list[Key], reference: ReferenceMap) -> None:
    assert len(set(keys)) == len(keys)
    assert set(keys) == reference.voxels
    unseen = np.full(3, 128.0)
    assert_close(state["voxel_colors"], [reference.color.get(key, unseen) for key in keys], atol=0.5)


def _assert_same_dense_layer(
    state: dict[str, np.ndarray], keys: list[Key], reference: ReferenceMap, tolerance: float
) -> None:
    dense_keys = [keys[slot] for slot in state["dense_slot"]]
    assert len(set(dense_keys)) == len(dense_keys)
    assert set(dense_keys) == set(reference.dense_weight)
    assert_close(state["dense_weight"], [reference.dense_weight[key] for key in dense_keys], rtol=1e-6)
    assert_close(dense_embeddings(state), [reference.dense_mean[key] for key in dense_keys], atol=tolerance)


def _assert_same_instance_layer(
    state: dict[str, np.ndarray], keys: list[Key], reference: ReferenceMap, tolerance: float
) -> None:
    for key, ids, counts in zip(keys, state["hypothesis_id"].tolist(), state["hypothesis_count"].tolist(), strict=True):
        held = {each: count for each, count in zip(ids, counts, strict=True) if each >= 0}
        assert len(held) == sum(each >= 0 for each in ids)
        assert held == reference.hypotheses.get(key, {})
    ids = state["instance_id"].tolist()
    assert ids == sorted(reference.instances)
    assert int(state["next_instance_id"]) == reference.next_id
    instances = [reference.instances[each] for each in ids]
    assert state["instance_weight"].tolist() == [instance.weight for instance in instances]
    assert_close(state["instance_embedding"], [instance.embedding for instance in instances], atol=FLOAT32_TOLERANCE)
    assert_close(state["fused_evidence"], [instance.evidence for instance in instances], rtol=1e-6)
    fused = [row for row, instance in enumerate(instances) if instance.fused_embedding is not None]
    assert_close(state["fused_embedding"][fused], [instances[row].fused_embedding for row in fused], atol=tolerance)


def _assert_same_snapshots(engine: SemanticMap, keys: list[Key], reference: ReferenceMap) -> None:
    assert engine.voxel_count == len(reference.voxels)
    assert engine.dense_voxel_count == len(reference.dense_weight)
    assert engine.instance_count == len(reference.instances)

    voxels = engine.voxels()
    assert [voxel_of(center, reference.voxel_size_m) for center in voxels.centers_m] == keys
    assert_close(voxels.centers_m, [center_of(key, reference.voxel_size_m) for key in keys], rtol=1e-6)
    tops = [reference.top_of(key) for key in keys]
    assert voxels.top_instance.tolist() == [-1 if top is None else top for top in tops]
    assert voxels.top_count.tolist() == [
        0 if top is None else reference.hypotheses[key][top] for key, top in zip(keys, tops, strict=True)
    ]
    assert_close(voxels.dense_weight, [reference.dense_weight.get(key, 0.0) for key in keys], rtol=1e-6)

    instances = engine.instances()
    assert instances.ids.tolist() == sorted(reference.instances)
    ids = instances.ids.tolist()
    assert instances.weights.tolist() == [reference.instances[each].weight for each in ids]
    assert instances.hypothesis_voxels.tolist() == [len(reference.voxels_of(each)) for each in ids]
    assert instances.voxel_counts.tolist() == [len(occupied_voxels(reference, each)) for each in ids]
    nowhere = np.full(3, np.nan)
    centroids = [centroid_m(reference, each) for each in ids]
    boxes = [box_m(reference, each) or (nowhere, nowhere) for each in ids]
    assert_close(instances.centroids_m, [nowhere if each is None else each for each in centroids], rtol=1e-5, atol=1e-6)
    assert_close(instances.boxes_min_m, [low for low, _ in boxes], rtol=1e-5, atol=1e-6)
    assert_close(instances.boxes_max_m, [high for _, high in boxes], rtol=1e-5, atol=1e-6)


def assert_same_bytes(first: dict[str, np.ndarray], second: dict[str, np.ndarray]) -> None:
    """Compare two exported states bit for bit."""
    assert first.keys() == second.keys()
    for name, array in first.items():
        assert array.dtype == second[name].dtype, name
        assert array.shape == second[name].shape, name
        assert array.tobytes() == second[name].tobytes(), name


class KnownTexts:
    """A text encoder whose prompts are names of given vectors."""

    space = "known"

    def __init__(self, vectors: dict[str, np.ndarray]) -> None:
        self.vectors = vectors

    def encode_text(self, prompts: Sequence[str]) -> np.ndarray:
        rows = np.array([self.vectors[prompt] for prompt in prompts], dtype=np.float32)
        return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def assert_same_answer(
    engine: SemanticMap, reference: ReferenceMap, setting: Setting, query: TextQuery, texts: KnownTexts, logit_scale: float
) -> None:
    """Ask both and compare every voxel's score and the ranking.

    Instances whose scores differ by less than rounding may change places, so the ranking is checked by what it promises:
    right scores, best first, none left out that beats one that is in.
    """
    prompts = [texts.vectors[prompt] for prompt in query.prompts]
    negatives = [texts.vectors[prompt] for prompt in query.negative_prompts]
    if not layer_embeddings(reference, query.layer):
        with pytest.raises(QueryError):
            answer_query(engine, texts, query, logit_scale)
        return
    cosine_tolerance = 4 * np.sqrt(setting.dimension) * tolerance_of(setting, reference)
    tolerance = cosine_tolerance * (max(1.0, logit_scale / 2) if negatives else 1.0)

    answer = answer_query(engine, texts, query, logit_scale)
    assert answer.layer == query.layer

    expected = similarity_of_voxels(reference, query.layer, prompts, negatives, logit_scale)
    threshold = -np.inf if query.threshold is None else query.threshold
    got = {
        voxel_of(point, setting.voxel_size_m): float(value)
        for point, value in zip(answer.points_m, answer.similarity, strict=True)
    }
    assert len(got) == len(answer.points_m)
    for key, value in expected.items():
        if key in got:
            assert got[key] == pytest.approx(value, abs=tolerance)
            assert got[key] >= threshold
        else:
            assert value < threshold + tolerance
    assert set(got) <= set(expected)

    listed = [(-line.score, line.id, query.prompts.index(line.prompt)) for line in answer.instances]
    assert listed == sorted(listed)
    for number, prompt in enumerate(query.prompts):
        lines = ranking(reference, query.layer, prompts, negatives, logit_scale, query.min_voxels, -np.inf)
        scores = {line.instance_id: line.score for line in lines if line.prompt == number}
        given = {line.id: line for line in answer.instances if line.prompt == prompt}
        assert len(given) == sum(line.prompt == prompt for line in answer.instances)
        for instance_id, line in given.items():
            assert line.score == pytest.approx(scores[instance_id], abs=tolerance)
            assert line.score >= threshold
            assert line.weight == reference.instances[instance_id].weight
            assert line.voxels == len(occupied_voxels(reference, instance_id))
            np.testing.assert_allclose(line.centroid_m, centroid_m(reference, instance_id), rtol=1e-5, atol=1e-6)
            box = box_m(reference, instance_id)
            assert box is not None
            np.testing.assert_allclose(line.box_min_m, box[0], rtol=1e-5, atol=1e-6)
            np.testing.assert_allclose(line.box_max_m, box[1], rtol=1e-5, atol=1e-6)
        left_out = [score for instance_id, score in scores.items() if instance_id not in given]
        if len(given) == query.top_k:
            assert all(score <= min(line.score for line in given.values()) + tolerance for score in left_out)
        else:
            assert len(given) < query.top_k
            assert all(score < threshold + tolerance for score in left_out)
