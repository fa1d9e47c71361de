"""The memory budget: its rules on a map of plain numbers, and whole drives of the real map against one without a budget."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from reference.variants import BACKEND_IDS, BACKENDS, DTYPES

from fus3dmaps_core.config.schema import MapConfig
from fus3dmaps_core.voxel_map.budget import KeyframeBound, MemoryBudget, MemoryUse
from fus3dmaps_core.voxel_map.layer_query import LayerQuery
from fus3dmaps_core.voxel_map.layers.similarity import LAYERS
from fus3dmaps_core.voxel_map.semantic_map import SemanticMap

MIB = 2**20
CENTER_M = np.zeros(3)


@dataclass
class PlainMap:
    """A map of dense voxels at known distances; a block is a MiB of ten of them, and nothing grows but by ``growth_mib``."""

    distances_m: list[float] = field(default_factory=list)
    window_radius_m: float = 0.0
    lasting_mib: int = 0
    growth_mib: int = 0
    blocks: int = 0
    calls: list[str] = field(default_factory=list)

    def add(self, *distances_m: float) -> None:
        self.distances_m += distances_m
        self.blocks = max(self.blocks, -(-len(self.distances_m) // 10))

    def memory_use(self, bound: KeyframeBound) -> MemoryUse:
        return MemoryUse(
            allocated=(self.lasting_mib + self.blocks) * MIB,
            lasting=self.lasting_mib * MIB,
            lasting_next=(self.lasting_mib + self.growth_mib) * MIB,
            dense_voxels=len(self.distances_m),
            new_dense_voxels=bound.dense_voxels,
            dense_rows=10 * self.blocks,
            block_rows=10,
            block_bytes=MIB,
        )

    def set_window_radius(self, radius_m: float) -> None:
        self.calls.append("radius")
        self.window_radius_m = radius_m

    def prune_window(self, center_m: np.ndarray) -> int:
        kept = [each for each in self.distances_m if each <= self.window_radius_m]
        dropped, self.distances_m = len(self.distances_m) - len(kept), kept
        return dropped

    def drop_least_observed(self, count: int) -> int:
        self.calls.append("drop")
        self.distances_m = self.distances_m[count:]
        return count

    def release_unused(self) -> int:
        before, self.blocks = self.blocks, -(-len(self.distances_m) // 10)
        return (before - self.blocks) * MIB


def budget_of(mib: float, radius_m: float = 0.0, voxel_size_m: float = 0.05, dense_voxels: int = 20) -> MemoryBudget:
    return MemoryBudget(mib, radius_m, voxel_size_m, KeyframeBound(40, dense_voxels, 5))


def test_far_from_the_budget_or_without_one_nothing_happens():
    plain = PlainMap()
    plain.add(*[1.0] * 700)
    for mib in (0.0, 1000.0, 90.0):
        assert budget_of(mib).make_room(plain, CENTER_M) == 0
    assert (len(plain.distances_m), plain.blocks, plain.calls) == (700, 70, [])


def test_least_observed_voxels_go_until_four_fifths_are_taken():
    plain = PlainMap(lasting_mib=10)
    plain.add(*[1.0] * 850)
    assert budget_of(100.0).make_room(plain, CENTER_M) == 150  # 70 blocks beside the 10 that stay.
    assert plain.blocks == 70
    assert budget_of(100.0).make_room(plain, CENTER_M) == 0


def test_memory_that_nothing_is_in_is_given_back_before_anything_is_dropped(caplog: pytest.LogCaptureFixture):
    plain = PlainMap()
    plain.add(*[1.0] * 950)
    plain.distances_m = plain.distances_m[:600]
    with caplog.at_level(logging.WARNING):
        assert budget_of(100.0).make_room(plain, CENTER_M) == 0
    assert (plain.blocks, len(plain.distances_m), caplog.records) == (60, 600, [])


def test_room_is_made_for_all_that_the_next_keyframe_may_bring():
    plain = PlainMap()
    plain.add(*[1.0] * 600)
    budget = budget_of(100.0, dense_voxels=350)
    assert budget.make_room(plain, CENTER_M) == 0
    plain.growth_mib = 30  # A column is about to double.
    assert budget.make_room(plain, CENTER_M) > 0
    assert plain.blocks + 35 + plain.growth_mib <= 100
    # Not below what one keyframe can bring.
    plain.growth_mib = 70
    budget.make_room(plain, CENTER_M)
    assert len(plain.distances_m) == 350


def test_the_window_shrinks_first_and_no_farther_than_it_must():
    plain = PlainMap(window_radius_m=6.0)
    plain.add(*np.linspace(0.0, 6.0, 950))
    budget = budget_of(100.0, radius_m=6.0)
    dropped = budget.make_room(plain, CENTER_M)
    assert "drop" not in plain.calls
    assert plain.window_radius_m == pytest.approx(0.85 * 6.0)
    assert dropped == 950 - len(plain.distances_m)
    assert max(plain.distances_m) <= plain.window_radius_m
    assert plain.blocks <= 90


@pytest.mark.parametrize(
    ("radius_m", "voxel_size_m", "least_m"), [(6.0, 0.05, 1.0), (6.0, 0.1, 2.0), (0.7, 0.05, 0.7), (3.0, 1.0, 3.0)]
)
def test_a_window_that_does_not_suffice_stays_at_its_least(radius_m: float, voxel_size_m: float, least_m: float):
    plain = PlainMap(window_radius_m=radius_m)
    plain.add(*[0.1] * 950)
    assert budget_of(100.0, radius_m, voxel_size_m).make_room(plain, CENTER_M) == 150
    assert plain.window_radius_m == least_m


def test_the_window_grows_back_slowly_while_there_is_room():
    plain = PlainMap(window_radius_m=6.0)
    plain.add(*np.linspace(0.0, 6.0, 1800))
    budget = budget_of(100.0, radius_m=6.0)
    budget.make_room(plain, CENTER_M)
    small_m = plain.window_radius_m
    assert small_m < 4.0
    budget.make_room(plain, CENTER_M)
    assert plain.window_radius_m == small_m, "between the bounds the window stays as it is"
    plain.distances_m, plain.blocks = plain.distances_m[:300], 30
    radii = []
    for _ in range(30):
        assert budget.make_room(plain, CENTER_M) == 0
        radii.append(plain.window_radius_m)
    assert radii[0] == pytest.approx(1.05 * small_m)
    assert radii == sorted(radii)
    assert radii[-1] == 6.0


def test_an_episode_is_warned_of_once_with_its_numbers(caplog: pytest.LogCaptureFixture):
    plain, budget = PlainMap(lasting_mib=10), budget_of(100.0)
    with caplog.at_level(logging.WARNING):
        for _ in range(5):
            plain.add(*[1.0] * 150)
            budget.make_room(plain, CENTER_M)
        assert plain.calls.count("drop") == 0
        for _ in range(5):
            plain.add(*[1.0] * 150)
            budget.make_room(plain, CENTER_M)
    assert plain.calls.count("drop") > 1
    (record,) = caplog.records
    for part in ("map.memory_budget_mib", "100.0 MiB", "the map takes", "of the least observed", "80.0 MiB now"):
        assert part in record.getMessage()
    plain.distances_m, plain.blocks = [], 0
    budget.make_room(plain, CENTER_M)
    with caplog.at_level(logging.WARNING):
        plain.add(*[1.0] * 900)
        budget.make_room(plain, CENTER_M)
    assert len(caplog.records) == 2


def test_what_cannot_be_dropped_is_named_when_it_alone_is_too_much(caplog: pytest.LogCaptureFixture):
    plain, budget = PlainMap(lasting_mib=120), budget_of(100.0)
    with caplog.at_level(logging.WARNING):
        for _ in range(5):
            plain.add(*[1.0] * 20)
            budget.make_room(plain, CENTER_M)
            assert len(plain.distances_m) == 20, "held at what a keyframe brings"
    (message,) = [record.getMessage() for record in caplog.records if "too little" in record.getMessage()]
    assert "120.0 MiB" in message
    assert "held at 20 voxels" in message


@settings(max_examples=200)
@given(
    st.lists(st.integers(0, 200), min_size=1, max_size=30),
    st.floats(20.0, 120.0),
    st.integers(0, 12),
    st.sampled_from([0.0, 5.0]),
    st.integers(0, 2**32 - 1),
)
def test_the_budget_holds_wherever_what_stays_leaves_room(frames, mib: float, lasting_mib: int, radius_m: float, seed: int):
    """Room for the largest keyframe and one of as many voxels, which are never taken away: two times 20 blocks at most."""
    rng = np.random.default_rng(seed)
    plain = PlainMap(lasting_mib=lasting_mib, window_radius_m=radius_m)
    budget = budget_of(mib, radius_m, dense_voxels=200)
    for count in frames:
        budget.make_room(plain, CENTER_M)
        plain.add(*rng.uniform(0.0, 6.0, count))
        assert plain.lasting_mib + plain.blocks <= max(mib, lasting_mib + 40 + 1)


# ---- drives of the real map

DIMENSION = 128
BOUND = KeyframeBound(voxels=1200, dense_voxels=800, instances=4)
KEYFRAMES = 90


def keyframe(number: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where a camera that goes along x is, points of the wall beside it, and the object that is on it: (n,) ids."""
    rng = np.random.default_rng(number)
    camera_m = np.array([0.4 * number, 0.0, 0.0])
    points_m = camera_m + rng.uniform([-1.0, 1.0, -1.0], [1.0, 1.2, 1.0], (800, 3))
    return camera_m, points_m, np.floor(points_m[:, 0] / 0.8).astype(np.int64)


def embedding_of(objects: np.ndarray) -> np.ndarray:
    return np.stack([np.random.default_rng([7, 1000 + int(each)]).normal(size=DIMENSION) for each in objects])


class Drive:
    """A map along a wall of objects, with a budget or without."""

    def __init__(self, mib: float, window_radius_m: float, **values) -> None:
        config = MapConfig(memory_budget_mib=mib, **values)
        self.map = SemanticMap(DIMENSION, config, 1.0, window_radius_m)
        self.budget = MemoryBudget(mib, window_radius_m, config.voxel_size_m, BOUND)
        self.dropped = 0

    def go(self, number: int) -> None:
        camera_m, points_m, objects = keyframe(number)
        self.dropped += self.budget.make_room(self.map, camera_m)
        expected = self.map.memory_use(BOUND)
        seen, patches = np.unique(objects, return_inverse=True)
        embeddings, colors = embedding_of(seen), np.zeros((len(points_m), 3), np.uint8)
        self.map.integrate_dense(points_m, patches, embeddings, np.ones(len(seen)), colors)
        self.map.integrate_proposals(points_m[::2], patches[::2], embeddings)
        assert self.map.memory_use(BOUND).lasting <= expected.lasting_next
        assert self.allocated <= expected.after_next()
        self.map.prune_window(camera_m)
        if number % 5 == 4:
            self.map.fuse()

    @property
    def allocated(self) -> int:
        return sum(self.map.nbytes().values())


@pytest.mark.parametrize("window_radius_m", [0.0, 12.0])
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize(("backend", "device"), BACKENDS, ids=BACKEND_IDS)
def test_a_long_drive_keeps_within_the_budget(backend: str, device: str, dtype: str, window_radius_m: float):
    values = {"dtype": dtype, "backend": backend, "device": device}
    free = Drive(0.0, window_radius_m, **values)
    for number in range(KEYFRAMES):
        free.go(number)
    use = free.map.memory_use(BOUND)
    # What stays, and half of the dense layer; on a GPU that would be less than the block that any dense layer takes.
    mib = (use.lasting_next + max(0.45 * (use.allocated - use.lasting), 2 * use.block_bytes)) / MIB
    assert device == "cuda" or mib < 0.9 * free.allocated / MIB
    bound = Drive(mib, window_radius_m, **values)
    for number in range(KEYFRAMES):
        bound.go(number)
        assert bound.allocated <= mib * MIB
        if number % 10 == 9:
            _, _, objects = keyframe(number)
            for layer in LAYERS:
                finding = bound.map.search(LayerQuery(layer, embedding_of(objects[:1]).astype(np.float32), min_voxels=4))
                if layer == "dense":
                    assert finding.voxels == bound.map.dense_voxel_count > 0
                _, scores = finding.best[0]
                assert scores[0] > 0.8, "what the camera sees is found"
    if device == "cpu":
        assert bound.dropped > 800
    # Instances and hypotheses are what they would be without a budget.
    mine, full = bound.map.export_state(), free.map.export_state()
    assert bound.map.instance_count > 30
    for name in full:
        if name.startswith(("instance", "hypothesis", "voxel", "next")):
            assert mine[name].tobytes() == full[name].tobytes(), name


def test_a_budget_that_even_objects_exceed_keeps_mapping_them(caplog: pytest.LogCaptureFixture):
    free, bound = Drive(0.0, 0.0), Drive(1.0, 0.0)
    with caplog.at_level(logging.WARNING):
        for number in range(40):
            free.go(number)
            bound.go(number)
            assert bound.map.dense_voxel_count <= 2 * BOUND.dense_voxels
    assert bound.map.instance_count == free.map.instance_count > 10
    assert len(caplog.records) == 2
    assert all("map.memory_budget_mib" in record.getMessage() for record in caplog.records)


@pytest.mark.parametrize(("backend", "device"), BACKENDS, ids=BACKEND_IDS)
@settings(max_examples=30)
@given(st.data())
def test_what_a_keyframe_can_take_is_foreseen(backend: str, device: str, data: st.DataObject):
    """Maps grow no more than was said, whatever their columns, tables and blocks are about to do."""
    dtype, radius_m = data.draw(st.sampled_from(DTYPES)), data.draw(st.sampled_from([0.0, 2.0]))
    semantic_map = SemanticMap(4, MapConfig(dtype=dtype, backend=backend, device=device), 1.0, radius_m)
    rng = np.random.default_rng(data.draw(st.integers(0, 2**32 - 1)))
    for dense, proposals in data.draw(
        st.lists(st.tuples(st.integers(0, 1500), st.integers(0, 400)), min_size=1, max_size=6), label="frames"
    ):
        # Dense points and, elsewhere, one voxel for each proposal.
        expected = semantic_map.memory_use(KeyframeBound(dense + proposals, dense, proposals))
        cells = rng.permutation(40**3)[: dense + proposals]
        points_m = (np.stack(np.unravel_index(cells, (40, 40, 40)), 1) + 0.5) * 0.05
        semantic_map.integrate_dense(
            points_m[:dense], np.zeros(dense, int), np.ones((1, 4)), np.ones(1), np.zeros((dense, 3), np.uint8)
        )
        semantic_map.integrate_proposals(points_m[dense:], np.arange(proposals), np.ones((proposals, 4)))
        use = semantic_map.memory_use(KeyframeBound(0, 0, 0))
        assert use.lasting <= expected.lasting_next
        assert use.allocated <= expected.after_next()
        if rng.random() < 0.3:
            semantic_map.drop_least_observed(int(rng.integers(0, 1000)))
        if rng.random() < 0.3:
            semantic_map.release_unused()
