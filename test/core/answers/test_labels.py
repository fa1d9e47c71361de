"""Every voxel and instance gets the label that fits it best, also while the map changes."""

from __future__ import annotations

import itertools
import threading

import numpy as np
import pytest
import torch
from elsewhere import elsewhere
from hypothesis import given, settings
from hypothesis import strategies as st
from reference.agreement import KnownTexts, apply_to_both, engine_of, reference_of
from reference.queries import layer_embeddings
from reference.steps import Setting, embeddings_of, random_steps
from reference.variants import BACKEND_IDS, BACKENDS
from reference.vectors import cosine

from fus3dmaps_core.answers.labels import label_voxels
from fus3dmaps_core.config.schema import MapConfig
from fus3dmaps_core.errors import MapError, QueryError
from fus3dmaps_core.voxel_map import map_scan
from fus3dmaps_core.voxel_map.kernels import compiled_kernels
from fus3dmaps_core.voxel_map.layer_query import LayerQuery
from fus3dmaps_core.voxel_map.layers.similarity import LAYERS
from fus3dmaps_core.voxel_map.semantic_map import SemanticMap

SIZE_M, WIDTH = 0.5, 24
X, Y, Z = np.eye(3)
TEXTS = KnownTexts({"x": X, "y": Y, "z": Z, "other x": X})


def points(numbers) -> np.ndarray:
    return np.array([[(number + 0.5) * SIZE_M, 0.1, 0.1] for number in numbers]).reshape(-1, 3)


def see(semantic_map: SemanticMap, numbers, embedding) -> None:
    count = len(numbers)
    semantic_map.integrate_dense(
        points(numbers), np.zeros(count, int), np.array([embedding]), np.ones(1), np.zeros((count, 3), np.uint8)
    )


@pytest.fixture
def semantic_map() -> SemanticMap:
    semantic_map = SemanticMap(3, MapConfig(voxel_size_m=SIZE_M), 1.0)
    see(semantic_map, range(-3, 0), X)
    see(semantic_map, range(5, 7), Y)
    return semantic_map


def numbers_of(labelled) -> dict[int, int]:
    return dict(zip(np.floor(labelled.points_m[:, 0] / SIZE_M).astype(int).tolist(), labelled.labels.tolist(), strict=True))


def test_each_voxel_has_its_best_label_and_score(semantic_map):
    labelled = label_voxels(semantic_map, TEXTS, ["z", "y", "x"])
    assert numbers_of(labelled) == {-3: 2, -2: 2, -1: 2, 5: 1, 6: 1}
    np.testing.assert_allclose(labelled.scores, 1.0, atol=1e-3)
    assert (labelled.labels.dtype, labelled.scores.dtype) == (np.int32, np.float32)


def test_of_equal_labels_the_first_wins(semantic_map):
    assert set(numbers_of(label_voxels(semantic_map, TEXTS, ["other x", "x", "y"])).values()) == {0, 2}


@settings(max_examples=15)
@given(seed=st.integers(0, 2**32 - 1), layer=st.sampled_from(LAYERS), count=st.integers(1, 6))
def test_labels_agree_with_a_plain_map(seed, layer, count):
    setting = Setting()
    engine, reference = engine_of(setting), reference_of(setting)
    for step in random_steps(setting, extent=2, count=8, seed=seed):
        apply_to_both(step, engine, reference)
    expected = layer_embeddings(reference, layer)
    if not expected:
        return
    names = [f"label {index}" for index in range(count)]
    vectors = embeddings_of(count, setting.dimension, np.random.default_rng(seed))
    labelled = label_voxels(engine, KnownTexts(dict(zip(names, vectors, strict=True))), names, layer)
    keys = [tuple(key) for key in np.floor(labelled.points_m / engine.config.voxel_size_m).astype(int).tolist()]
    assert set(keys) == set(expected)
    assert len(keys) == len(expected)
    for key, label, score in zip(keys, labelled.labels.tolist(), labelled.scores.tolist(), strict=True):
        cosines = [cosine(expected[key], list(vector)) for vector in vectors]
        assert score == pytest.approx(max(cosines), abs=1e-5)
        assert cosines[label] == pytest.approx(max(cosines), abs=1e-5)


def test_labels_are_those_of_one_moment(semantic_map):
    """Voxels that come and go together are all there or all gone."""
    crowd, stop = range(100, 1100), threading.Event()

    def change() -> None:
        while not stop.is_set():
            see(semantic_map, crowd, Y)
            semantic_map.remove_voxels(points(crowd))

    changing = threading.Thread(target=change)
    changing.start()
    try:
        for _ in range(20):
            found = numbers_of(label_voxels(semantic_map, TEXTS, ["x", "y"]))
            assert len(found) in (5, 5 + len(crowd))
            assert [found[number] for number in (-3, -2, -1, 5, 6)] == [0, 0, 0, 1, 1]
    finally:
        stop.set()
        changing.join()


@pytest.fixture(scope="module", params=BACKENDS, ids=BACKEND_IDS)
def mapped(request) -> SemanticMap:
    """Random voxels in both layers, some in one of them only, and instances; fused."""
    backend, device = request.param
    return random_map(backend, device)


def random_map(backend: str, device: str) -> SemanticMap:
    rng = np.random.default_rng(8)
    semantic_map = SemanticMap(WIDTH, MapConfig(voxel_size_m=SIZE_M, backend=backend, device=device), 1.0)
    places_m = (rng.integers(0, 14, (1500, 3)) + 0.5) * SIZE_M
    count, patches = 1200, embeddings_of(40, WIDTH, rng)
    colors = np.zeros((count, 3), np.uint8)
    semantic_map.integrate_dense(places_m[:count], rng.integers(0, 40, count), patches, np.ones(40), colors)
    # Blocks of space, so that instances have many voxels.
    proposals = np.floor(places_m[300:] / (7 * SIZE_M)).astype(int) @ [4, 2, 1]
    semantic_map.integrate_proposals(places_m[300:], proposals, embeddings_of(8, WIDTH, rng))
    semantic_map.fuse()
    return semantic_map


def one_by_one(semantic_map: SemanticMap, layer: str, vectors: np.ndarray) -> np.ndarray:
    """Cosines (p, n) of each text with each voxel, a question for each text."""
    return np.stack([semantic_map.search(LayerQuery(layer, vector[None])).similarity for vector in vectors])


@pytest.mark.parametrize("layer", LAYERS)
@pytest.mark.parametrize("count", [1, 2, 3, 4, 7, 300])
@pytest.mark.parametrize("sum_bytes", [None, 0, 1500])
def test_labels_are_those_of_a_question_for_each_label(mapped, layer, count, sum_bytes, monkeypatch):
    """However many are asked together; scores differ by the order of sums of floats, within 1e-6."""
    vectors = embeddings_of(count, WIDTH, np.random.default_rng(count))
    expected = one_by_one(mapped, layer, vectors)
    if sum_bytes is not None:
        monkeypatch.setattr(map_scan, "_SUM_BYTES", sum_bytes)
    found = mapped.label(layer, vectors)
    np.testing.assert_array_equal(found.points_m, mapped.search(LayerQuery(layer, vectors[:1])).points_m)
    np.testing.assert_allclose(found.scores, expected.max(axis=0), atol=1e-6)
    chosen = np.take_along_axis(expected, found.labels[None].astype(int), axis=0)[0]
    np.testing.assert_allclose(chosen, expected.max(axis=0), atol=2e-6)
    if count > 1:
        second, first = np.sort(expected, axis=0)[-2:]
        clear = first - second > 2e-6
        assert clear.mean() > 0.9
        np.testing.assert_array_equal(found.labels[clear], expected.argmax(axis=0)[clear])


@pytest.mark.parametrize("layer", LAYERS)
def test_a_map_of_ordinary_size_is_looked_at_once(mapped, layer, monkeypatch):
    seen, scan = [], mapped._kernels.scan

    def counted(block, *arguments):
        seen.extend(range(block.first, block.first + len(block.keys)))
        return scan(block, *arguments)

    monkeypatch.setattr(mapped._kernels, "scan", counted)
    mapped.label(layer, embeddings_of(250, WIDTH, np.random.default_rng(1)))
    assert seen == list(range(mapped.voxel_count))


@pytest.mark.parametrize("layer", LAYERS)
@pytest.mark.parametrize("sum_bytes", [None, 0])
def test_an_instance_has_the_label_whose_ranking_it_leads_most(mapped, layer, sum_bytes, monkeypatch):
    vectors = embeddings_of(9, WIDTH, np.random.default_rng(2))
    ranked = mapped.search(LayerQuery(layer, vectors, top_k=1000))
    means = np.full((len(vectors), len(ranked.instances.ids)), np.nan)
    for text, (places, scores) in enumerate(ranked.best):
        means[text, places] = scores
    if sum_bytes is not None:
        monkeypatch.setattr(map_scan, "_SUM_BYTES", sum_bytes)
    found = mapped.label(layer, vectors)
    np.testing.assert_array_equal(found.instances.ids, ranked.instances.ids)
    assert len(found.instances.ids) == 8
    np.testing.assert_array_equal(found.instance_labels, means.argmax(axis=0))
    np.testing.assert_allclose(found.instance_scores, means.max(axis=0), atol=1e-6)


def test_an_instance_without_a_voxel_of_the_layer_has_no_label(mapped):
    semantic_map = SemanticMap(WIDTH, mapped.config, 1.0)
    semantic_map.integrate_proposals(points([1, 2]), np.zeros(2, int), np.ones((1, WIDTH)))
    found = semantic_map.label("dense", np.ones((2, WIDTH)))
    assert (found.points_m.shape, found.labels.shape, found.instance_labels.tolist()) == ((0, 3), (0,), [-1])
    assert np.isnan(found.instance_scores).all()
    assert semantic_map.label("instances", np.ones((2, WIDTH))).instance_labels.tolist() == [0]


@pytest.mark.parametrize("layer", LAYERS)
@pytest.mark.parametrize("sum_bytes", [None, 0])
def test_of_many_equal_texts_the_first_wins_wherever_they_are(mapped, layer, sum_bytes, monkeypatch):
    if sum_bytes is not None:
        monkeypatch.setattr(map_scan, "_SUM_BYTES", sum_bytes)
    few = embeddings_of(3, WIDTH, np.random.default_rng(4))
    once, often = mapped.label(layer, few), mapped.label(layer, few[[0, 0, 1, 0, 1, 2, 2, 1, 0, 2, 1]])
    np.testing.assert_array_equal(often.labels, np.array([0, 2, 5])[once.labels])
    np.testing.assert_array_equal(often.instance_labels, np.array([0, 2, 5])[once.instance_labels])
    np.testing.assert_array_equal(often.scores, once.scores)


@pytest.mark.parametrize("sum_bytes", [None, 0])
@pytest.mark.parametrize("backend", ["compiled", "torch"])
def test_of_different_texts_that_fit_equally_well_the_first_wins(backend, sum_bytes, monkeypatch):
    if sum_bytes is not None:
        monkeypatch.setattr(map_scan, "_SUM_BYTES", sum_bytes)
    semantic_map = SemanticMap(3, MapConfig(voxel_size_m=SIZE_M, backend=backend), 1.0)
    see(semantic_map, range(4), X)
    semantic_map.integrate_proposals(points(range(4)), np.zeros(4, int), X[None])
    for layer in LAYERS:
        found = semantic_map.label(layer, np.stack([Z, X + Y, X - Y, X + Z]))
        assert (found.labels.tolist(), found.instance_labels.tolist()) == ([1] * 4, [1])


@pytest.mark.parametrize("layer", LAYERS)
def test_labels_do_not_depend_on_the_number_of_threads_nor_compiled_scores(mapped, layer, monkeypatch):
    """Torch multiplies matrices in another order, so that its scores differ by rounding."""
    monkeypatch.setattr(compiled_kernels, "_SCAN_SLOTS", 64)  # So that there is work for several.
    vectors, before, results = embeddings_of(40, WIDTH, np.random.default_rng(3)), torch.get_num_threads(), []
    try:
        for threads in (1, 2, 4):
            torch.set_num_threads(threads)
            found = mapped.label(layer, vectors)
            results.append((found.points_m, found.labels, found.instance_labels, found.scores, found.instance_scores))
    finally:
        torch.set_num_threads(before)
    for others in results[1:]:
        for place, (one, other) in enumerate(zip(results[0], others, strict=True)):
            exact = place < 3 or mapped.config.backend == "compiled"
            np.testing.assert_allclose(other, one, rtol=0, atol=0 if exact else 1e-6)


def test_labels_elsewhere_are_those_here():
    vectors = embeddings_of(20, WIDTH, np.random.default_rng(6))
    here = random_map("torch", "cpu")
    with elsewhere() as device, pytest.MonkeyPatch.context() as patch:
        there = random_map("torch", device)
        for layer, sum_bytes in itertools.product(LAYERS, (map_scan._SUM_BYTES, 0)):
            patch.setattr(map_scan, "_SUM_BYTES", sum_bytes)
            mine, theirs = here.label(layer, vectors), there.label(layer, vectors)
            np.testing.assert_array_equal(mine.points_m, theirs.points_m)
            np.testing.assert_allclose(mine.scores, theirs.scores, atol=1e-6)
            np.testing.assert_array_equal(mine.labels, theirs.labels)
            np.testing.assert_array_equal(mine.instance_labels, theirs.instance_labels)


@pytest.mark.parametrize(
    ("layer", "texts", "error", "named"),
    [
        ("sparse", np.ones((1, 3)), QueryError, "unknown layer 'sparse'"),
        ("dense", np.ones((0, 3)), QueryError, "texts: at least one text"),
        ("dense", np.ones((1, 4)), MapError, "texts"),
        ("dense", np.full((1, 3), np.nan), MapError, "texts"),
    ],
)
def test_the_map_refuses_texts_that_mean_nothing(semantic_map, layer, texts, error, named):
    with pytest.raises(error, match=named):
        semantic_map.label(layer, texts)


@pytest.mark.parametrize(
    ("labels", "layer", "named"),
    [
        ([], "dense", "labels"),
        (["x", " "], "dense", r"labels\[1\]"),
        (["x"] * 257, "dense", "labels"),
        (["x" * 5000], "dense", r"labels\[0\]"),
        (["x"], "sparse", "layer"),
        (["x"], "instances", "layer: 'instances' is empty"),
    ],
)
def test_a_malformed_request_is_refused_by_field(semantic_map, labels, layer, named):
    with pytest.raises(QueryError, match=named):
        label_voxels(semantic_map, TEXTS, labels, layer)


def test_an_empty_map_is_refused():
    with pytest.raises(QueryError, match="map is empty"):
        label_voxels(SemanticMap(3, MapConfig(), 1.0), TEXTS, ["x"])
