"""The map against the plain reference over whole random sequences, and what it refuses."""

from __future__ import annotations

import itertools
import threading
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import event, given, settings
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
from reference.steps import (
    DropStep,
    FuseStep,
    ReleaseStep,
    Setting,
    dense_step,
    embeddings_of,
    proposal_step,
    random_box,
    random_steps,
    sequences,
)
from reference.variants import BACKEND_IDS, BACKENDS, DTYPES

from fus3dmaps_core.answers.query import TextQuery
from fus3dmaps_core.config.schema import MapConfig
from fus3dmaps_core.errors import MapError
from fus3dmaps_core.voxel_map.layers.similarity import LAYERS
from fus3dmaps_core.voxel_map.semantic_map import SemanticMap

on_every_backend = pytest.mark.parametrize(("backend", "device"), BACKENDS, ids=BACKEND_IDS)
in_every_dtype = pytest.mark.parametrize("dtype", DTYPES)


def ask_everything(engine, reference, setting: Setting, seed: int) -> None:
    """Every layer, with and without negatives and thresholds."""
    rng = np.random.default_rng(seed)
    names = ["lamp", "mug", "floor", "wall"]
    texts = KnownTexts(dict(zip(names, embeddings_of(4, setting.dimension, rng), strict=True)))
    for layer, negatives in itertools.product(LAYERS, [(), ("floor", "wall")]):
        threshold = None if rng.random() < 0.5 else float(rng.uniform(0.2, 0.8))
        query = TextQuery(
            prompts=names[: int(rng.integers(1, 3))],
            negative_prompts=negatives,
            layer=layer,
            threshold=threshold,
            top_k=int(rng.integers(1, 6)),
            min_voxels=int(rng.integers(1, 4)),
        )
        assert_same_answer(engine, reference, setting, query, texts, logit_scale=10.0)


@on_every_backend
@in_every_dtype
def test_agrees_with_the_reference_after_every_step(dtype: str, backend: str, device: str):
    @settings(max_examples=30)
    @given(sequences(dtype=dtype, backend=backend, device=device), st.integers(0, 1000))
    def check(sequence, seed):
        setting, steps = sequence
        engine, reference = engine_of(setting), reference_of(setting)
        for step in steps:
            apply_to_both(step, engine, reference)
            assert_same_map(engine, reference, setting)
        ask_everything(engine, reference, setting, seed)
        assert_same_map(engine, reference, setting)
        for branch in reference.seen:
            event(branch)

    check()


@on_every_backend
@pytest.mark.parametrize(
    "setting",
    [
        Setting(),
        Setting(window_radius_m=0.16, variance_ratio=5.0),
        Setting(max_hypotheses=1, window_radius_m=0.12, voxel_size_m=0.07, dtype="int8"),
        Setting(max_hypotheses=2, iou_threshold=0.5, variance_ratio=0.25, dtype="float16", window_radius_m=0.16),
    ],
    ids=["full", "window", "one-hypothesis", "half-precision"],
)
def test_agrees_with_the_reference_over_a_long_walk_that_takes_every_branch(setting: Setting, backend: str, device: str):
    setting = replace(setting, backend=backend, device=device)
    engine, reference = engine_of(setting), reference_of(setting)
    for number, step in enumerate(random_steps(setting, extent=3, count=140, seed=32)):
        apply_to_both(step, engine, reference)
        if number % 4 == 3:
            assert_same_map(engine, reference, setting)
        if number % 40 == 39:
            ask_everything(engine, reference, setting, number)
    often = {"dense_new", "dense_again", "instance_new", "instance_match", "overlap_too_small"}
    often |= {"hypothesis_pruned", "instance_deleted", "fusion_replaced", "dense_weightless"}
    sometimes = {"match_tie", "proposal_without_point", "removed_dense", "removed_hypotheses", "instance_removed"}
    if setting.window_radius_m > 0:
        often |= {"window_dropped", "dense_revisit", "fusion_kept"}
    sometimes |= {"least_observed_dropped", "least_observed_tie"}
    if setting.max_hypotheses > 1:
        often.add("hypothesis_pruned_tie")
    assert {branch: reference.seen[branch] for branch in often if reference.seen[branch] < 10} == {}
    assert {branch: reference.seen[branch] for branch in sometimes if reference.seen[branch] < 3} == {}


@on_every_backend
def test_agrees_with_the_reference_when_storage_grows_past_its_first_blocks(backend: str, device: str):
    setting = Setting(dimension=3, window_radius_m=0.45, backend=backend, device=device)
    rng = np.random.default_rng(2)
    engine, reference = engine_of(setting), reference_of(setting)
    for offset in (0, 12, 24):
        keys = [(x + offset, y - 7, z - 9) for x, y, z in np.ndindex(17, 15, 18)]
        apply_to_both(dense_step(keys, setting, rng, weightless=False), engine, reference)
        apply_to_both(proposal_step([keys[: 1 + len(keys) // 3]], setting, rng), engine, reference)
        assert engine.prune_window(np.array([offset * 0.05, 0.0, 0.0])) == reference.prune_window(
            np.array([offset * 0.05, 0.0, 0.0])
        )
        apply_to_both(FuseStep(), engine, reference)
    assert reference.seen["window_dropped"] > 4096
    assert_same_map(engine, reference, setting)
    texts = KnownTexts({"mug": np.array([0.2, 0.9, -0.1])})
    assert_same_answer(engine, reference, setting, TextQuery(["mug"], layer="fused_dense"), texts, logit_scale=1.0)


@on_every_backend
@in_every_dtype
def test_agrees_with_the_reference_when_most_of_its_storage_was_given_back(dtype: str, backend: str, device: str):
    setting = Setting(dimension=3, dtype=dtype, backend=backend, device=device)
    rng = np.random.default_rng(5)
    engine, reference = engine_of(setting), reference_of(setting)
    keys = [(x - 9, y - 7, z - 9) for x, y, z in np.ndindex(17, 15, 18)]
    seen_again = [keys[int(each)] for each in rng.integers(0, len(keys), 6000)]
    apply_to_both(dense_step(keys + seen_again, setting, rng), engine, reference)
    apply_to_both(proposal_step([keys[:200]], setting, rng), engine, reference)
    before = engine.nbytes()["dense"]
    apply_to_both(DropStep(4000), engine, reference)
    assert engine.nbytes()["dense"] >= before, "rows alone were freed, blocks stay"
    assert_same_map(engine, reference, setting)
    state = engine.export_state()
    if device == "cpu":
        assert before / 5 > engine.nbytes()["dense"] - engine.release_unused()
    ReleaseStep().apply(engine)
    assert_same_bytes(engine.export_state(), state)
    assert engine.release_unused() == 0
    apply_to_both(FuseStep(), engine, reference)
    apply_to_both(dense_step(keys[::3] + seen_again, setting, rng), engine, reference)
    apply_to_both(FuseStep(), engine, reference)
    assert_same_map(engine, reference, setting)
    ask_everything(engine, reference, setting, 5)


@on_every_backend
@in_every_dtype
def test_the_same_sequence_gives_the_same_bytes(dtype: str, backend: str, device: str):
    @settings(max_examples=10)
    @given(sequences(max_steps=8, dtype=dtype, backend=backend, device=device))
    def check(sequence):
        setting, steps = sequence
        first, second = engine_of(setting), engine_of(setting)
        for step in steps:
            step.apply(first)
            step.apply(second)
        assert_same_bytes(first.export_state(), second.export_state())

    check()


def test_reset_gives_a_map_like_a_new_one():
    setting = Setting(window_radius_m=0.16)
    used, fresh = engine_of(setting), engine_of(setting)
    for step in random_steps(setting, extent=3, count=30, seed=1):
        step.apply(used)
    used.reset()
    assert_same_bytes(used.export_state(), fresh.export_state())
    for step in random_steps(setting, extent=3, count=30, seed=2):
        step.apply(used)
        step.apply(fresh)
    assert_same_bytes(used.export_state(), fresh.export_state())


def test_an_id_is_never_given_twice():
    setting = Setting(max_hypotheses=1)
    engine = engine_of(setting)
    rng = np.random.default_rng(4)
    born: list[int] = []
    alive: set[int] = set()
    for _ in range(150):
        ids = proposal_step([random_box(3, rng)], setting, rng).apply(engine).tolist()
        born += [each for each in ids if each not in alive]
        alive = set(engine.instances().ids.tolist())
    assert len(born) > len(alive) + 20, "too few instances died for this to mean anything"
    assert len(set(born)) == len(born)
    assert born == sorted(born)


def test_without_a_window_nothing_is_pruned():
    setting = Setting()
    engine = engine_of(setting)
    dense_step([(0, 0, 0), (5, 5, 5)], setting, np.random.default_rng(0), weightless=False).apply(engine)
    before = engine.export_state()
    assert engine.prune_window(np.array([1e3, 0.0, 0.0])) == 0
    assert_same_bytes(engine.export_state(), before)


def test_the_window_drops_what_is_farther_and_keeps_the_rest():
    setting = Setting(voxel_size_m=0.5, window_radius_m=1.0)
    engine = engine_of(setting)
    rng = np.random.default_rng(0)
    dense_step([(0, 0, 0), (1, 0, 0), (2, 0, 0), (3, 0, 0)], setting, rng, weightless=False).apply(engine)
    # Centres lie at 0.25, 0.75, 1.25 and 1.75 along x; the third is exactly one radius away and so is not farther.
    assert engine.prune_window(np.array([0.25, 0.25, 0.25])) == 1
    assert engine.dense_voxel_count == 3
    assert engine.voxel_count == 4
    assert engine.prune_window(np.array([0.25, 0.25, 0.25])) == 0


def observe(engine: SemanticMap, numbers: list[int]) -> None:
    """One point in each of the voxels, which lie side by side along x and are named by their number."""
    points_m = (np.array(numbers)[:, None] * [1.0, 0.0, 0.0] + 0.5) * engine.config.voxel_size_m
    count = len(numbers)
    engine.integrate_dense(points_m, np.zeros(count, int), np.ones((1, 5)), np.ones(1), np.zeros((count, 3), np.uint8))


def observed(engine: SemanticMap) -> list[int]:
    """Numbers of the voxels with a dense embedding."""
    state = engine.export_state()
    return sorted(state["voxel_coordinates"][state["dense_slot"], 0].tolist())


@on_every_backend
def test_the_least_observed_voxels_are_dropped_the_oldest_of_equals_first(backend: str, device: str):
    engine = engine_of(Setting(backend=backend, device=device))
    for numbers in ([9], [4], [7, 4], [2], [4]):  # Seen once: 9, 7, 2 in this order; thrice: 4.
        observe(engine, numbers)
    assert engine.drop_least_observed(0) == 0
    assert engine.drop_least_observed(1) == 1
    assert observed(engine) == [2, 4, 7]
    assert engine.drop_least_observed(2) == 2
    assert observed(engine) == [4]
    observe(engine, [9, 9, 9, 9])
    assert engine.drop_least_observed(1) == 1
    assert observed(engine) == [9]
    assert engine.drop_least_observed(100) == 1
    assert (engine.dense_voxel_count, engine.voxel_count, engine.drop_least_observed(1)) == (0, 4, 0)


def test_a_negative_count_is_refused():
    engine = engine_of(Setting())
    observe(engine, [1])
    with pytest.raises(MapError, match="count"):
        engine.drop_least_observed(-1)
    assert observed(engine) == [1]


def test_the_windows_radius_can_change_until_the_map_is_emptied():
    engine = engine_of(Setting(voxel_size_m=0.5, window_radius_m=5.0))
    observe(engine, list(range(10)))
    center_m = np.array([0.25, 0.25, 0.25])
    assert engine.prune_window(center_m) == 0
    engine.set_window_radius(1.0)
    assert engine.window_radius_m == 1.0
    assert engine.prune_window(center_m) == 7
    assert observed(engine) == [0, 1, 2]
    engine.reset()
    assert engine.window_radius_m == 5.0


@pytest.mark.parametrize("radius_m", [0.0, -1.0, float("nan"), float("inf")])
def test_a_radius_that_is_none_is_refused(radius_m: float):
    engine = engine_of(Setting(window_radius_m=0.16))
    with pytest.raises(MapError, match="radius_m"):
        engine.set_window_radius(radius_m)
    assert engine.window_radius_m == 0.16


def test_a_map_without_a_window_gets_none():
    engine = engine_of(Setting())
    with pytest.raises(MapError, match="without a window"):
        engine.set_window_radius(1.0)
    assert engine.window_radius_m == 0.0


def test_points_belong_to_their_voxel_kilometres_away_and_at_its_walls():
    engine = engine_of(Setting(voxel_size_m=0.05))
    keys = np.array([[-1_000_000, -1_000_000, 1_000_000], [-1, 0, -2], [0, 0, 0], [400_000, -400_000, 3]])
    inside = np.array([0.01, 0.99, 0.5])
    engine.integrate_dense((keys + inside) * 0.05, np.zeros(4, int), np.ones((1, 5)), np.ones(1), np.zeros((4, 3), np.uint8))
    assert sorted(engine.export_state()["voxel_coordinates"].tolist()) == keys.tolist()

    # Half a metre is a power of two: points on the wall itself belong to the voxel above it, also below zero.
    engine = engine_of(Setting(voxel_size_m=0.5))
    ids = engine.integrate_proposals(np.array([[0.5, -0.5, 0.0], [-0.0, 1.0, -1.0]]), np.zeros(2, int), np.ones((1, 5)))
    assert ids.tolist() == [0]
    assert sorted(engine.export_state()["voxel_coordinates"].tolist()) == [[0, 2, -2], [1, -1, 0]]


def test_frames_without_points_change_nothing():
    setting = Setting()
    engine = engine_of(setting)
    for step in random_steps(setting, extent=2, count=10, seed=3):
        step.apply(engine)
    before = engine.export_state()
    none = np.zeros((0, 3))
    engine.integrate_dense(none, np.zeros(0, int), np.ones((4, 5)), np.ones(4), np.zeros((0, 3), np.uint8))
    engine.integrate_dense(none, np.zeros(0, int), np.zeros((0, 5)), np.zeros(0), np.zeros((0, 3), np.uint8))
    assert engine.integrate_proposals(none, np.zeros(0, int), np.ones((2, 5))).tolist() == [-1, -1]
    assert engine.integrate_proposals(none, np.zeros(0, int), np.zeros((0, 5))).tolist() == []
    assert_same_bytes(engine.export_state(), before)


def test_an_empty_map_can_be_fused_pruned_and_looked_at():
    engine = engine_of(Setting(window_radius_m=1.0))
    report = engine.fuse()
    assert (report.instances, report.updated, report.voxels) == (0, 0, 0)
    assert engine.prune_window(np.zeros(3)) == 0
    assert engine.voxels().centers_m.shape == (0, 3)
    assert engine.instances().ids.shape == (0,)


def test_readers_see_whole_frames_while_mapping_goes_on():
    """Every frame adds the same number of points to both voxels, so a reader that sees them differ saw half a frame."""
    engine = SemanticMap(4, MapConfig(), 1.0)
    points = np.array([[0.01, 0.01, 0.01]] * 3 + [[1.01, 0.01, 0.01]] * 3)
    failures: list[str] = []
    stop = threading.Event()

    def read() -> None:
        while not stop.is_set():
            weights = engine.voxels().dense_weight
            state = engine.export_state()
            if len(set(weights.tolist())) > 1 or len(set(state["dense_weight"].tolist())) > 1:
                failures.append(f"half a frame: {weights} {state['dense_weight']}")
            if len(state["voxel_coordinates"]) != len(state["hypothesis_id"]):
                failures.append("columns of different lengths")

    readers = [threading.Thread(target=read) for _ in range(2)]
    for reader in readers:
        reader.start()
    try:
        for _ in range(60):
            engine.integrate_dense(points, np.zeros(6, int), np.ones((1, 4)), np.ones(1), np.zeros((6, 3), np.uint8))
            engine.integrate_proposals(points, np.zeros(6, int), np.ones((1, 4)))
            engine.fuse()
    finally:
        stop.set()
        for reader in readers:
            reader.join()
    assert failures == []
    assert engine.voxels().dense_weight.tolist() == [180.0, 180.0]


def test_an_imported_state_replaces_what_the_map_held_and_goes_on_from_there():
    setting = Setting()
    source, target = engine_of(setting), engine_of(setting)
    reference = reference_of(setting)
    for step in random_steps(setting, extent=3, count=25, seed=6):
        apply_to_both(step, source, reference)
    for step in random_steps(setting, extent=3, count=25, seed=7):
        step.apply(target)
    target.import_state(source.export_state())
    assert_same_bytes(target.export_state(), source.export_state())
    ask_everything(target, reference, setting, 1)
    for step in random_steps(setting, extent=3, count=25, seed=8):
        apply_to_both(step, target, reference)
        assert_same_map(target, reference, setting)
