"""The map on a device that is not the host's, as a GPU: it does what the reference does, and mixes up no memory."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from elsewhere import elsewhere
from hypothesis import given, settings
from hypothesis import strategies as st
from reference.agreement import (
    KnownTexts,
    apply_to_both,
    assert_same_answer,
    assert_same_bytes,
    assert_same_map,
    engine_of,
    reference_of,
)
from reference.steps import Setting, embeddings_of, random_steps
from reference.variants import DTYPES

from fus3dmaps_core.answers.query import TextQuery
from fus3dmaps_core.errors import ConfigError
from fus3dmaps_core.voxel_map.layers.similarity import LAYERS


def test_the_device_refuses_what_a_gpu_refuses():
    with elsewhere() as device:
        there = torch.arange(3, device=device)
        assert there.device.type != "cpu"
        assert (there + 1).cpu().tolist() == [1, 2, 3]
        with pytest.raises(RuntimeError, match="one device"):
            there + torch.arange(3)
        with pytest.raises(TypeError, match="numpy"):
            there.numpy()


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("window_radius_m", [0.0, 0.16])
def test_a_map_elsewhere_agrees_with_the_reference(window_radius_m: float, dtype: str):
    @settings(max_examples=8)
    @given(st.integers(0, 2**32 - 1), st.integers(5, 25))
    def check(seed, count):
        with elsewhere() as device:
            setting = Setting(window_radius_m=window_radius_m, dtype=dtype, backend="auto", device=device)
            engine, reference = engine_of(setting), reference_of(setting)
            for step in random_steps(setting, extent=2, count=count, seed=seed):
                apply_to_both(step, engine, reference)
            assert_same_map(engine, reference, setting)
            texts = KnownTexts(dict(zip(["a", "b", "c"], embeddings_of(3, 5, np.random.default_rng(seed)), strict=True)))
            for layer in LAYERS:
                for negatives in ([], ["c"]):
                    query = TextQuery(["a", "b"], negative_prompts=negatives, layer=layer, top_k=3, min_voxels=2)
                    assert_same_answer(engine, reference, setting, query, texts, 20.0)
            state, copy = engine.export_state(), engine_of(setting)
            copy.import_state(state)
            assert_same_bytes(state, copy.export_state())

    check()


def test_compiled_kernels_are_refused_there():
    with elsewhere() as device, pytest.raises(ConfigError, match=r"map\.backend"):
        engine_of(Setting(backend="compiled", device=device))
