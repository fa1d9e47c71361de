"""The pipeline: gates, what each keyframe adds, windows, and repeatability, with encoders of known behaviour."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
import pytest
import torch
from stand_ins import ColorSegmenter, color_trio, wall_frame

from fus3dmaps_core.answers.query import TextQuery, answer_query
from fus3dmaps_core.config.schema import Config
from fus3dmaps_core.errors import EncoderError
from fus3dmaps_core.masks import Masks
from fus3dmaps_core.pipeline import Pipeline


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


def test_what_a_keyframe_sees_outside_of_masks_is_visible_to_association():
    # While the rest of the bar is in view, a mask of its end alone is something else.
    assert instances_of_a_bar("iou", in_view=True) == instances_of_a_bar("visible_iou", in_view=True) == 2
    # Where only the end is seen, it is all that there is to compare with.
    assert instances_of_a_bar("iou", in_view=False) == 2
    assert instances_of_a_bar("visible_iou", in_view=False) == 1


def instances_of_a_bar(association: str, in_view: bool) -> int:
    """Instances after a frame with a mask over a whole bar and one with a mask over its left tenth.

    Without ``in_view`` the second frame has no depth right of that mask.
    """
    bar = np.zeros((480, 640), bool)
    bar[200:280, 40:600] = True
    end = bar.copy()
    end[:, 96:] = False

    class Scripted:
        def __init__(self) -> None:
            self.masks = [bar, end]

        def segment(self, rgb: np.ndarray, depth_m: np.ndarray) -> Masks:
            return Masks.from_masks(self.masks.pop(0)[None])

    pipeline = Pipeline(Config.from_flat({"map.association": association}), color_trio(), Scripted())
    first, second = wall_frame(0), wall_frame(1, x_m=0.2)
    depth_m = second.depth_m.copy()
    if not in_view:
        depth_m[:, 96:] = 0.0
    assert pipeline.process(first).proposals == pipeline.process(replace(second, depth_m=depth_m)).proposals == 1
    return pipeline.semantic_map.instance_count


def test_masks_described_by_patches_cost_no_second_encoder():
    pipeline = make(encoder__instance_embeddings="patches")
    crops = pipeline.trio.crop
    assert crops is pipeline.trio.patch
    crops.encode_crops = None  # Any call would fail.
    reports = [pipeline.process(wall_frame(i, x_m=0.1 * i - 0.25)) for i in range(6)]
    assert pipeline.trio.patch.images == sum(report.dense or report.instances for report in reports)
    assert sum(report.proposals for report in reports) > 0
    assert "crop_encoder" not in set().union(*(report.durations_s for report in reports))
    for prompt, x_m in (("red", -0.4), ("blue", 0.5)):
        for layer in ("instances", "fused_instances"):
            assert ask(pipeline, prompt, layer).instances[0].centroid_m[0] == pytest.approx(x_m, abs=0.05)


def test_patches_that_the_dense_layer_does_not_need_are_embedded_for_instances():
    pipeline = make(
        encoder__instance_embeddings="patches", keyframes__dense_translation_m=9.0, keyframes__dense_rotation_rad=9.0
    )
    reports = [pipeline.process(wall_frame(i, x_m=0.2 * i)) for i in range(3)]
    assert [report.dense for report in reports] == [True, False, False]
    assert all(report.proposals for report in reports)
    assert pipeline.trio.patch.images == 3


def test_a_working_resolution_beyond_memory_is_refused_by_its_parameters():
    pipeline = make()
    pipeline.config = pipeline.config.with_values({"image.width": 1_000_000, "image.height": 1_000_000})
    with pytest.raises(EncoderError, match=r"'image.width', 'image.height'.*1000000 x 1000000 pixels"):
        pipeline.process(wall_frame(0))
    assert pipeline.semantic_map.voxel_count == 0


def test_lambda_is_the_encoders_unless_it_is_set_or_patches_describe_masks():
    trio = replace(color_trio(), variance_ratio=5.0)

    def ratio(**values) -> float:
        config = Config.from_flat({key.replace("__", "."): value for key, value in values.items()})
        pipeline = Pipeline(config, trio, ColorSegmenter())
        assert pipeline.empty_map().variance_ratio == pipeline.semantic_map.variance_ratio
        return pipeline.semantic_map.variance_ratio

    assert ratio() == 5.0
    assert ratio(encoder__instance_embeddings="patches") == 1.0
    assert ratio(encoder__instance_embeddings="patches", fusion__variance_ratio=0.3) == 0.3


def test_a_window_that_keeps_no_evidence_is_the_configurations_choice():
    evidence = {}
    for keep in (True, False):
        pipeline = make(fusion__window_radius_m=2.2, fusion__period_frames=1, fusion__keep_most_evidence=keep)
        for i in range(20):
            pipeline.process(wall_frame(i, x_m=0.2 * i))
        copy = pipeline.empty_map()
        copy.import_state(pipeline.semantic_map.export_state())
        for semantic_map in (pipeline.semantic_map, copy):
            semantic_map.prune_window(np.array([1e3, 0.0, 0.0]))
            semantic_map.fuse()
        state = pipeline.semantic_map.export_state()
        evidence[keep] = state["fused_evidence"]
        assert np.array_equal(evidence[keep], copy.export_state()["fused_evidence"])
        alone = np.isclose(state["fused_embedding"], state["instance_embedding"], atol=1e-6).all(axis=1)
        assert alone.all() != keep
    assert (evidence[False] <= evidence[True]).all()
    assert evidence[False].sum() < evidence[True].sum()


MIB, BUDGET_MIB = 2**20, 1.7
FEW = {"sampling__dense_per_patch": 1, "sampling__instance_per_patch": 1, "map__dtype": "float32"}


def drive(pipeline: Pipeline, frames: int = 70, step_m: float = 0.3):
    """Along a wall with a red square at its start and a blue one at its end; yields what became of each frame."""
    squares = {"red": (-0.4, 0.0, 0.4), "blue": (step_m * (frames - 1) + 0.2, 0.0, 0.4)}
    for i in range(frames):
        yield pipeline.process(wall_frame(i, x_m=step_m * i, patches=squares))


def allocated_mib(pipeline: Pipeline) -> float:
    return sum(pipeline.semantic_map.nbytes().values()) / MIB


def test_a_small_budget_costs_dense_voxels_and_nothing_else(caplog: pytest.LogCaptureFixture):
    free, bound = make(**FEW), make(map__memory_budget_mib=BUDGET_MIB, **FEW)
    assert sum(report.dropped_dense_voxels for report in drive(free)) == 0
    assert allocated_mib(free) > BUDGET_MIB
    dropped = 0
    with caplog.at_level(logging.WARNING):
        for report in drive(bound):
            assert allocated_mib(bound) <= BUDGET_MIB
            assert (report.dense, report.instances, report.window_radius_m) == (True, True, 0.0)
            dropped += report.dropped_dense_voxels
    missing = free.semantic_map.dense_voxel_count - bound.semantic_map.dense_voxel_count
    assert dropped >= missing > 1000  # What was dropped in front of the camera was seen and dropped again.
    assert [record.name for record in caplog.records] == ["fus3dmaps_core.voxel_map.budget"]
    mine, full = bound.semantic_map.export_state(), free.semantic_map.export_state()
    for name in full:
        if name.startswith(("instance", "hypothesis", "voxel")):
            assert mine[name].tobytes() == full[name].tobytes(), name
    for prompt, x in (("red", -0.4), ("blue", 20.9)):
        assert ask(bound, prompt, "fused_instances").instances[0].centroid_m == pytest.approx([x, 0.0, 2.0], abs=0.06)
    assert ask(bound, "blue", "dense").instances[0].centroid_m == pytest.approx([20.9, 0.0, 2.0], abs=0.06)


def test_with_a_window_the_budget_takes_from_its_radius():
    pipeline = make(map__memory_budget_mib=BUDGET_MIB, fusion__window_radius_m=20.0, **FEW)
    reports = list(drive(pipeline))
    assert reports[0].window_radius_m == 20.0
    assert 1.0 <= reports[-1].window_radius_m < 20.0
    assert pipeline.semantic_map.window_radius_m == reports[-1].window_radius_m
    assert sum(report.dropped_dense_voxels for report in reports) > 0
    assert allocated_mib(pipeline) <= BUDGET_MIB
    not_a_keyframe = pipeline.process(wall_frame(99, x_m=0.3 * 69))
    assert not not_a_keyframe.dense
    assert not_a_keyframe.window_radius_m == reports[-1].window_radius_m
    pipeline.reset()
    assert pipeline.process(wall_frame(0)).window_radius_m == 20.0


class ShortOfMemory:
    """A crop encoder that has room for so many masks at once."""

    def __init__(self, encoder, room: int) -> None:
        self.encoder, self.room = encoder, room
        self.sizes: list[int] = []

    def encode_crops(self, rgb: np.ndarray, masks: Masks) -> np.ndarray:
        self.sizes.append(len(masks))
        if len(masks) > self.room:
            raise torch.cuda.OutOfMemoryError("CUDA out of memory.")
        return self.encoder.encode_crops(rgb, masks)


def with_crop_memory(room: int) -> Pipeline:
    trio = color_trio()
    return Pipeline(Config(), replace(trio, crop=ShortOfMemory(trio.crop, room)), ColorSegmenter())


SQUARES = {name: (x, 0.0, 0.25) for name, x in zip(["red", "green", "blue", "yellow"], [-0.6, -0.2, 0.2, 0.6], strict=True)}


def test_crops_are_encoded_in_smaller_batches_when_memory_is_short():
    ample, short = with_crop_memory(100), with_crop_memory(2)
    for pipeline in (ample, short):
        for i in range(3):
            assert pipeline.process(wall_frame(i, x_m=0.2 * i, patches=SQUARES)).proposals >= 4
    assert len(ample.trio.crop.sizes) == 3
    assert max(short.trio.crop.sizes[2:]) <= 2
    mine, full = short.semantic_map.export_state(), ample.semantic_map.export_state()
    assert all(mine[name].tobytes() == full[name].tobytes() for name in full)


def test_a_crop_encoder_without_any_memory_is_named_and_the_map_stays_within_its_budget():
    pipeline = with_crop_memory(0)
    with pytest.raises(EncoderError, match="crop encoder of 'stand_in'"):
        pipeline.process(wall_frame(0))
    assert pipeline.semantic_map.instance_count == 0
    trio = color_trio()
    values = {key.replace("__", "."): value for key, value in FEW.items()} | {"map.memory_budget_mib": BUDGET_MIB}
    failing = Pipeline(Config.from_flat(values), replace(trio, crop=ShortOfMemory(trio.crop, 0)), ColorSegmenter())
    for i in range(70):
        with pytest.raises(EncoderError):
            failing.process(wall_frame(i, x_m=0.3 * i, patches={"red": (0.3 * i, 0.0, 0.4)}))
        assert allocated_mib(failing) <= BUDGET_MIB


@pytest.mark.parametrize("part", ["patch", "segmenter"])
def test_models_that_are_out_of_memory_are_named(part: str, monkeypatch: pytest.MonkeyPatch):
    def fail(*_: object) -> None:
        raise torch.cuda.OutOfMemoryError("CUDA out of memory.")

    pipeline = make()
    model, method, name = {
        "patch": (pipeline.trio.patch, "encode_patches", "patch encoder of 'stand_in'"),
        "segmenter": (pipeline._segmenter, "segment", "segmenter 'lite'"),
    }[part]
    monkeypatch.setattr(model, method, fail)
    with pytest.raises(EncoderError, match=name):
        pipeline.process(wall_frame(0))


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
