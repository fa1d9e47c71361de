"""Predicted classes against scipy's softmax and a plain reading of the rules; cosines against a plain map."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays
from reference.agreement import apply_to_both, engine_of, reference_of
from reference.queries import layer_embeddings
from reference.steps import Setting, embeddings_of, random_steps
from reference.vectors import cosine
from scipy.special import softmax

from fus3dmaps_core.config.schema import MapConfig
from fus3dmaps_core.errors import MapError, QueryError
from fus3dmaps_core.voxel_map.layers.similarity import LAYERS
from fus3dmaps_core.voxel_map.semantic_map import SemanticMap
from fus3dmaps_lab.evaluation import prediction
from fus3dmaps_lab.evaluation.prediction import layer_cosines, predict_classes, top_classes

# Multiples of 1/64, so that no probability lies within rounding of another or of a limit but where it is equal.
cosines = arrays(
    np.float32,
    array_shapes(min_dims=2, max_dims=2, min_side=1, max_side=12),
    elements=st.integers(-64, 64).map(lambda number: number / 64),
)


def predicted_plainly(values, scale, min_probability, min_peak):
    """Predict the classes of one chunk by the words of the protocol."""
    likely = softmax(scale * values.astype(np.float64), axis=1)
    found = []
    for row in likely:
        kept = [column for column in range(len(row)) if likely[:, column].max() >= min_peak]
        best = max(kept, key=lambda column: (row[column], -column), default=None)
        found.append(0 if best is None or row[best] < min_probability else best + 1)
    return found


limits = {"scale": st.sampled_from([1.0, 20.0, 100.0]), "min_probability": st.sampled_from([0.0, 0.13, 0.41])}
peaks = st.sampled_from([0.0, 0.31, 0.52])


@given(values=cosines, min_peak=peaks, **limits)
def test_the_global_rule_takes_the_layer_as_one(values, scale, min_probability, min_peak):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(prediction, "_BLOCK_ROWS", 3)
        found = predict_classes(values, scale, min_probability, min_peak=min_peak)
    assert found.dtype == np.int32
    assert found.tolist() == predicted_plainly(values, scale, min_probability, min_peak)


@given(values=cosines, min_peak=peaks, chunk=st.integers(1, 5), **limits)
def test_the_chunked_rule_takes_each_chunk_for_itself(values, scale, min_probability, min_peak, chunk):
    found = predict_classes(values, scale, min_probability, "chunked", chunk, min_peak)
    expected = []
    for first in range(0, len(values), chunk):
        expected += predicted_plainly(values[first : first + chunk], scale, min_probability, min_peak)
    assert found.tolist() == expected


@given(values=cosines, seed=st.integers(0, 2**32 - 1))
def test_the_global_rule_does_not_depend_on_the_order_of_voxels(values, seed):
    order = np.random.default_rng(seed).permutation(len(values))
    np.testing.assert_array_equal(predict_classes(values[order], 20.0), predict_classes(values, 20.0)[order])


def test_the_chunked_rule_does():
    sure, unsure = [0.5, 0.0, 0.0], [-0.005, 0.0115, 0.01]
    values = np.array([sure, unsure, [0.0, 0.5, 0.0], sure], np.float32)
    assert predict_classes(values, rule="chunked", chunk=2).tolist() == [1, 0, 2, 1]
    assert predict_classes(values[[0, 3, 1, 2]], rule="chunked", chunk=2).tolist() == [1, 1, 2, 2]
    assert predict_classes(values).tolist() == [1, 2, 2, 1]


def test_what_just_reaches_a_limit_is_kept():
    even = np.zeros((1, 2), np.float32)  # Both are as likely as one half.
    assert predict_classes(even, min_probability=0.5, min_peak=0.5).tolist() == [1]
    assert predict_classes(even, min_peak=0.500001).tolist() == [0]
    assert predict_classes(even, min_probability=0.500001).tolist() == [0]


def test_nothing_is_predicted_of_nothing():
    assert predict_classes(np.empty((0, 3), np.float32)).tolist() == []
    assert predict_classes(np.empty((2, 0), np.float32)).tolist() == [0, 0]
    assert [each.tolist() for each in top_classes(np.empty((2, 0), np.float32))] == [[0, 0], [0, 0]]


@given(values=cosines, scale=limits["scale"])
def test_the_likeliest_class_and_its_probability(values, scale):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(prediction, "_BLOCK_ROWS", 3)
        classes, probabilities = top_classes(values, scale)
    expected = softmax(scale * values.astype(np.float64), axis=1)
    assert classes.tolist() == (expected.argmax(axis=1) + 1).tolist()
    np.testing.assert_allclose(probabilities, expected.max(axis=1), rtol=0, atol=1e-12)


@settings(max_examples=15)
@given(seed=st.integers(0, 2**32 - 1), layer=st.sampled_from(LAYERS), window=st.sampled_from([0.0, 1.0]))
def test_cosines_agree_with_a_plain_map(seed, layer, window):
    setting = Setting(window_radius_m=window)
    engine, reference = engine_of(setting), reference_of(setting)
    for step in random_steps(setting, extent=2, count=8, seed=seed):
        apply_to_both(step, engine, reference)
    expected = layer_embeddings(reference, layer)
    vectors = embeddings_of(4, setting.dimension, np.random.default_rng(seed))
    centers_m, found = layer_cosines(engine, layer, vectors)
    keys = [tuple(key) for key in np.floor(centers_m / engine.config.voxel_size_m).astype(int).tolist()]
    assert set(keys) == set(expected)
    assert found.shape == (len(expected), 4)
    for key, row in zip(keys, found.tolist(), strict=True):
        assert row == pytest.approx([cosine(expected[key], list(vector)) for vector in vectors], abs=1e-5)


def test_odd_questions_are_refused():
    semantic_map = SemanticMap(3, MapConfig(), 1.0)
    with pytest.raises(QueryError, match="unknown layer 'sparse'"):
        layer_cosines(semantic_map, "sparse", np.eye(3))
    with pytest.raises(MapError, match="text_vectors: at least one"):
        layer_cosines(semantic_map, "dense", np.empty((0, 3)))
    with pytest.raises(MapError, match="prompts"):
        layer_cosines(semantic_map, "dense", np.eye(2))


def test_a_map_that_changes_meanwhile_is_refused():
    class Changing(SemanticMap):
        """A map that gets a new voxel with every query."""

        def search(self, query):
            point = np.full((1, 3), self.voxel_count + 0.5)
            self.integrate_dense(point, np.zeros(1, int), np.eye(3)[:1], np.ones(1), np.zeros((1, 3), np.uint8))
            return super().search(query)

    with pytest.raises(MapError, match="layer 'dense' was changed"):
        layer_cosines(Changing(3, MapConfig(), 1.0), "dense", np.eye(3))
