"""Running means at low precision over thousands of updates: they neither drift nor freeze.

A mean moves by (x - f) / w per observation. Where that is less than a step s of the grid, it goes one step with the
probability |x - f| / (w s), so an update at weight t adds the variance |x - f| s / t at most, of which (t / n)^2 is left at
weight n.
"""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest
import torch
from reference.variants import BACKEND_IDS, BACKENDS, kernels_of

from fus3dmaps_core.voxel_map.kernels.protocols import GroupedCounts
from fus3dmaps_core.voxel_map.rows.rounding import seeds_of
from fus3dmaps_core.voxel_map.rows.row_pool import RowPool

VOXELS = 64
STEP = {"float16": 2.0**-11, "int8": 1 / 112}
"""Largest distance of two neighbours on the grid, for values of at most one."""

A, B = np.eye(2, dtype=np.float32)
OF_A, OF_B = 1000, 5000
TRUTH = np.array([OF_A, OF_B]) / (OF_A + OF_B)
# |x - f| is 1000 / t from the thousandth observation on: the sum over t of (t / n)^2 (1000 / t) s / t.
SPREAD = {name: math.sqrt(OF_A * OF_B * step) / (OF_A + OF_B) for name, step in STEP.items()}


class Means:
    """Running means of many voxels that see the same."""

    def __init__(self, width: int, dtype: str, backend: str, device: str) -> None:
        self._kernels, self._device = kernels_of(backend, device), torch.device(device)
        self.pool = RowPool(width, getattr(torch, dtype), self._device)
        self._rows = self.pool.allocate(VOXELS)
        self._keys = torch.arange(VOXELS, device=self._device) * 2**21 + 5
        self._groups = GroupedCounts(
            torch.arange(VOXELS + 1, device=self._device),
            torch.zeros(VOXELS, dtype=torch.int64, device=self._device),
            torch.ones(VOXELS, dtype=torch.int64, device=self._device),
        )
        self._one = torch.ones(VOXELS, device=self._device)
        self._weight = torch.zeros(VOXELS, device=self._device)

    def see(self, embedding: torch.Tensor) -> None:
        new = self._weight + 1
        seeds = seeds_of(self._keys, new)
        self._kernels.merge_means(self.pool, self._rows, self._weight, new, seeds, self._groups, self._one, embedding)
        self._weight = new

    def read(self) -> np.ndarray:
        return self.pool.read(self._rows).cpu().numpy().astype(np.float64)


@pytest.mark.parametrize(("backend", "device"), BACKENDS, ids=BACKEND_IDS)
@pytest.mark.parametrize("dtype", STEP)
def test_a_mean_follows_a_change_after_a_thousand_observations(dtype: str, backend: str, device: str):
    means = Means(2, dtype, backend, device)
    part = 1 if backend == "compiled" else 5  # Torch takes its time; the spread is that of the ratio.
    for embedding, times in ((A, OF_A // part), (B, OF_B // part)):
        tensor = torch.tensor(embedding[None], device=device)
        for _ in range(times):
            means.see(tensor)
    error = means.read() - TRUTH
    assert np.abs(error).max() < 6 * SPREAD[dtype]
    assert np.abs(error.mean(axis=0)).max() < 5 * SPREAD[dtype] / math.sqrt(VOXELS)


@pytest.mark.parametrize("dtype", STEP)
def test_rounding_to_the_nearest_would_not_follow(dtype: str):
    """What the test above guards against."""
    mean = A.astype(np.float64)
    for weight in range(OF_A, OF_A + OF_B):
        mean = (weight * mean + B) / (weight + 1)
        mean = mean.astype(np.float16).astype(np.float64) if dtype == "float16" else np.rint(mean * 112) / 112
    assert np.abs(mean - TRUTH).max() > 2 * 6 * SPREAD[dtype]


@cache
def observations() -> np.ndarray:
    """Ten thousand unit vectors that share some direction."""
    rng = np.random.default_rng(8)
    values = rng.normal(size=(10_000, 16)) + 0.7
    return values / np.linalg.norm(values, axis=1, keepdims=True)


@pytest.mark.parametrize("dtype", STEP)
def test_the_error_has_a_bound_that_does_not_grow_with_the_number_of_observations(dtype: str):
    means = Means(16, dtype, *BACKENDS[0])
    exact, errors = np.cumsum(observations(), axis=0), {}
    for count, embedding in enumerate(torch.tensor(observations()[:, None], dtype=torch.float32), start=1):
        means.see(embedding)
        if count in (1, 10, 100, 1000, 10_000):
            error = means.read() - exact[count - 1] / count
            errors[count] = math.sqrt((error**2).mean())
            # Voxels err independently: their mean is the true one.
            assert np.abs(error.mean(axis=0)).max() < 6 * errors[count] / math.sqrt(VOXELS)
    # The sum over t of (t / n)^2 |x - f| s / t is |x - f| s / 2, whatever n is.
    bound = math.sqrt(np.abs(observations() - observations().mean(axis=0)).mean() * STEP[dtype] / 2)
    assert max(errors.values()) < bound
