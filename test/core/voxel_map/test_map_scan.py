"""Passes over the map: prompts in groups answer as all at once, and rankings cut where they should."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from reference.agreement import engine_of
from reference.steps import Setting, embeddings_of, random_steps
from reference.variants import BACKEND_IDS, BACKENDS

from fus3dmaps_core.voxel_map import map_scan
from fus3dmaps_core.voxel_map.layer_query import LayerQuery
from fus3dmaps_core.voxel_map.layers.similarity import LAYERS
from fus3dmaps_core.voxel_map.semantic_map import SemanticMap


def a_map(setting: Setting, seed: int) -> SemanticMap:
    engine = engine_of(setting)
    for step in random_steps(setting, extent=3, count=25, seed=seed):
        step.apply(engine)
    return engine


@pytest.mark.parametrize(("backend", "device"), BACKENDS, ids=BACKEND_IDS)
@pytest.mark.parametrize("layer", LAYERS)
def test_prompts_in_groups_answer_as_all_at_once(backend: str, device: str, layer: str, monkeypatch):
    setting = Setting(backend=backend, device=device)

    @settings(max_examples=10)
    @given(st.integers(0, 2**32 - 1), st.sampled_from([None, 0.0, 0.5, 3.0]), st.integers(0, 2))
    def check(seed, threshold, negatives):
        engine = a_map(setting, seed)
        rng = np.random.default_rng(seed)
        given_texts = {
            "prompts": embeddings_of(7, setting.dimension, rng),
            "negatives": embeddings_of(negatives, setting.dimension, rng) if negatives else None,
        }
        together = engine.search(LayerQuery(layer, **given_texts, logit_scale=3.0, threshold=threshold))
        with monkeypatch.context() as patched:
            patched.setattr(map_scan, "_SUM_BYTES", 1)  # One prompt at a time.
            apart = engine.search(LayerQuery(layer, **given_texts, logit_scale=3.0, threshold=threshold))
        assert apart.voxels == together.voxels
        sizes = {len(apart.points_m), len(apart.similarity)}
        assert len(sizes) == 1
        if len(apart.points_m) == len(together.points_m):  # Rounding may move a voxel over the threshold.
            np.testing.assert_array_equal(apart.points_m, together.points_m)
            np.testing.assert_allclose(apart.similarity, together.similarity, atol=2e-6)
        else:
            assert threshold is not None
            both = np.concatenate([apart.similarity, together.similarity])
            assert np.abs(both - threshold).min() < 1e-6
        assert len(apart.best) == len(together.best) == 7
        for (_, scores), (_, expected) in zip(apart.best, together.best, strict=True):
            np.testing.assert_allclose(scores, expected, atol=2e-6)

    check()


@given(st.lists(st.integers(0, 5), max_size=30), st.integers(1, 40))
def test_the_largest_come_first_and_equal_ones_in_their_order(values: list[int], count: int):
    expected = sorted(range(len(values)), key=lambda place: (-values[place], place))[:count]
    assert map_scan._largest(np.array(values, np.float64), count).tolist() == expected
