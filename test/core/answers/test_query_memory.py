"""What a query needs beside its answer: a little, whatever the size of the map."""

from __future__ import annotations

import itertools
import tracemalloc
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from reference.agreement import KnownTexts
from reference.variants import BACKEND_IDS, BACKENDS
from torch.profiler import ProfilerActivity, profile

from fus3dmaps_core.answers.labels import label_voxels
from fus3dmaps_core.answers.query import TextQuery, answer_query
from fus3dmaps_core.config.schema import MapConfig
from fus3dmaps_core.voxel_map.kernels.torch_kernels import TorchKernels
from fus3dmaps_core.voxel_map.layers.similarity import LAYERS
from fus3dmaps_core.voxel_map.semantic_map import SemanticMap

MIB = 2**20
DIMENSION = 64
SLICES, ROWS, LENGTH = 120, 50, 50
TEXTS = KnownTexts(dict(zip(["a", "b", "c"], np.random.default_rng(3).normal(size=(3, DIMENSION)), strict=True)))


def slice_points_m(x: int) -> np.ndarray:
    """Centres of the voxels of a slice, row by row."""
    cells = [(x, y, z) for y in range(ROWS) for z in range(LENGTH)]
    return (np.array(cells) + 0.5) * 0.05


def see(semantic_map: SemanticMap, points_m: np.ndarray, rng: np.random.Generator) -> None:
    count = len(points_m)
    embeddings = rng.normal(size=(32, DIMENSION)).astype(np.float32)
    semantic_map.integrate_dense(
        points_m, rng.integers(0, 32, count), embeddings, np.ones(32), np.zeros((count, 3), np.uint8)
    )


@pytest.fixture(scope="module", params=BACKENDS, ids=BACKEND_IDS)
def large_map(request) -> SemanticMap:
    """A block of 300,000 voxels, all of them dense (77 MB as 32-bit floats), in rows that are 6,000 instances."""
    backend, device = request.param
    semantic_map = SemanticMap(DIMENSION, MapConfig(backend=backend, device=device), 1.0)
    rng = np.random.default_rng(1)
    for x in range(SLICES):
        points_m = slice_points_m(x)
        see(semantic_map, points_m, rng)
        if backend == "compiled" or x % 12 == 0:  # Torch takes proposals one by one.
            semantic_map.integrate_proposals(
                points_m, np.repeat(np.arange(ROWS), LENGTH), rng.normal(size=(ROWS, DIMENSION)).astype(np.float32)
            )
    assert semantic_map.dense_voxel_count == SLICES * ROWS * LENGTH
    return semantic_map


def peak_bytes(events) -> int:
    """Most that was allocated at once, of what was allocated meanwhile, from allocations and releases in order of time."""
    changes = sorted((event.start_ns(), event.nbytes()) for event in events if event.name() == "[memory]")
    return max(0, *itertools.accumulate(nbytes for _, nbytes in changes))


def peaks_bytes(semantic_map: SemanticMap, ask: Callable[[], Any]) -> tuple[Any, int, int]:
    """What a call returns, and the most that it allocates at once in arrays and in tensors, the kept ones included."""
    activities = (
        [ProfilerActivity.CPU, ProfilerActivity.CUDA] if semantic_map.config.device != "cpu" else [ProfilerActivity.CPU]
    )
    with profile(activities=activities, profile_memory=True) as profiled:
        tracemalloc.start()
        answer = ask()
        of_arrays = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    of_tensors = peak_bytes(profiled.profiler.kineto_results.events())
    assert of_tensors > 0
    scratch = getattr(semantic_map._kernels, "scratch_nbytes", 0)  # Kept from call to call.
    return answer, of_arrays, of_tensors + scratch


@pytest.mark.parametrize("layer", LAYERS)
@pytest.mark.parametrize(("prompts", "negatives"), [(3, 0), (1, 2), (200, 0), (200, 50)])
def test_a_query_needs_little_beside_its_answer(large_map: SemanticMap, layer: str, prompts: int, negatives: int):
    """However many voxels, instances and prompts: sums of 6,000 instances and 200 prompts alone are 10 MB."""
    if prompts == 200 and layer == "fused_dense" and isinstance(large_map._kernels, TorchKernels):
        prompts //= 4  # Slow in torch, and no different.
    query = TextQuery(list("abc" * prompts)[:prompts], list("cb" * negatives)[:negatives], layer=layer)
    answer_query(large_map, TEXTS, query, 10.0)  # Whatever is made once is there then.
    # One voxel of each row: fusion of every instance is to be computed anew.
    see(large_map, np.concatenate([slice_points_m(x)[::LENGTH] for x in range(SLICES)]), np.random.default_rng(2))
    answer, of_arrays, of_tensors = peaks_bytes(large_map, lambda: answer_query(large_map, TEXTS, query, 10.0))
    # The answer is as large as the map at first: only what is written becomes real.
    full_answer = large_map.voxel_count * (3 + 1) * 4
    assert of_arrays >= answer.points_m.nbytes
    assert of_arrays - full_answer + of_tensors < 48 * MIB


@pytest.mark.parametrize("layer", LAYERS)
@pytest.mark.parametrize("labels", [3, 250])
def test_labels_of_a_map_need_little_beside_them(large_map: SemanticMap, layer: str, labels: int):
    """However many labels; there are more of them than sums of 6,000 instances are kept for at a time."""
    if labels == 250 and layer == "fused_dense" and isinstance(large_map._kernels, TorchKernels):
        labels = 100  # Slow in torch, and no different.
    names = [str(number) for number in range(labels)]
    vectors = np.random.default_rng(4).normal(size=(labels, DIMENSION))
    texts = KnownTexts(dict(zip(names, vectors, strict=True)))
    label_voxels(large_map, texts, names, layer)  # Whatever is made once is there then.
    see(large_map, np.concatenate([slice_points_m(x)[::LENGTH] for x in range(SLICES)]), np.random.default_rng(2))
    found, of_arrays, of_tensors = peaks_bytes(large_map, lambda: label_voxels(large_map, texts, names, layer))
    full_answer = large_map.voxel_count * (3 + 1 + 1) * 4
    assert of_arrays >= found.points_m.nbytes + found.labels.nbytes + found.scores.nbytes
    assert of_arrays - full_answer + of_tensors < 48 * MIB
