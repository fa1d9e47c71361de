"""Loops over embedding rows, on every backend and for every storage type, against plain numpy in float64."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from reference.agreement import ROUNDING
from reference.variants import BACKEND_IDS, BACKENDS, DTYPES, kernels_of

from fus3dmaps_core.voxel_map.kernels.protocols import FusionRows, GroupedCounts
from fus3dmaps_core.voxel_map.rows.row_pool import RowPool

_seeds = st.integers(0, 2**32 - 1)
in_every_dtype = pytest.mark.parametrize("dtype", DTYPES)


@pytest.fixture(scope="module", params=BACKENDS, ids=BACKEND_IDS)
def backend(request):
    """Kernels and their device."""
    return kernels_of(*request.param), torch.device(request.param[1])


def unit(values: np.ndarray) -> np.ndarray:
    wide = np.asarray(values, np.float64)
    wide = wide / np.abs(wide).max(axis=1, keepdims=True)
    return wide / np.linalg.norm(wide, axis=1, keepdims=True)


def filled_pool(rng: np.random.Generator, count: int, width: int, dtype: str, device: torch.device) -> RowPool:
    """A pool with rows 0 .. count - 1 of unit length or less, seen through several blocks."""
    pool = RowPool(width, getattr(torch, dtype), device)
    values = unit(rng.normal(size=(count, width)) + 0.3) * rng.uniform(0.2, 1.0, (count, 1))
    rows = pool.allocate(count)
    pool.write(rows, torch.tensor(values, dtype=torch.float32, device=device), torch.arange(count, device=device))
    return pool


def spoil(pool: RowPool) -> None:
    """Fill a pool's memory with what a fresh row may find: not a number in every storage type, and scales as well."""
    for block in pool.blocks:
        block.view(torch.uint8).fill_(0xFF)
    if pool.dtype == torch.int8:
        pool.scales[:] = math.nan


# ---- unit_rows


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.float16])
@pytest.mark.parametrize("count", [1, 3, 700])
def test_rows_of_any_length_are_brought_to_unit_length(backend, dtype: torch.dtype, count: int):
    kernels, device = backend
    rng = np.random.default_rng(count)
    limits = torch.finfo(dtype)
    lengths = [1.0, 1e-3, limits.max / 4, limits.tiny * 8]
    if dtype != torch.float16:
        lengths += [1e-20, 1e18, 1e-30, 1e30]
    values = unit(rng.normal(size=(count * len(lengths), 96))) * np.repeat(lengths, count)[:, None]
    given_values = torch.tensor(values, device=device).to(dtype)
    got, failure = kernels.unit_rows(given_values)
    assert failure == 0
    assert got.dtype == torch.float32
    np.testing.assert_allclose(got.cpu().numpy(), unit(given_values.to(torch.float64).cpu().numpy()), rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize(
    ("row", "dtype"),
    [
        ([5e-324, 0, 0], torch.float64),
        ([5e-324, 5e-324, 0], torch.float64),
        ([1e-310, -2e-310, 3e-310], torch.float64),
        ([1e-160, -2e-160, 3e-160], torch.float64),
        ([1e-141, 1e-139, 1e-140], torch.float64),
        ([1.7e308, -1.7e308, 1.7e308], torch.float64),
        ([1e300, 1e-300, 0], torch.float64),
        ([1e154, 1e154, 2e154], torch.float64),
        ([1.4e-45, 0, 0], torch.float32),
        ([1e-40, 2e-40, -1e-40], torch.float32),
        ([3e38, -3e38, 3e38], torch.float32),
        ([3e38, 1e-45, 0], torch.float32),
    ],
)
def test_the_smallest_and_largest_values_have_a_direction_too(backend, row: list[float], dtype: torch.dtype):
    kernels, device = backend
    values = torch.tensor([[1.0, 2.0, 3.0], row], dtype=dtype, device=device)
    got, failure = kernels.unit_rows(values)
    assert failure == 0
    expected = np.array([float(value) for value in values[1].tolist()])
    np.testing.assert_allclose(got[1].cpu().numpy(), unit(expected[None])[0], rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("place", [(0, 0), (20, 95), (2999, 50)])
def test_rows_that_are_not_finite_are_told(backend, dtype: torch.dtype, value: float, place: tuple[int, int]):
    kernels, device = backend
    values = torch.ones((3000, 96), dtype=dtype, device=device)
    values[place] = value
    assert kernels.unit_rows(values)[1] == 1


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("row", [0, 20, 2999])
def test_rows_of_no_length_are_told(backend, dtype: torch.dtype, row: int):
    kernels, device = backend
    values = torch.ones((3000, 96), dtype=dtype, device=device)
    values[row] = 0
    assert kernels.unit_rows(values)[1] == 2
    values[1500] = math.nan
    assert kernels.unit_rows(values)[1] in (1, 2)


def test_no_rows(backend):
    kernels, device = backend
    got, failure = kernels.unit_rows(torch.zeros((0, 7), device=device))
    assert (got.shape, failure) == ((0, 7), 0)


# ---- merge_means


@in_every_dtype
def test_means_are_merged(backend, dtype: str):
    kernels, device = backend

    @settings(max_examples=30)
    @given(_seeds, st.integers(1, 12), st.integers(1, 40), st.integers(1, 6))
    def check(seed, count, width, sources):
        rng = np.random.default_rng(seed)
        pool = filled_pool(rng, 3000, width, dtype, device)
        rows = rng.choice(3000, count, replace=False)
        before = pool.read(torch.arange(3000, device=device)).cpu().numpy()
        embeddings = unit(rng.normal(size=(sources, width))).astype(np.float32)
        lengths = rng.integers(0, 4, count)
        partners = rng.integers(0, sources, lengths.sum())
        amounts = rng.uniform(0.01, 50.0, len(partners)).astype(np.float32)
        old = (rng.uniform(0.01, 1e3, count) * rng.choice([1.0, 100.0], count)).astype(np.float32)
        offsets = np.concatenate([[0], np.cumsum(lengths)])
        new = np.array([old[i] + amounts[offsets[i] : offsets[i + 1]].sum() for i in range(count)], np.float32)
        groups = GroupedCounts(*(torch.tensor(each, device=device) for each in (offsets, partners, np.ones_like(partners))))
        tensors = (torch.tensor(each, device=device) for each in (rows, old, new, rng.integers(0, 2**32, count)))
        kernels.merge_means(
            pool, *tensors, groups, torch.tensor(amounts, device=device), torch.tensor(embeddings, device=device)
        )
        after = pool.read(torch.arange(3000, device=device)).cpu().numpy()
        expected = before.astype(np.float64)
        for i, row in enumerate(rows):
            total = float(old[i]) * expected[row]
            for j in range(offsets[i], offsets[i + 1]):
                total = total + float(amounts[j]) * embeddings[partners[j]].astype(np.float64)
            expected[row] = total / float(new[i])
        untouched = np.setdiff1d(np.arange(3000), rows)
        np.testing.assert_array_equal(after[untouched], before[untouched])
        np.testing.assert_allclose(after[rows], expected[rows], atol=1e-6 + ROUNDING[dtype])

    check()


@in_every_dtype
def test_a_fresh_row_shows_nothing_of_what_lay_there(backend, dtype: str):
    kernels, device = backend
    pool = RowPool(33, getattr(torch, dtype), device)
    rows = pool.allocate(1500)
    spoil(pool)
    rng = np.random.default_rng(1)
    embeddings = torch.tensor(unit(rng.normal(size=(1500, 33))), dtype=torch.float32, device=device)
    each = torch.arange(1500, device=device)
    groups = GroupedCounts(torch.arange(1501, device=device), each, torch.ones_like(each))
    weights = torch.full((1500,), 0.375, device=device)
    kernels.merge_means(pool, rows, torch.zeros_like(weights), weights, each, groups, weights, embeddings)
    np.testing.assert_allclose(pool.read(rows).cpu().numpy(), embeddings.cpu().numpy(), atol=1e-6 + ROUNDING[dtype])


@in_every_dtype
def test_backends_store_the_same_bytes(dtype: str):
    """The rounding is a function of value, seed and column alone, so the same values are stored as the same bits."""
    stored = {}
    for backend, device_name in BACKENDS:
        kernels, device = kernels_of(backend, device_name), torch.device(device_name)
        rng = np.random.default_rng(5)
        pool = RowPool(257, getattr(torch, dtype), device)
        rows = pool.allocate(2000)
        spoil(pool)
        values = (
            unit(rng.normal(size=(2000, 257))) * rng.uniform(0.01, 1.0, (2000, 1)) * rng.choice([1.0, 1e-3], (2000, 257))
        )
        embeddings = torch.tensor(values, dtype=torch.float32, device=device)
        each = torch.arange(2000, device=device)
        groups = GroupedCounts(torch.arange(2001, device=device), each, torch.ones_like(each))
        seeds = torch.tensor(rng.integers(0, 2**32, 2000), device=device)
        ones = torch.ones(2000, device=device)
        kernels.merge_means(pool, rows, torch.zeros_like(ones), ones, seeds, groups, ones, embeddings)
        values, scales = pool.read_stored(rows)
        stored[backend, device_name] = (values.cpu().numpy(), scales.cpu().numpy())
    (first_values, first_scales), *others = stored.values()
    for other_values, other_scales in others:
        assert other_scales.tobytes() == first_scales.tobytes()
        assert np.count_nonzero(other_values.view(np.uint8) != first_values.view(np.uint8)) == 0


@in_every_dtype
@pytest.mark.parametrize("weight", [1.2e-38, 1e-30, 1e6, 1e30])
def test_a_mean_does_not_depend_on_the_unit_of_weight(backend, dtype: str, weight: float):
    kernels, device = backend
    pool = RowPool(3, getattr(torch, dtype), device)
    rows = pool.allocate(1)
    groups = GroupedCounts(*(torch.tensor(each, device=device) for each in ([0, 1], [0], [1])))
    weights, seeds = torch.tensor([weight], device=device), torch.zeros(1, dtype=torch.int64, device=device)
    first, second = (torch.tensor([each], device=device) for each in ([0.6, 0.8, 0.0], [0.8, 0.0, 0.6]))
    kernels.merge_means(pool, rows, torch.zeros_like(weights), weights, seeds, groups, weights, first)
    kernels.merge_means(pool, rows, weights, 2 * weights, seeds, groups, weights, second)
    np.testing.assert_allclose(pool.read(rows).cpu().numpy(), [[0.7, 0.4, 0.3]], atol=1e-6 + 2 * ROUNDING[dtype])


# ---- cosines


def exact_cosines(vectors: np.ndarray, texts: np.ndarray) -> np.ndarray:
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.where(lengths > 0, vectors / np.where(lengths > 0, lengths, 1.0), 0.0) @ texts.T.astype(np.float64)


@in_every_dtype
@pytest.mark.parametrize(("count", "width", "prompts"), [(0, 5, 2), (1, 1, 1), (5000, 31, 3), (2500, 64, 1)])
def test_cosines_of_rows(backend, dtype: str, count: int, width: int, prompts: int):
    kernels, device = backend
    rng = np.random.default_rng(count)
    pool = filled_pool(rng, 3000, width, dtype, device)
    rows = torch.tensor(rng.integers(0, 3000, count), device=device)
    texts = unit(rng.normal(size=(prompts, width))).astype(np.float32)
    got = kernels.cosines(pool, rows, torch.tensor(texts, device=device))
    assert got.dtype == torch.float32
    exact = exact_cosines(pool.read(rows).cpu().numpy().astype(np.float64), texts)
    np.testing.assert_allclose(got.cpu().numpy(), exact, atol=2e-6)


@in_every_dtype
def test_the_cosine_of_nothing_is_nothing(backend, dtype: str):
    kernels, device = backend
    pool = RowPool(16, getattr(torch, dtype), device)
    rows = pool.allocate(3)
    pool.write(rows, torch.zeros(3, 16, device=device), torch.arange(3, device=device))
    texts = torch.full((2, 16), 0.25, device=device)
    assert kernels.cosines(pool, rows, texts).tolist() == [[0.0, 0.0]] * 3


# ---- fuse


def random_layer(rng: np.random.Generator, rows: int, instances: int, width: int, dtype: str, device: torch.device):
    """Rows, some of them free, under slots in any order, whose voxels hold up to three of the instances."""
    pool = filled_pool(rng, rows, width, dtype, device)
    slots = rng.permutation(rows + 20)[:rows]
    slots[rng.random(rows) < 0.1] = -1
    held = np.full((rows + 20, 3), -1)
    for slot in range(rows + 20):
        chosen = rng.permutation(instances)[: rng.integers(0, 4)]
        held[slot, rng.permutation(3)[: len(chosen)]] = chosen
    weights = (rng.integers(1, 65, rows) / 64.0).astype(np.float32)
    return pool, slots.astype(np.int32), weights, held.astype(np.int32)


@dataclass
class Fusion:
    """A layer, the instances' own embeddings and weights, and where fused embeddings go."""

    pool: RowPool
    slots: np.ndarray
    weights: np.ndarray
    held: np.ndarray
    own: RowPool
    amounts: np.ndarray

    def fuse(self, kernels, device, rows, bars=None) -> tuple[np.ndarray, np.ndarray]:
        """What is written for the instances of the rows (NaN where nothing is), and their evidence."""
        tensors = (torch.tensor(each, device=device) for each in (self.slots, self.weights, self.held))
        target = RowPool(self.own.dimension, torch.float32, device)
        target.allocate(self.own.high_water)
        spoil(target)
        where = torch.tensor(np.asarray(rows, np.int64), device=device)
        bars = np.full(len(rows), -np.inf) if bars is None else bars
        given = (torch.tensor(each, device=device) for each in (self.amounts[rows], bars))
        evidence = kernels.fuse(FusionRows(self.pool, *tensors), where, self.own, *given, target)
        assert evidence.dtype == torch.float64
        return target.read(where).cpu().numpy(), evidence.cpu().numpy()

    def expected(self, device) -> tuple[np.ndarray, np.ndarray]:
        """The same for every instance, by plain loops."""
        means = self.pool.read(torch.arange(len(self.slots), device=device)).cpu().numpy().astype(np.float64)
        own = self.own.read(torch.arange(self.own.high_water, device=device)).cpu().numpy().astype(np.float64)
        sums, totals = self.amounts[:, None] * own, self.amounts.copy()
        for row, slot in enumerate(self.slots):
            for instance in self.held[slot] if slot >= 0 else ():
                if instance >= 0:
                    sums[instance] += float(self.weights[row]) * means[row]
                    totals[instance] += float(self.weights[row])
        fused = np.where(totals[:, None] > 0, sums / np.where(totals > 0, totals, 1.0)[:, None], own)
        return fused, totals


def random_fusion(rng: np.random.Generator, rows: int, instances: int, width: int, dtype: str, device) -> Fusion:
    own = filled_pool(rng, instances, width, "float32", device)
    amounts = rng.choice([0.0, 0.5, 300.0], instances)
    return Fusion(*random_layer(rng, rows, instances, width, dtype, device), own, amounts)


@in_every_dtype
@pytest.mark.parametrize(("rows", "instances"), [(0, 4), (40, 5), (5000, 12)])
def test_instances_are_fused_with_their_voxels(backend, dtype: str, rows: int, instances: int):
    kernels, device = backend
    rng = np.random.default_rng(rows)
    fusion = random_fusion(rng, rows, instances, 17, dtype, device)
    asked = rng.permutation(instances)[: instances - 1]
    fused, evidence = fusion.fuse(kernels, device, asked)
    expected, totals = fusion.expected(device)
    np.testing.assert_allclose(evidence, totals[asked], rtol=1e-12)
    np.testing.assert_allclose(fused, expected[asked], atol=3e-6)


@in_every_dtype
def test_only_instances_above_their_bar_are_written(backend, dtype: str):
    kernels, device = backend
    fusion = random_fusion(np.random.default_rng(8), 3000, 9, 17, dtype, device)
    expected, totals = fusion.expected(device)
    bars = totals + np.array([-1.0, 0.0, 1.0] * 3)
    fused, evidence = fusion.fuse(kernels, device, np.arange(9), bars)
    np.testing.assert_allclose(evidence, totals, rtol=1e-12)
    written = np.arange(9) % 3 == 0
    np.testing.assert_allclose(fused[written], expected[written], atol=3e-6)
    assert np.isnan(fused[~written]).all()


@in_every_dtype
def test_an_instances_fusion_does_not_depend_on_which_others_are_asked_for(backend, dtype: str):
    kernels, device = backend
    instances = 9
    fusion = random_fusion(np.random.default_rng(3), 6000, instances, 40, dtype, device)
    everything, totals = fusion.fuse(kernels, device, np.arange(instances))

    @settings(max_examples=15)
    @given(st.permutations(range(instances)), st.integers(1, instances))
    def check(order, count):
        some, some_totals = fusion.fuse(kernels, device, np.array(order[:count]))
        assert some.tobytes() == everything[order[:count]].tobytes()
        assert some_totals.tobytes() == totals[order[:count]].tobytes()

    check()


@pytest.fixture
def set_threads():
    """Sets torch's number of threads, for this test only."""
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


@in_every_dtype
def test_results_do_not_depend_on_the_number_of_threads(backend, set_threads, dtype: str):
    kernels, device = backend
    rng = np.random.default_rng(11)
    fusion = random_fusion(rng, 9000, 9, 40, dtype, device)
    texts = torch.tensor(unit(rng.normal(size=(3, 40))), dtype=torch.float32, device=device)
    embeddings = torch.tensor(rng.normal(size=(9000, 40)), device=device)
    each = torch.arange(9000, device=device)
    groups = GroupedCounts(torch.arange(9001, device=device), each, torch.ones_like(each))
    weights = torch.full((9000,), 0.25, device=device)

    def everything() -> list[bytes]:
        units = kernels.unit_rows(embeddings)[0]
        pool = filled_pool(np.random.default_rng(2), 9000, 40, dtype, device)
        kernels.merge_means(pool, each, weights, 4 * weights, each, groups, 3 * weights, units)
        cosines = kernels.cosines(fusion.pool, each, texts)
        arrays = [array.cpu().numpy() for array in (units, pool.read(each), cosines)]
        return [array.tobytes() for array in (*arrays, *fusion.fuse(kernels, device, np.arange(9)))]

    results = []
    for threads in (1, 2, 1):
        set_threads(threads)
        results.append(everything())
    assert results[0] == results[1] == results[2]
