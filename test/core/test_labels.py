"""Every voxel gets the label that fits it best, also while the map changes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from reference.agreement import KnownTexts, apply_to_both, engine_of, reference_of
from reference.queries import layer_embeddings
from reference.steps import Setting, embeddings_of, random_steps
from reference.vectors import cosine

from fus3dmaps_core.config import MapConfig
from fus3dmaps_core.errors import QueryError
from fus3dmaps_core.labels import label_voxels
from fus3dmaps_core.layers.similarity import LAYERS
from fus3dmaps_core.semantic_map import SemanticMap

SIZE_M = 0.5
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


def test_voxels_that_come_and_go_meanwhile_are_left_out_and_the_rest_is_right(semantic_map):
    class Changing(SemanticMap):
        """Changes between one question and the next."""

        def search(self, *args, **options):
            found = semantic_map.search(*args, **options)
            semantic_map.remove_voxels(points([-3]))
            see(semantic_map, [40], Y)
            return found

    changing = Changing(3, semantic_map.config, 1.0)
    see(changing, [0], X)
    assert numbers_of(label_voxels(changing, TEXTS, ["x", "y"])) == {-2: 0, -1: 0, 5: 1, 6: 1}


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
