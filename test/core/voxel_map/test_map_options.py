"""Options of association, merging and the window, against the plain reference over whole random sequences."""

from __future__ import annotations

import importlib
from dataclasses import replace

import numpy as np
import pytest
from elsewhere import elsewhere
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
from reference.steps import FuseStep, Setting, embeddings_of, random_steps, sequences
from reference.variants import BACKEND_IDS, BACKENDS

from fus3dmaps_core.answers.query import TextQuery
from fus3dmaps_core.voxel_map.warm_up import warm_up

on_every_backend = pytest.mark.parametrize(("backend", "device"), BACKENDS, ids=BACKEND_IDS)

options = st.fixed_dictionaries(
    {
        "association": st.sampled_from(["iou", "visible_iou"]),
        "merge_overlap": st.sampled_from([0.0, 0.25, 0.5, 1.0]),
        "merge_cosine": st.sampled_from([-1.0, 0.3, 0.8]),
        "keep_most_evidence": st.booleans(),
    }
)
ALL_ON = {"association": "visible_iou", "merge_overlap": 0.4, "merge_cosine": 0.55, "keep_most_evidence": False}


def ask(engine, reference, setting: Setting, seed: int) -> None:
    texts = KnownTexts({"lamp": embeddings_of(1, setting.dimension, np.random.default_rng(seed))[0]})
    for layer in ("fused_instances", "fused_dense"):
        assert_same_answer(engine, reference, setting, TextQuery(["lamp"], layer=layer, min_voxels=1), texts, 10.0)


@on_every_backend
def test_agrees_with_the_reference_after_every_step(backend: str, device: str):
    @settings(max_examples=120)
    @given(st.data())
    def check(data):
        chosen = data.draw(options)
        setting, steps = data.draw(sequences(dtype="float32", backend=backend, device=device, **chosen))
        engine, reference = engine_of(setting), reference_of(setting)
        for number, step in enumerate(steps):
            apply_to_both(step, engine, reference)
            assert_same_map(engine, reference, setting)
            if number % 3 == 2:
                ask(engine, reference, setting, number)
        for branch in reference.seen:
            event(branch)

    check()


@on_every_backend
@pytest.mark.parametrize(
    "setting",
    [
        Setting(**ALL_ON),
        Setting(window_radius_m=0.16, **{**ALL_ON, "keep_most_evidence": True}),
        Setting(window_radius_m=0.12, max_hypotheses=4, iou_threshold=0.5, variance_ratio=5.0, dtype="float16", **ALL_ON),
        Setting(window_radius_m=0.12, keep_most_evidence=False),
    ],
    ids=["full", "window", "window-as-it-is", "no-evidence"],
)
def test_agrees_with_the_reference_over_a_long_walk_that_takes_every_branch(setting: Setting, backend: str, device: str):
    setting = replace(setting, backend=backend, device=device)
    engine, reference = engine_of(setting), reference_of(setting)
    for number, step in enumerate(random_steps(setting, extent=3, count=120, seed=7)):
        apply_to_both(step, engine, reference)
        if number % 4 == 3:
            assert_same_map(engine, reference, setting)
        if number % 40 == 39:
            ask(engine, reference, setting, number)
    often = set()
    if setting.association == "visible_iou":
        often |= {"match_of_visible", "instance_match", "instance_merged", "merge_shared_voxel", "merge_renamed_voxel"}
        often |= {"merge_overlap_too_small", "merge_unlike"}
    if setting.window_radius_m > 0:
        often.add("fusion_kept" if setting.keep_most_evidence else "fusion_replaced_by_less")
    assert {branch: reference.seen[branch] for branch in often if reference.seen[branch] < 8} == {}
    if setting.association == "visible_iou":
        assert reference.seen["merge_of_stored"] > 0


@on_every_backend
def test_fusing_what_changed_stores_what_fusing_everything_stores(backend: str, device: str):
    @settings(max_examples=25)
    @given(sequences(dtype="float16", backend=backend, device=device, **ALL_ON))
    def check(sequence):
        setting, steps = sequence
        incremental, full = engine_of(setting), engine_of(setting)
        for step in [*steps, FuseStep()]:
            step.apply(incremental)
            if isinstance(step, FuseStep):
                full.fuse(full=True)
                assert_same_bytes(incremental.export_state(), full.export_state())
            else:
                step.apply(full)

    check()


@on_every_backend
def test_a_restored_map_goes_on_as_the_saved_one_would(backend: str, device: str):
    setting = Setting(backend=backend, device=device, **ALL_ON)
    steps = random_steps(setting, extent=3, count=60, seed=3)
    first, second = engine_of(setting), engine_of(setting)
    for step in steps[:40]:
        step.apply(first)
    second.import_state(first.export_state())
    for step in steps[40:]:
        step.apply(first)
        step.apply(second)
        mine, theirs = first.instances(), second.instances()
        for name in ("ids", "weights", "hypothesis_voxels", "voxel_counts"):
            np.testing.assert_array_equal(getattr(mine, name), getattr(theirs, name))


@pytest.mark.skipif(("compiled", "cpu") not in BACKENDS, reason="numba is not installed")
def test_what_a_rehearsal_compiles_is_what_a_map_runs():
    numba_instances = importlib.import_module("fus3dmaps_core.voxel_map.kernels.numba_instances")
    setting = Setting(backend="compiled", **ALL_ON)
    engine = engine_of(setting)
    warm_up(setting.dimension, engine.config)
    for step in random_steps(setting, extent=3, count=40, seed=7):
        step.apply(engine)
    for name in ("associate", "holders", "shared_voxels", "merge"):
        assert len(getattr(numba_instances, name).signatures) == 1, name


@pytest.mark.parametrize("window_radius_m", [0.0, 0.16])
def test_agrees_with_the_reference_on_another_device(window_radius_m: float):
    @settings(max_examples=6)
    @given(st.integers(0, 2**32 - 1))
    def check(seed):
        with elsewhere() as device:
            setting = Setting(window_radius_m=window_radius_m, device=device, **ALL_ON)
            engine, reference = engine_of(setting), reference_of(setting)
            for step in random_steps(setting, extent=2, count=25, seed=seed):
                apply_to_both(step, engine, reference)
            assert_same_map(engine, reference, setting)
            ask(engine, reference, setting, seed)

    check()
