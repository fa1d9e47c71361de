"""A rehearsal leaves nothing for the map itself to compile."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from reference.agreement import engine_of
from reference.steps import Setting, random_steps
from reference.variants import BACKENDS

from fus3dmaps_core.voxel_map import kernels
from fus3dmaps_core.voxel_map.layer_query import LayerQuery
from fus3dmaps_core.voxel_map.layers.similarity import LAYERS
from fus3dmaps_core.voxel_map.warm_up import warm_up


def compiled() -> set[tuple[str, Any]]:
    """Names of the compiled loops, each with the types that it is compiled for."""
    names = [path.stem for path in Path(kernels.__path__[0]).glob("numba_*.py")]
    modules = [importlib.import_module(f"{kernels.__name__}.{name}") for name in names]
    loops = {f"{module.__name__}.{name}": loop for module in modules for name, loop in vars(module).items()}
    return {(name, types) for name, loop in loops.items() for types in getattr(loop, "signatures", ())}


@pytest.mark.skipif(("compiled", "cpu") not in BACKENDS, reason="numba is not installed")
@pytest.mark.parametrize("dtype", ["float16", "int8", "float32"])
def test_a_map_runs_only_what_was_compiled_in_the_rehearsal(dtype):
    setting = Setting(backend="compiled", dtype=dtype)
    engine = engine_of(setting)
    warm_up(setting.dimension, engine.config)
    rehearsed = compiled()
    assert rehearsed
    for step in random_steps(setting, extent=3, count=40, seed=7):
        step.apply(engine)
    engine.voxels()
    engine.instances()
    engine.import_state(engine.export_state())
    texts = np.ones((3, setting.dimension), np.float32)
    for layer in LAYERS:
        for prompts in (texts, texts[:1]):
            engine.search(LayerQuery(layer, prompts, texts))
    assert compiled() == rehearsed
