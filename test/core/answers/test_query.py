"""Text queries: known answers, ranking rules and refusals. Random maps are compared in test_semantic_map.py."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from reference.agreement import KnownTexts, apply_to_both, assert_same_answer, engine_of, reference_of
from reference.steps import Setting, embeddings_of, random_steps
from reference.variants import BACKEND_IDS, BACKENDS

from fus3dmaps_core.answers.query import TextQuery, answer_query
from fus3dmaps_core.config.schema import MapConfig
from fus3dmaps_core.errors import QueryError
from fus3dmaps_core.voxel_map.layers.similarity import LAYERS
from fus3dmaps_core.voxel_map.semantic_map import SemanticMap

SIZE_M = 0.5
X, Y, Z = np.eye(3)
TEXTS = KnownTexts({"x": X, "y": Y, "z": Z, "xy": X + Y, "other x": X})


def a_map() -> SemanticMap:
    return SemanticMap(3, MapConfig(voxel_size_m=SIZE_M), 1.0)


def points(numbers) -> np.ndarray:
    return np.array([[(number + 0.5) * SIZE_M, 0.1, 0.1] for number in numbers]).reshape(-1, 3)


def propose(semantic_map: SemanticMap, numbers, embedding) -> int:
    return int(semantic_map.integrate_proposals(points(numbers), np.zeros(len(numbers), int), np.array([embedding]))[0])


def see(semantic_map: SemanticMap, numbers, embedding) -> None:
    count = len(numbers)
    semantic_map.integrate_dense(
        points(numbers), np.zeros(count, int), np.array([embedding]), np.ones(1), np.zeros((count, 3), np.uint8)
    )


def ask(semantic_map: SemanticMap, *prompts: str, logit_scale: float = 10.0, **fields):
    return answer_query(semantic_map, TEXTS, TextQuery(list(prompts), **fields), logit_scale)


def three_objects() -> SemanticMap:
    semantic_map = a_map()
    propose(semantic_map, range(5), X)
    propose(semantic_map, range(10, 15), X + Y)
    propose(semantic_map, range(20, 25), Y)
    return semantic_map


def test_instances_are_ranked_by_cosine_best_first():
    answer = ask(three_objects(), "x", layer="instances")
    assert [line.id for line in answer.instances] == [0, 1, 2]
    np.testing.assert_allclose([line.score for line in answer.instances], [1, math.sqrt(0.5), 0], atol=1e-6)
    assert [line.prompt for line in answer.instances] == ["x"] * 3
    assert [line.voxels for line in answer.instances] == [5] * 3
    assert [line.weight for line in answer.instances] == [5] * 3
    assert answer.points_m.shape == (15, 3)
    assert answer.points_m.dtype == answer.similarity.dtype == np.float32


def test_an_instance_is_where_its_voxels_are():
    semantic_map = a_map()
    # Counts of 3 and 1: the centroid is nearer to the voxel seen more often, the box holds both voxels whole.
    propose(semantic_map, [-1, -1, -1, 1], X)
    (line,) = ask(semantic_map, "x", min_voxels=1).instances
    np.testing.assert_allclose(line.centroid_m, [(3 * -0.25 + 0.75) / 4, 0.25, 0.25], atol=1e-6)
    np.testing.assert_allclose(line.box_min_m, [-0.5, 0, 0], atol=1e-6)
    np.testing.assert_allclose(line.box_max_m, [1.0, 0.5, 0.5], atol=1e-6)


def test_equal_scores_are_ordered_by_id_then_prompt():
    semantic_map = a_map()
    for number in (0, 10, 20):
        propose(semantic_map, range(number, number + 5), X)
    assert [line.id for line in ask(semantic_map, "x", layer="instances").instances] == [0, 1, 2]
    both = ask(semantic_map, "x", "other x", layer="instances", top_k=2).instances
    assert [(line.id, line.prompt) for line in both] == [(0, "x"), (0, "other x"), (1, "x"), (1, "other x")]


def test_every_prompt_has_its_own_best_and_they_are_merged():
    answer = ask(three_objects(), "x", "y", layer="instances", top_k=1)
    assert [(line.id, line.prompt) for line in answer.instances] == [(0, "x"), (2, "y")]
    answer = ask(three_objects(), "z", "x", layer="instances", top_k=1)
    assert [line.prompt for line in answer.instances] == ["x", "z"]
    # A voxel shows the best of the prompts.
    answer = ask(three_objects(), "x", "y", layer="instances")
    np.testing.assert_allclose(answer.similarity[:5], 1.0, atol=1e-6)
    np.testing.assert_allclose(sorted(answer.similarity)[:5], math.sqrt(0.5), atol=1e-6)


@pytest.mark.parametrize("top_k", [1, 2, 3, 50])
def test_top_k_bounds_the_ranking(top_k: int):
    assert [line.id for line in ask(three_objects(), "x", top_k=top_k).instances] == [0, 1, 2][:top_k]


def test_instances_of_few_voxels_are_not_ranked_but_their_voxels_are_shown():
    semantic_map = three_objects()
    propose(semantic_map, [50, 51, 52], X)
    assert [line.id for line in ask(semantic_map, "x").instances] == [0, 1, 2]
    assert [line.id for line in ask(semantic_map, "x", min_voxels=3).instances] == [0, 3, 1, 2]
    assert len(ask(semantic_map, "x").points_m) == 18


def test_voxels_under_another_hypothesis_do_not_count_as_an_instances_own():
    semantic_map = a_map()
    propose(semantic_map, range(5), X)
    propose(semantic_map, [each for each in range(1, 30) for _ in range(2)], Y)
    assert [line.id for line in ask(semantic_map, "x", layer="instances").instances] == [1]
    assert [line.id for line in ask(semantic_map, "x", layer="instances", min_voxels=1).instances] == [0, 1]


def test_negative_prompts_make_a_probability_against_the_strongest_of_them():
    answer = ask(three_objects(), "x", negative_prompts=["y", "z"], layer="instances", logit_scale=3.0)
    scores = {line.id: line.score for line in answer.instances}
    half = math.sqrt(0.5)

    def against(positive: float, *negatives: float) -> float:
        return min(math.exp(3 * positive) / (math.exp(3 * positive) + math.exp(3 * negative)) for negative in negatives)

    assert scores == pytest.approx({0: against(1, 0, 0), 1: against(half, half, 0), 2: against(0, 1, 0)}, abs=1e-6)


def test_a_large_logit_scale_does_not_overflow():
    answer = ask(three_objects(), "x", negative_prompts=["y"], layer="instances", logit_scale=1e4)
    assert np.isfinite(answer.similarity).all()
    assert [round(line.score, 6) for line in answer.instances] == [1.0, 0.5, 0.0]


def test_a_threshold_leaves_out_instances_and_voxels():
    answer = ask(three_objects(), "x", layer="instances", threshold=0.5)
    assert [line.id for line in answer.instances] == [0, 1]
    assert len(answer.points_m) == len(answer.similarity) == 10
    answer = ask(three_objects(), "x", layer="instances", threshold=1.5)
    assert answer.instances == []
    assert answer.points_m.shape == (0, 3)


def test_without_a_threshold_opposites_are_shown_too():
    semantic_map = a_map()
    propose(semantic_map, range(5), -X)
    answer = ask(semantic_map, "x", layer="instances")
    np.testing.assert_allclose(answer.similarity, -1, atol=1e-6)
    assert answer.instances[0].score == pytest.approx(-1)


def test_a_score_is_the_mean_over_the_voxels_that_have_the_layer():
    semantic_map = a_map()
    propose(semantic_map, range(5), Z)
    see(semantic_map, [0], X)
    see(semantic_map, [1], Y)
    (line,) = ask(semantic_map, "x", layer="dense").instances
    assert line.score == pytest.approx(0.5, abs=1e-6)  # One dense voxel is x, one is not, three are unknown.
    assert line.voxels == 5
    assert len(ask(semantic_map, "x", layer="dense").points_m) == 2
    (line,) = ask(semantic_map, "x", layer="fused_dense").instances
    assert line.score == pytest.approx(math.sqrt(0.5) / 5, abs=1e-6)


def test_an_instance_without_a_voxel_of_the_layer_is_not_ranked():
    semantic_map = three_objects()
    see(semantic_map, [0, 40], X)
    assert [line.id for line in ask(semantic_map, "x", layer="dense").instances] == [0]


def test_scores_come_before_the_threshold_takes_voxels_away():
    semantic_map = a_map()
    propose(semantic_map, range(4), Z)
    see(semantic_map, [0, 1], X)
    see(semantic_map, [2, 3], Y)
    assert ask(semantic_map, "x", layer="dense", threshold=0.6).instances == []
    (line,) = ask(semantic_map, "x", layer="dense", threshold=0.4).instances
    assert line.score == pytest.approx(0.5, abs=1e-6)


def test_the_length_of_an_embedding_does_not_matter():
    semantic_map = a_map()
    see(semantic_map, [0], X)
    see(semantic_map, [0], Y)  # A mean of length 0.71.
    np.testing.assert_allclose(ask(semantic_map, "xy", layer="dense").similarity, [1.0], atol=1e-6)


def test_an_embedding_that_cancelled_out_is_like_nothing():
    semantic_map = a_map()
    see(semantic_map, [0], X)
    see(semantic_map, [0], -X)
    np.testing.assert_array_equal(ask(semantic_map, "x", layer="dense").similarity, [0.0])


@pytest.mark.parametrize(("backend", "device"), BACKENDS, ids=BACKEND_IDS)
@pytest.mark.parametrize("window_radius_m", [0.0, 0.16])
@settings(max_examples=8)
@given(st.integers(0, 2**32 - 1), st.integers(5, 25))
def test_a_query_does_not_change_the_map_and_agrees_with_the_reference(
    window_radius_m: float, backend: str, device: str, seed: int, count: int
):
    setting = Setting(window_radius_m=window_radius_m, backend=backend, device=device)
    engine, reference = engine_of(setting), reference_of(setting)
    for step in random_steps(setting, extent=2, count=count, seed=seed):
        apply_to_both(step, engine, reference)
    before = engine.export_state()
    texts = KnownTexts(dict(zip(["a", "b", "c"], embeddings_of(3, 5, np.random.default_rng(seed)), strict=True)))
    for layer in LAYERS:
        query = TextQuery(["a", "b"], negative_prompts=["c"], layer=layer, top_k=3, min_voxels=2)
        assert_same_answer(engine, reference, setting, query, texts, 20.0)
    after = engine.export_state()
    assert all(before[name].tobytes() == after[name].tobytes() for name in before)


@pytest.mark.parametrize(
    "fields",
    [
        {"prompts": []},
        {"prompts": [""]},
        {"prompts": ["x", "   "]},
        {"negative_prompts": [""]},
        {"layer": "panoptic"},
        {"layer": ""},
        {"top_k": 0},
        {"top_k": -1},
        {"threshold": float("nan")},
    ],
    ids=str,
)
def test_a_malformed_query_is_refused_by_name(fields: dict[str, object]):
    with pytest.raises(QueryError, match=next(iter(fields)).rstrip("s")):
        answer_query(three_objects(), TEXTS, TextQuery(**{"prompts": ["x"], **fields}), 10.0)


@pytest.mark.parametrize("layer", LAYERS)
def test_an_empty_map_is_refused(layer: str):
    with pytest.raises(QueryError):
        ask(a_map(), "x", layer=layer)


def test_an_empty_layer_is_refused():
    semantic_map = a_map()
    see(semantic_map, [0], X)
    assert len(ask(semantic_map, "x", layer="fused_dense").points_m) == 1
    for layer in ("instances", "fused_instances"):
        with pytest.raises(QueryError):
            ask(semantic_map, "x", layer=layer)
