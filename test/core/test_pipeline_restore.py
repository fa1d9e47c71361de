"""A pipeline goes on from another map, and takes over what can change while it runs."""

from __future__ import annotations

import numpy as np
import pytest
from reference.agreement import assert_same_bytes
from stand_ins import ColorSegmenter, color_trio, wall_frame

from fus3dmaps_core.config.schema import Config
from fus3dmaps_core.pipeline import Pipeline


def a_pipeline(**values) -> Pipeline:
    return Pipeline(Config().with_values(values), color_trio(), ColorSegmenter())


def test_it_goes_on_from_another_map_as_if_it_had_made_it():
    first, second = a_pipeline(), a_pipeline()
    first.process(wall_frame(1))
    second.process(wall_frame(5, x_m=3.0))
    fresh = second.empty_map()
    fresh.import_state(first.semantic_map.export_state())
    second.restore(fresh, first.stamp_ns, first.camera_poses())
    assert second.semantic_map is fresh
    assert second.stamp_ns == 1
    np.testing.assert_array_equal(second.camera_poses(), first.camera_poses())
    assert second.wants(np.eye(4))
    for pipeline in (first, second):
        pipeline.process(wall_frame(2, x_m=0.5))
    assert_same_bytes(second.semantic_map.export_state(), first.semantic_map.export_state())
    np.testing.assert_array_equal(second.camera_poses(), first.camera_poses())


def test_an_empty_map_is_like_the_pipelines():
    pipeline = a_pipeline(**{"map.voxel_size_m": 0.1, "fusion.variance_ratio": 3.0, "fusion.window_radius_m": 4.0})
    empty, own = pipeline.empty_map(), pipeline.semantic_map
    assert empty is not own
    assert (empty.dimension, empty.config, empty.variance_ratio) == (own.dimension, own.config, own.variance_ratio)
    assert empty.window_radius_m == own.window_radius_m
    assert empty.voxel_count == 0


@pytest.mark.parametrize("layer", ["dense", "instance"])
def test_other_thresholds_of_motion_take_effect(layer):
    pipeline = a_pipeline()
    pipeline.process(wall_frame(1))
    far = {f"keyframes.{layer}_translation_m": 1.0, f"keyframes.{layer}_rotation_rad": 1.0}
    pipeline.reconfigure(pipeline.config.with_values(far))
    pipeline.process(wall_frame(2, x_m=0.2))
    report = pipeline.process(wall_frame(3, x_m=0.5))
    assert (report.dense, report.instances) == (layer != "dense", layer != "instance")


def test_with_the_same_thresholds_the_last_keyframe_is_remembered():
    pipeline = a_pipeline()
    pipeline.process(wall_frame(1))
    pipeline.reconfigure(pipeline.config.with_values({"segmenter.max_masks": 1}))
    assert not pipeline.wants(np.eye(4))
    assert pipeline.process(wall_frame(2, x_m=0.5)).proposals == 1
