"""The pipeline: gates, what each keyframe adds, windows, and repeatability, with encoders of known behaviour."""

from __future__ import annotations

import numpy as np
import pytest
from stand_ins import ColorSegmenter, color_trio, wall_frame

from fus3dmaps_core.config import Config
from fus3dmaps_core.errors import EncoderError
from fus3dmaps_core.pipeline import Pipeline
from fus3dmaps_core.query import TextQuery, answer_query


def make(**values) -> Pipeline:
    return Pipeline(
        Config.from_flat({key.replace("__", "."): value for key, value in values.items()}), color_trio(), ColorSegmenter()
    )


def ask(pipeline: Pipeline, prompt: str, layer: str):
    return answer_query(
        pipeline.semantic_map, pipeline.trio.text, TextQuery([prompt], layer=layer), pipeline.trio.logit_scale
    )


def test_gates_choose_dense_and_instance_keyframes():
    pipeline = make()
    reports = [pipeline.process(wall_frame(i, x_m=x)) for i, x in enumerate([0.0, 0.05, 0.09, 0.13, 0.15, 0.30])]
    assert [(report.dense, report.instances) for report in reports] == [
        (True, True),
        (False, False),
        (True, False),
        (False, False),
        (False, True),
        (True, True),
    ]
    assert len(pipeline.camera_poses()) == 4
    assert pipeline.trio.patch.images == 3


def test_wants_agrees_with_process_and_changes_nothing():
    pipeline = make()
    for i, x in enumerate([0.0, 0.05, 0.09, 0.2]):
        frame = wall_frame(i, x_m=x)
        wanted = [pipeline.wants(frame.T_world_camera) for _ in range(2)]
        report = pipeline.process(frame)
        assert wanted == [report.dense or report.instances] * 2


@pytest.mark.parametrize("layer", ["dense", "fused_dense", "instances", "fused_instances"])
@pytest.mark.parametrize(("prompt", "x", "y", "edge"), [("red", -0.4, 0.0, 0.4), ("blue", 0.5, 0.1, 0.3)])
def test_every_layer_finds_a_painted_square_where_it_is(layer, prompt, x, y, edge):
    pipeline = make()
    for i in range(6):
        pipeline.process(wall_frame(i, x_m=0.1 * i - 0.25))
    answer = ask(pipeline, prompt, layer)
    best = answer.instances[0]
    assert best.centroid_m == pytest.approx([x, y, 2.0], abs=0.05)
    assert best.box_max_m - best.box_min_m == pytest.approx([edge, edge, 0.05], abs=0.11)
    hottest = answer.points_m[answer.similarity.argmax()]
    assert abs(hottest[0] - x) <= edge / 2 + 0.05
    assert abs(hottest[1] - y) <= edge / 2 + 0.05


def test_voxels_carry_the_colour_of_the_image():
    pipeline = make()
    pipeline.process(wall_frame(0))
    voxels = pipeline.semantic_map.voxels()
    inside = np.linalg.norm(voxels.centers_m - (-0.4, 0.0, 2.025), axis=1) < 0.1
    assert inside.sum() > 4
    np.testing.assert_array_equal(voxels.colors[inside], np.tile([220, 30, 30], (inside.sum(), 1)))


def test_invalid_depth_gives_no_voxel():
    frame = wall_frame(0)
    depth = frame.depth_m.copy()
    depth[:, :200], depth[:, 200:300], depth[:, 300:400], depth[:, 400:500] = 0.0, np.nan, np.inf, 40.0
    pipeline = make()
    pipeline.process(type(frame)(0, frame.rgb, depth, frame.intrinsics, frame.T_world_camera))
    centers = pipeline.semantic_map.voxels().centers_m
    assert len(centers) > 0
    assert centers[:, 0].min() > (499 - 319.5) * 2 / 525 - 0.06


def test_a_window_bounds_the_dense_layer_and_keeps_instances():
    pipeline = make(fusion__window_radius_m=2.2, fusion__period_frames=1)
    for i in range(40):
        pipeline.process(wall_frame(i, x_m=0.2 * i, patches={"red": (-0.4, 0.0, 0.4), "blue": (7.5, 0.0, 0.4)}))
    semantic_map = pipeline.semantic_map
    voxels = semantic_map.voxels()
    camera = np.array([0.2 * 39, 0.0, 0.0])
    far = np.linalg.norm(voxels.centers_m - camera, axis=1) > 2.2
    assert far.any()
    assert not voxels.dense_weight[far].any()
    assert semantic_map.dense_voxel_count < semantic_map.voxel_count / 2
    assert ask(pipeline, "red", "fused_instances").instances[0].centroid_m == pytest.approx([-0.4, 0.0, 2.0], abs=0.06)


def test_two_runs_are_equal_bit_for_bit():
    states = []
    for _ in range(2):
        pipeline = make()
        for i in range(5):
            pipeline.process(wall_frame(i, x_m=0.11 * i))
        pipeline.semantic_map.fuse()
        states.append(pipeline.semantic_map.export_state())
    assert all(states[0][name].tobytes() == states[1][name].tobytes() for name in states[0])


def test_reset_starts_over():
    pipeline = make()
    first = [pipeline.process(wall_frame(i, x_m=0.1 * i)).dense for i in range(3)]
    before = pipeline.semantic_map.export_state()
    pipeline.reset()
    assert (pipeline.semantic_map.voxel_count, len(pipeline.camera_poses())) == (0, 0)
    assert [pipeline.process(wall_frame(i, x_m=0.1 * i)).dense for i in range(3)] == first
    after = pipeline.semantic_map.export_state()
    assert all(np.array_equal(before[name], after[name]) for name in before)


def test_lambda_is_the_trios_unless_set():
    assert make().semantic_map.variance_ratio == color_trio().variance_ratio
    assert make(fusion__variance_ratio=3.5).semantic_map.variance_ratio == 3.5


@pytest.mark.parametrize("key", ["encoder.name", "segmenter.name"])
def test_unknown_models_are_named(key):
    with pytest.raises(EncoderError, match=f"{key}.*imaginary"):
        Pipeline.from_config(Config.from_flat({key: "imaginary"}))
