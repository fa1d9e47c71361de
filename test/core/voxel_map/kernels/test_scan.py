"""The pass over voxels, on every backend, against plain loops: what instances occupy, and scores of every layer."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from reference.columns import columns
from reference.variants import BACKEND_IDS, BACKENDS, DTYPES, kernels_of

from fus3dmaps_core.voxel_map.kernels.keys import MAX_COORDINATE, pack
from fus3dmaps_core.voxel_map.kernels.protocols import (
    EMPTY,
    SCORE_UNIT,
    EmbeddedLayer,
    Extents,
    Hypotheses,
    InheritedLayer,
    ScoredVoxels,
    ScoreSums,
    SlotBlock,
    Texts,
)
from fus3dmaps_core.voxel_map.kernels.torch_kernels import TorchKernels
from fus3dmaps_core.voxel_map.rows.row_pool import RowPool

SIZE_M = 0.25
ID_OF_ROW = [4, -1, 9, 2, 7]
ALIVE = [row for row, each in enumerate(ID_OF_ROW) if each >= 0]
LAYERS = ("nothing", "dense", "fused", "inherited")


@pytest.fixture(scope="module", params=BACKENDS, ids=BACKEND_IDS)
def backend(request):
    """Kernels and their device."""
    return kernels_of(*request.param), torch.device(request.param[1])


def unit(rng: np.random.Generator, count: int, width: int) -> np.ndarray:
    values = rng.normal(size=(count, width)) + 0.2
    return values / np.linalg.norm(values, axis=1, keepdims=True)


def pool_of(values: np.ndarray, dtype: str, device: torch.device) -> RowPool:
    pool = RowPool(values.shape[1], getattr(torch, dtype), device)
    rows = pool.allocate(len(values))
    pool.write(rows, torch.tensor(values, dtype=torch.float32, device=device), rows)
    return pool


@dataclass
class Scene:
    """Voxels, what they hold, and the rows behind them."""

    device: torch.device
    coordinates: np.ndarray
    alive: np.ndarray
    dense_rows: np.ndarray
    held: list[dict[int, int]]
    hypotheses: Hypotheses
    pool: RowPool
    own: RowPool
    weights: np.ndarray

    def tops(self) -> list[tuple[int, int]]:
        return [min(each.items(), key=lambda pair: (-pair[1], ID_OF_ROW[pair[0]]), default=(-1, 0)) for each in self.held]

    def embedding(self, slot: int, layer: str, top: tuple[int, int], ratio: float) -> np.ndarray | None:
        """What the layer says of a voxel; None where it says nothing."""
        row = self.dense_rows[slot]
        mean = None if row < 0 else self.means[row]
        own = None if layer == "dense" or top[0] < 0 else self.own_means[top[0]]
        if mean is None or layer == "dense":
            return mean if own is None else own
        if own is None:
            return mean
        return (self.weights[row] * mean + ratio * top[1] * own) / (self.weights[row] + ratio * top[1])

    def __post_init__(self) -> None:
        def read(pool: RowPool) -> np.ndarray:
            return pool.read(torch.arange(pool.high_water, device=self.device)).cpu().numpy().astype(np.float64)

        self.means, self.own_means = read(self.pool), read(self.own)


def scene(rng: np.random.Generator, count: int, width: int, dtype: str, device: torch.device) -> Scene:
    """Voxels of any coordinates; runs of neighbours share instances, as on a surface."""
    spans = rng.choice([2, 1000, MAX_COORDINATE], (count, 1))
    alive = rng.random(count) < 0.9
    dense_rows = np.where(alive & (rng.random(count) < 0.6), rng.permutation(count), -1)
    runs = np.repeat(np.arange(count), rng.integers(1, 9, count))[:count]
    held = []
    for slot in range(count):
        of_run = np.random.default_rng([int(runs[slot]), count])
        rows = of_run.permutation(ALIVE)[: of_run.integers(0, 4)]
        held.append({int(row): int(of_run.integers(1, 5)) for row in rows} if alive[slot] else {})
    return Scene(
        device,
        rng.integers(-spans, spans + 1, (count, 3)),
        alive,
        dense_rows,
        held,
        columns(held, 3, ID_OF_ROW, device, rng),
        pool_of(unit(rng, max(count, 1), width) * rng.uniform(0.2, 1.0, (max(count, 1), 1)), dtype, device),
        pool_of(unit(rng, len(ID_OF_ROW), width) * rng.uniform(0.2, 1.0, (len(ID_OF_ROW), 1)), "float32", device),
        rng.uniform(0.01, 1e3, max(count, 1)).astype(np.float32),
    )


def no_extents(device: torch.device) -> Extents:
    zeros = partial(torch.zeros, dtype=torch.int64, device=device)
    rows = len(ID_OF_ROW)
    far = torch.full((rows, 3), 2**62, dtype=torch.int64, device=device)
    return Extents(voxels=zeros(rows), counts=zeros(rows), sums=zeros((rows, 3)), low=far, high=-far)


def score(embedding: np.ndarray, texts: np.ndarray, prompts: int, logit_scale: float) -> list[float]:
    """Cosines with prompts, or the lowest two-way softmax against a negative."""
    cosines = texts @ embedding / max(float(np.linalg.norm(embedding)), 1e-30)
    if prompts == len(texts):
        return cosines.tolist()
    return [
        min(1 / (1 + math.exp(logit_scale * (other - each))) for other in cosines[prompts:]) for each in cosines[:prompts]
    ]


def scan_all(kernels, given_scene: Scene, layer, parts: int, prompts: int, threshold: float):
    """Scan a scene in some blocks: how many have the layer, centres, best scores and whose they are, extents and sums."""
    device, count = given_scene.device, len(given_scene.alive)
    keys = torch.where(torch.tensor(given_scene.alive), pack(torch.tensor(given_scene.coordinates)), EMPTY).to(device)
    extents = no_extents(device)
    zeros = partial(torch.zeros, dtype=torch.int64, device=device)
    sums = None if layer is None else ScoreSums(zeros(len(ID_OF_ROW)), zeros((len(ID_OF_ROW), prompts)))
    found, centers, best, which = 0, [], [], []
    for part in np.array_split(np.arange(count), parts):
        first, end = (int(part[0]), int(part[-1]) + 1) if len(part) else (0, 0)
        rows = torch.tensor(given_scene.dense_rows[first:end].astype(np.int32), device=device)
        block = SlotBlock(first=first, keys=keys[first:end], dense_rows=rows, voxel_size_m=SIZE_M)
        empty = partial(torch.empty, device=device)
        room = ScoredVoxels(empty((len(rows), 3)), empty(len(rows)), empty(len(rows), dtype=torch.int32))
        have, kept = kernels.scan(block, given_scene.hypotheses, extents, layer, sums, threshold, room)
        found += have
        centers.append(room.centers_m[:kept].cpu().numpy())
        best.append(room.best[:kept].cpu().numpy())
        which.append(room.which[:kept].cpu().numpy())
    return found, np.concatenate(centers), np.concatenate(best), np.concatenate(which), extents, sums


def layer_of(kind: str, given_scene: Scene, texts: Texts, scores_of_row: np.ndarray, ratio: float):
    if kind == "nothing":
        return None
    if kind == "inherited":
        return InheritedLayer(torch.tensor(scores_of_row, device=given_scene.device))
    weights = torch.tensor(given_scene.weights, device=given_scene.device)
    return EmbeddedLayer(given_scene.pool, weights, given_scene.own if kind == "fused" else None, ratio, texts)


def check_extents(extents: Extents, given_scene: Scene) -> None:
    tops = given_scene.tops()
    owners, counts = (np.array([top[axis] for top in tops], np.int64) for axis in (0, 1))
    for row in range(len(ID_OF_ROW)):
        mine = owners == row
        coordinates = given_scene.coordinates[mine]
        assert extents.voxels[row] == mine.sum()
        assert extents.counts[row] == counts[mine].sum()
        assert extents.sums[row].tolist() == (counts[mine, None] * coordinates).sum(axis=0).tolist()
        assert extents.low[row].tolist() == (coordinates.min(axis=0).tolist() if mine.any() else [2**62] * 3)
        assert extents.high[row].tolist() == (coordinates.max(axis=0).tolist() if mine.any() else [-(2**62)] * 3)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("kind", LAYERS)
def test_a_scan_says_what_plain_loops_say(backend, kind: str, dtype: str):
    kernels, device = backend

    @settings(max_examples=25)
    @given(
        st.integers(0, 2**32 - 1),
        st.integers(0, 60),
        st.integers(1, 3),
        st.integers(1, 20),
        st.integers(1, 6),
        st.integers(0, 2),
        st.sampled_from([-math.inf, 0.1, 2.0]),
        st.sampled_from([0.0, 0.5, 5.0]),
    )
    def check(seed, count, parts, width, prompts, negatives, threshold, ratio):
        rng = np.random.default_rng(seed)
        given_scene = scene(rng, count, width, dtype, device)
        vectors = unit(rng, prompts + negatives, width).astype(np.float32)
        texts = Texts(torch.tensor(vectors, device=device), prompts, 3.0)
        scores_of_row = rng.uniform(-1, 1, (len(ID_OF_ROW), prompts)).astype(np.float32)
        layer = layer_of(kind, given_scene, texts, scores_of_row, ratio)
        found, centers, best, which, extents, sums = scan_all(kernels, given_scene, layer, parts, prompts, threshold)

        check_extents(extents, given_scene)
        tops = given_scene.tops()
        expected = {}
        for slot, top in enumerate(tops if kind != "nothing" else []):
            if kind == "inherited":
                if top[0] >= 0:
                    expected[slot] = scores_of_row[top[0]].tolist()
                continue
            embedding = given_scene.embedding(slot, kind, top, ratio)
            if embedding is not None:
                expected[slot] = score(embedding, vectors.astype(np.float64), prompts, 3.0)
        assert found == len(expected)
        # Directions of what nearly cancels out keep few digits.
        atol = 3e-5 if width > 3 else 1e-3
        highest = {slot: max(each) for slot, each in expected.items()}
        clear = all(abs(each - threshold) > atol for each in highest.values())
        if clear:
            kept = [slot for slot, each in highest.items() if each >= threshold]
            exact = [(given_scene.coordinates[slot] + 0.5) * SIZE_M for slot in kept]
            np.testing.assert_array_equal(centers, np.array(exact, np.float32).reshape(-1, 3))
            np.testing.assert_allclose(best, [highest[slot] for slot in kept], atol=atol)
            chosen = [expected[slot][prompt] for slot, prompt in zip(kept, which.tolist(), strict=True)]
            np.testing.assert_allclose(chosen, [highest[slot] for slot in kept], atol=2 * atol)
        if sums is None:
            return
        for row in range(len(ID_OF_ROW)):
            mine = [each for slot, each in expected.items() if tops[slot][0] == row]
            assert sums.members[row] == len(mine)
            got = sums.totals[row].cpu().numpy() / SCORE_UNIT
            np.testing.assert_allclose(got, np.sum(mine, axis=0) if mine else 0.0, atol=atol * max(len(mine), 1))

    check()


@pytest.mark.parametrize("kind", LAYERS)
def test_scans_do_not_depend_on_the_number_of_threads_nor_compiled_ones_on_blocks(backend, kind: str):
    kernels, device = backend
    # Torch multiplies matrices of another size in another order.
    ways = ((1, 1), (2, 1), (2, 1 if isinstance(kernels, TorchKernels) else 7))
    rng = np.random.default_rng(5)
    given_scene = scene(rng, 20_000, 9, "float16", device)
    texts = Texts(torch.tensor(unit(rng, 3, 9), dtype=torch.float32, device=device), 2, 3.0)
    scores_of_row = rng.uniform(-1, 1, (len(ID_OF_ROW), 2)).astype(np.float32)
    layer = layer_of(kind, given_scene, texts, scores_of_row, 1.0)
    before, results = torch.get_num_threads(), []
    try:
        for threads, parts in ways:
            torch.set_num_threads(threads)
            found, centers, best, which, extents, sums = scan_all(kernels, given_scene, layer, parts, 2, 0.3)
            arrays = [centers, best, which, *(each.cpu().numpy() for each in vars(extents).values())]
            arrays += [] if sums is None else [sums.members.cpu().numpy(), sums.totals.cpu().numpy()]
            results.append((found, [each.tobytes() for each in arrays]))
    finally:
        torch.set_num_threads(before)
    assert results[0] == results[1] == results[2]
    if kind != "nothing":
        assert 0 < len(centers) < found
    check_extents(extents, given_scene)


@pytest.mark.parametrize("asked", [True, False])
def test_of_equal_scores_the_first_prompt_has_the_best(backend, asked: bool):
    kernels, device = backend
    given_scene = scene(np.random.default_rng(7), 200, 4, "float32", device)
    scores_of_row = np.array([[0, 1, 1], [9, 9, 9], [2, 2, 0], [0, 0, 0], [-3, -4, -3]], np.float32) / 10
    layer = layer_of("inherited", given_scene, Texts(torch.ones((3, 4), device=device), 3, 1.0), scores_of_row, 1.0)
    if asked:
        _, _, best, which, _, _ = scan_all(kernels, given_scene, layer, 2, 3, -math.inf)
        tops = [row for row, _ in given_scene.tops() if row >= 0]
        assert set(tops) == set(ALIVE)
        assert which.tolist() == [{0: 1, 2: 0, 3: 0, 4: 0}[row] for row in tops]
        assert best.tolist() == [float(scores_of_row[row].max()) for row in tops]
        return
    zeros = partial(torch.zeros, dtype=torch.int64, device=device)
    keys = torch.where(torch.tensor(given_scene.alive), pack(torch.tensor(given_scene.coordinates)), EMPTY).to(device)
    block = SlotBlock(0, keys, torch.full((200,), -1, dtype=torch.int32, device=device), SIZE_M)
    room = ScoredVoxels(torch.empty((200, 3), device=device), torch.empty(200, device=device))
    sums = ScoreSums(zeros(len(ID_OF_ROW)), zeros((len(ID_OF_ROW), 3)))
    found, kept = kernels.scan(block, given_scene.hypotheses, no_extents(device), layer, sums, -math.inf, room)
    assert found == kept == sum(row >= 0 for row, _ in given_scene.tops())
    assert room.which is None


def test_opposites_that_cancel_out_keep_their_direction(backend):
    """w f + lambda c g, f and g nearly opposite: what is left decides the cosine, not the rounding of large numbers."""
    kernels, device = backend
    width = 64
    along, across = np.eye(width)[0], np.eye(width)[1]
    for rest in (0.0, 1e-3, 0.03, 0.3):
        given_scene = Scene(
            device,
            np.zeros((1, 3), np.int64),
            np.array([True]),
            np.array([0]),
            [{0: 1}],
            columns([{0: 1}], 3, ID_OF_ROW, device, np.random.default_rng(0)),
            pool_of((along + rest * across)[None], "float32", device),
            pool_of(np.tile(-along, (len(ID_OF_ROW), 1)), "float32", device),
            np.ones(1, np.float32),
        )
        texts = Texts(torch.tensor(np.stack([across, along]), dtype=torch.float32, device=device), 2, 1.0)
        for number, expected in ((0, 1.0 if rest else 0.0), (1, 0.0)):
            one = Texts(texts.vectors[number : number + 1], 1, 1.0)
            layer = layer_of("fused", given_scene, one, np.zeros((5, 1), np.float32), 1.0)
            _, _, best, _, _, _ = scan_all(kernels, given_scene, layer, 1, 1, -math.inf)
            np.testing.assert_allclose(best, [expected], atol=1e-4)


def test_a_map_without_instances_can_be_scanned(backend):
    kernels, device = backend
    held = columns([{}, {}], 3, [], device, np.random.default_rng(0))
    keys = pack(torch.tensor([[0, 0, 0], [1, 2, 3]])).to(device)
    block = SlotBlock(0, keys, torch.tensor([-1, 0], dtype=torch.int32, device=device), SIZE_M)
    zeros = partial(torch.zeros, dtype=torch.int64, device=device)
    extents = Extents(zeros(0), zeros(0), zeros((0, 3)), zeros((0, 3)), zeros((0, 3)))
    texts = Texts(torch.ones((1, 4), device=device) / 2, 1, 1.0)
    pool = pool_of(np.ones((1, 4)) / 2, "float16", device)
    layer = EmbeddedLayer(pool, torch.ones(1, device=device), RowPool(4, torch.float32, device), 1.0, texts)
    room = ScoredVoxels(torch.empty((2, 3), device=device), torch.empty(2, device=device))
    sums = ScoreSums(zeros(0), zeros((0, 1)))
    assert kernels.scan(block, held, extents, layer, sums, -math.inf, room) == (1, 1)
    np.testing.assert_allclose(room.best[:1].tolist(), [1.0], atol=1e-6)
    np.testing.assert_allclose(room.centers_m[0].tolist(), [0.375, 0.625, 0.875])
