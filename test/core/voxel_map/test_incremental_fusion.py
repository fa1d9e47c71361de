"""Incremental fusion: the bytes of a full one, for less work."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from reference.agreement import assert_same_bytes, engine_of
from reference.steps import FuseStep, RemoveStep, Setting, WindowStep, random_steps, sequences
from reference.variants import BACKEND_IDS, BACKENDS, DTYPES

from fus3dmaps_core.config.schema import MapConfig
from fus3dmaps_core.voxel_map.layer_query import LayerQuery
from fus3dmaps_core.voxel_map.layers.similarity import LAYERS
from fus3dmaps_core.voxel_map.semantic_map import SemanticMap

SIZE_M = 0.5
X, Y, Z = np.eye(3)
FAR = np.array([1e3, 0.0, 0.0])

on_every_backend = pytest.mark.parametrize(("backend", "device"), BACKENDS, ids=BACKEND_IDS)
in_every_dtype = pytest.mark.parametrize("dtype", DTYPES)


def ask(engine: SemanticMap) -> None:
    """A query of every layer: it may compute what the next fusion would, but must not show in what is stored."""
    for layer in LAYERS:
        engine.search(LayerQuery(layer, np.eye(1, engine.dimension, dtype=np.float32)))


@on_every_backend
@in_every_dtype
def test_fusing_what_changed_stores_what_fusing_everything_stores(dtype: str, backend: str, device: str):
    @settings(max_examples=20)
    @given(sequences(dtype=dtype, backend=backend, device=device), st.integers(0, 2**12 - 1))
    def check(sequence, asked):
        setting, steps = sequence
        incremental, full = engine_of(setting), engine_of(setting)
        for number, step in enumerate(steps):
            if isinstance(step, FuseStep):
                assert incremental.fuse().updated == full.fuse(full=True).updated
                assert_same_bytes(incremental.export_state(), full.export_state())
            else:
                step.apply(incremental)
                step.apply(full)
            if asked >> number & 1:
                ask(incremental)
        assert incremental.fuse().updated == full.fuse(full=True).updated
        assert_same_bytes(incremental.export_state(), full.export_state())

    check()


@on_every_backend
@in_every_dtype
def test_without_a_window_fusing_along_the_way_stores_what_fusing_once_does(dtype: str, backend: str, device: str):
    @settings(max_examples=10)
    @given(sequences(dtype=dtype, backend=backend, device=device, window_radius_m=0.0, max_steps=8))
    def check(sequence):
        setting, steps = sequence
        once, often = engine_of(setting), engine_of(setting)
        for step in steps:
            if not isinstance(step, FuseStep):
                step.apply(once)
                step.apply(often)
            often.fuse()
        once.fuse(full=True)
        assert_same_bytes(once.export_state(), often.export_state())

    check()


@on_every_backend
@pytest.mark.parametrize("window_radius_m", [0.0, 0.16])
def test_over_a_long_walk_with_removals_and_a_moving_window(window_radius_m: float, backend: str, device: str):
    setting = Setting(max_hypotheses=2, window_radius_m=window_radius_m, dtype="float16", backend=backend, device=device)
    incremental, full = engine_of(setting), engine_of(setting)
    steps = random_steps(setting, extent=3, count=150, seed=21)
    assert {RemoveStep, WindowStep, FuseStep} <= {type(step) for step in steps}
    for step in steps:
        step.apply(incremental)
        if isinstance(step, FuseStep):
            replace(step, full=True).apply(full)
        else:
            step.apply(full)
    assert_same_bytes(incremental.export_state(), full.export_state())


def points(numbers) -> np.ndarray:
    return np.array([[(number + 0.5) * SIZE_M, 0.1, 0.1] for number in numbers]).reshape(-1, 3)


def see(semantic_map: SemanticMap, numbers, embedding=X, weight: float = 1.0) -> None:
    count = len(numbers)
    semantic_map.integrate_dense(
        points(numbers), np.zeros(count, int), np.array([embedding]), np.array([weight]), np.zeros((count, 3), np.uint8)
    )


def propose(semantic_map: SemanticMap, numbers, embedding=X) -> int:
    return int(semantic_map.integrate_proposals(points(numbers), np.zeros(len(numbers), int), np.array([embedding]))[0])


@pytest.fixture(params=BACKENDS, ids=BACKEND_IDS)
def three_objects(request) -> SemanticMap:
    """Instances 0, 1 and 2 in voxels 0 .. 3, 10 .. 13 and 20 .. 23, seen by both layers and fused; a window of 20 m."""
    backend, device = request.param
    semantic_map = SemanticMap(3, MapConfig(voxel_size_m=SIZE_M, backend=backend, device=device), 1.0, 20.0)
    for number in range(3):
        see(semantic_map, range(10 * number, 10 * number + 4))
        assert propose(semantic_map, range(10 * number, 10 * number + 4), Y) == number
    assert semantic_map.fuse().recomputed == 3
    return semantic_map


def test_nothing_is_computed_where_nothing_changed(three_objects: SemanticMap):
    before = three_objects.export_state()
    assert three_objects.fuse().recomputed == 0
    see(three_objects, [100, 101])  # Voxels of no instance.
    see(three_objects, [0, 10], weight=0.0)  # Says nothing.
    assert three_objects.prune_window(np.zeros(3)) == 2  # The two that nobody holds.
    assert three_objects.remove_voxels(points([100])) == 1
    report = three_objects.fuse()
    assert (report.instances, report.updated, report.recomputed) == (3, 0, 0)
    after = three_objects.export_state()
    assert all(before[name].tobytes() == after[name].tobytes() for name in before if name.startswith("fused"))


def test_a_full_fusion_computes_every_instance(three_objects: SemanticMap):
    assert three_objects.fuse(full=True).recomputed == 3
    assert three_objects.fuse().recomputed == 0


def test_an_observation_makes_the_instances_of_its_voxels_be_computed(three_objects: SemanticMap):
    see(three_objects, [0, 1, 21, 22])
    assert three_objects.fuse().recomputed == 2


def test_a_match_makes_its_instance_be_computed(three_objects: SemanticMap):
    assert propose(three_objects, [10, 11, 12, 13]) == 1
    assert three_objects.fuse().recomputed == 1


def test_a_new_instance_is_computed_and_those_it_shares_voxels_with_are_not(three_objects: SemanticMap):
    assert propose(three_objects, [3, 30, 31, 32, 33, 34]) == 3
    assert three_objects.fuse().recomputed == 1


def test_those_whose_hypotheses_were_displaced_are_computed():
    semantic_map = SemanticMap(3, MapConfig(voxel_size_m=SIZE_M, max_hypotheses=1), 1.0)
    for first in (0, 10):
        propose(semantic_map, range(first, first + 4))
    semantic_map.fuse()
    assert propose(semantic_map, [3, *range(30, 36)]) == 2
    report = semantic_map.fuse()
    assert (report.instances, report.recomputed) == (3, 2)


def test_a_window_that_drops_their_voxels_makes_instances_be_computed(three_objects: SemanticMap):
    # 20 m from the centre of voxel 51: voxels below 11 are farther.
    assert three_objects.prune_window(np.array([25.75, 0.25, 0.25])) == 5
    report = three_objects.fuse()
    assert (report.updated, report.recomputed) == (0, 2)


def test_a_removal_makes_those_that_lose_a_voxel_be_computed_but_not_the_dead(three_objects: SemanticMap):
    assert three_objects.remove_voxels(points([0, 10, 11, 12, 13])) == 5
    report = three_objects.fuse()
    assert (report.instances, report.recomputed) == (2, 1)


def test_an_imported_map_is_computed_once(three_objects: SemanticMap):
    three_objects.import_state(three_objects.export_state())
    assert three_objects.fuse().recomputed == 3
    assert three_objects.fuse().recomputed == 0


def test_what_a_query_has_computed_is_not_computed_again_but_stored():
    semantic_map = SemanticMap(3, MapConfig(voxel_size_m=SIZE_M), 1.0)
    propose(semantic_map, range(4), Y)
    see(semantic_map, range(4), X)
    ask(semantic_map)
    assert semantic_map.export_state()["fused_evidence"].tolist() == [0.0]
    report = semantic_map.fuse()
    assert (report.updated, report.recomputed) == (1, 0)
    state = semantic_map.export_state()
    assert state["fused_evidence"].tolist() == [8.0]
    np.testing.assert_allclose(state["fused_embedding"], [(X + Y) / 2], atol=1e-6)
