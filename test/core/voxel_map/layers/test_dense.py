"""The dense layer, through the map: running means that do not care how observations arrive."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from reference.agreement import ROUNDING, dense_embeddings
from reference.steps import DenseStep, Setting, dense_step
from reference.variants import BACKEND_IDS, BACKENDS

from fus3dmaps_core.config.schema import MapConfig
from fus3dmaps_core.voxel_map.semantic_map import SemanticMap

VOXEL = np.array([0.02, 0.02, 0.02])
GREY = np.full(3, 90, np.uint8)


@pytest.fixture(scope="module", params=BACKENDS, ids=BACKEND_IDS)
def a_map(request) -> Callable[..., SemanticMap]:
    """Makes a map on each of the backends."""
    backend, device = request.param

    def make(dimension: int = 3, dtype: str = "float32", radius_m: float = 0.0) -> SemanticMap:
        return SemanticMap(dimension, MapConfig(dtype=dtype, backend=backend, device=device), 1.0, radius_m)

    return make


def observe(semantic_map: SemanticMap, embeddings, weights, patches=None, points_m=None) -> None:
    """One point per embedding in one voxel, unless told otherwise."""
    patches = np.arange(len(embeddings)) if patches is None else np.asarray(patches)
    points_m = np.tile(VOXEL, (len(patches), 1)) if points_m is None else np.asarray(points_m)
    semantic_map.integrate_dense(
        points_m, patches, np.asarray(embeddings, float), np.asarray(weights, float), np.tile(GREY, (len(patches), 1))
    )


def dense_of(semantic_map: SemanticMap) -> dict[tuple[int, ...], tuple[float, np.ndarray]]:
    state = semantic_map.export_state()
    rows = zip(state["dense_slot"], state["dense_weight"], dense_embeddings(state), strict=True)
    return {tuple(state["voxel_coordinates"][slot].tolist()): (float(w), f) for slot, w, f in rows}


def test_the_mean_is_weighted_and_not_renormalised(a_map):
    semantic_map = a_map()
    observe(semantic_map, [[1, 0, 0]], [1.0])
    observe(semantic_map, [[0, 1, 0], [0, 0, 1]], [0.5, 0.25], patches=[0, 0, 1, 1])
    weight, mean = dense_of(semantic_map)[0, 0, 0]
    # 1 of x, twice 0.5 of y, twice 0.25 of z.
    assert weight == 2.5
    np.testing.assert_allclose(mean, [1 / 2.5, 1 / 2.5, 0.5 / 2.5], atol=1e-7)
    assert np.linalg.norm(mean) < 0.9


def test_observations_are_normalised_before_they_are_averaged(a_map):
    semantic_map = a_map()
    observe(semantic_map, [[3e4, 0, 0], [0, 1e-4, 0]], [1.0, 1.0])
    np.testing.assert_allclose(dense_of(semantic_map)[0, 0, 0][1], [0.5, 0.5, 0], atol=1e-6)


def test_a_patch_of_weight_zero_shows_a_voxel_but_says_nothing_of_it(a_map):
    semantic_map = a_map()
    observe(semantic_map, [[1, 0, 0]], [0.0])
    assert (semantic_map.voxel_count, semantic_map.dense_voxel_count) == (1, 0)
    assert semantic_map.voxels().colors.tolist() == [GREY.tolist()]
    observe(semantic_map, [[1, 0, 0], [0, 1, 0]], [0.0, 0.5])
    weight, mean = dense_of(semantic_map)[0, 0, 0]
    assert weight == 0.5
    np.testing.assert_allclose(mean, [0, 1, 0], atol=1e-7)


def test_a_voxel_shows_the_mean_colour_of_the_newest_frame_that_hit_it(a_map):
    semantic_map = a_map()
    for colors in ([[10, 20, 30]], [[0, 100, 200], [100, 200, 0]]):
        semantic_map.integrate_dense(
            np.tile(VOXEL, (len(colors), 1)),
            np.zeros(len(colors), int),
            np.ones((1, 3)),
            np.ones(1),
            np.array(colors, np.uint8),
        )
    assert semantic_map.voxels().colors.tolist() == [[50, 150, 100]]


def test_a_voxel_that_left_the_window_starts_anew_and_its_storage_is_reused(a_map):
    semantic_map = a_map(radius_m=0.5)
    observe(semantic_map, [[1, 0, 0]], [1.0])
    allocated: set[int] = set()
    for number in range(50):
        assert semantic_map.prune_window(np.array([5.0, 0.0, 0.0])) == 1
        assert dense_of(semantic_map) == {}
        observe(semantic_map, np.roll([[0, 1, 0]], number), [0.5])
        allocated.add(sum(semantic_map.nbytes().values()))
    weight, mean = dense_of(semantic_map)[0, 0, 0]
    assert weight == 0.5
    np.testing.assert_allclose(mean, np.roll([0, 1, 0], 49), atol=1e-7)
    assert len(allocated) == 1


def random_frame(seed: int, count: int, weightless: bool = True) -> DenseStep:
    rng = np.random.default_rng(seed)
    keys = [tuple(key) for key in rng.integers(-2, 2, (count, 3)).tolist()]
    return dense_step(keys, Setting(dimension=4), rng, weightless)


def assert_same_dense(first: SemanticMap, second: SemanticMap, atol: float) -> None:
    a, b = dense_of(first), dense_of(second)
    assert a.keys() == b.keys()
    for key, (weight, mean) in a.items():
        assert b[key][0] == pytest.approx(weight, rel=1e-6)
        np.testing.assert_allclose(b[key][1], mean, atol=atol)
    np.testing.assert_array_equal(sorted(a), sorted(b))


@settings(max_examples=25)
@given(st.integers(0, 2**32 - 1), st.integers(1, 60), st.lists(st.integers(0, 60), max_size=6))
def test_it_is_the_same_whether_points_arrive_in_one_frame_or_in_many(a_map, seed: int, count: int, cuts: list[int]):
    frame = random_frame(seed, count)
    whole, parts = a_map(4), a_map(4)
    frame.apply(whole)
    edges = sorted({0, count, *(min(cut, count) for cut in cuts)})
    for low, high in itertools.pairwise(edges):
        part = slice(low, high)
        DenseStep(frame.points_m[part], frame.patches[part], frame.embeddings, frame.weights, frame.colors[part]).apply(
            parts
        )
    assert_same_dense(whole, parts, atol=1e-5)


@settings(max_examples=25)
@given(st.integers(0, 2**32 - 1), st.integers(1, 60))
def test_the_order_of_points_and_patches_does_not_matter(a_map, seed: int, count: int):
    frame = random_frame(seed, count)
    rng = np.random.default_rng(seed + 1)
    points, patches = rng.permutation(count), rng.permutation(len(frame.weights))
    new_number = np.argsort(patches)
    shuffled = DenseStep(
        frame.points_m[points],
        new_number[frame.patches[points]],
        frame.embeddings[patches],
        frame.weights[patches],
        frame.colors[points],
    )
    straight, mixed = a_map(4), a_map(4)
    frame.apply(straight)
    shuffled.apply(mixed)
    assert_same_dense(straight, mixed, atol=1e-5)


def test_a_mean_of_many_frames_stays_exact(a_map):
    """Tens of thousands of observations of one voxel: no drift away from the mean of all of them."""
    rng = np.random.default_rng(3)
    semantic_map = a_map(4)
    total, weight = np.zeros(4), 0
    for _ in range(300):
        embedding = rng.normal(size=4) + 0.8
        embedding /= np.linalg.norm(embedding)
        observe(semantic_map, [embedding], [1.0], patches=np.zeros(200, int))
        total, weight = total + 200 * embedding, weight + 200
    got_weight, mean = dense_of(semantic_map)[0, 0, 0]
    assert got_weight == weight
    np.testing.assert_allclose(mean, total / weight, atol=2e-5)


@pytest.mark.parametrize(("dtype", "stored"), [("float16", np.float16), ("int8", np.int8)])
def test_low_precision_is_stored_as_such_and_stays_within_its_rounding(a_map, dtype: str, stored: type):
    exact, low = a_map(4), a_map(4, dtype)
    for seed in range(12):
        for semantic_map in (exact, low):
            random_frame(seed, 150, weightless=False).apply(semantic_map)
    assert low.export_state()["dense_embedding"].dtype == stored
    assert_same_dense(exact, low, atol=12 * ROUNDING[dtype])
