"""The services answer while mapping goes on, and refuse by name."""

from __future__ import annotations

import math

import numpy as np
import pytest
from stand_ins import wall_frame
from std_srvs.srv import Trigger

from fus3dmaps_core.answers.query import TextQuery, answer_query
from fus3dmaps_msgs.srv import Fuse, QueryText
from fus3dmaps_ros.topics.conversions import from_cloud

STAMP_NS = 1_700_000_000_123_456_789


def test_an_empty_map_refuses_queries_and_fusion_but_can_be_reset(robot) -> None:
    answer = robot.call(QueryText, "query_text", prompts=["red"])
    assert not answer.success
    assert "map is empty" in answer.message
    fused = robot.call(Fuse, "fuse")
    assert not fused.success
    assert "map is empty" in fused.message
    assert robot.call(Trigger, "reset").success


@pytest.mark.parametrize(
    ("fields", "named"),
    [
        ({"prompts": []}, "prompts"),
        ({"prompts": ["red", "  "]}, "prompts[1]"),
        ({"prompts": ["red"], "negative_prompts": [""]}, "negative_prompts[0]"),
        ({"prompts": ["red"], "layer": "sparse"}, "layer"),
        ({"prompts": ["red"], "threshold": math.nan}, "threshold"),
        ({"prompts": ["red"], "threshold": math.inf}, "threshold"),
        ({"prompts": ["x" * 1_000_000]}, "prompts[0]"),
    ],
)
def test_a_malformed_query_is_refused_by_field(mapped_robot, fields, named) -> None:
    answer = mapped_robot.call(QueryText, "query_text", **fields)
    assert not answer.success
    assert answer.message.startswith(named)
    assert not answer.instances


@pytest.mark.parametrize("layer", ["", "dense", "fused_dense", "instances", "fused_instances"])
def test_a_reply_is_what_the_core_answers(mapped_robot, layer) -> None:
    answer = mapped_robot.call(QueryText, "query_text", prompts=["red"], negative_prompts=["grey"], layer=layer)
    assert answer.success, answer.message

    pipeline = mapped_robot.mapper.pipeline
    query = TextQuery(["red"], ("grey",), layer or "fused_instances")
    expected = answer_query(pipeline.semantic_map, pipeline.trio.text, query, pipeline.trio.logit_scale)
    assert [found.id for found in answer.instances] == [found.id for found in expected.instances]
    best, best_expected = answer.instances[0], expected.instances[0]
    assert best.prompt == "red"
    assert best.score == np.float32(best_expected.score)
    assert best.weight == np.float32(best_expected.weight)
    assert best.voxels == best_expected.voxels
    for point, array in (
        (best.centroid, best_expected.centroid_m),
        (best.box_min, best_expected.box_min_m),
        (best.box_max, best_expected.box_max_m),
    ):
        np.testing.assert_array_equal([point.x, point.y, point.z], array.astype(float))
    # The red square is where wall_frame paints it.
    assert abs(best.centroid.x + 0.4) < 0.05
    assert abs(best.centroid.z - 2.0) < 0.1

    table = from_cloud(answer.similarity)
    assert table.dtype.names == ("x", "y", "z", "similarity", "rgb")
    np.testing.assert_array_equal(np.stack([table[axis] for axis in "xyz"], axis=1), expected.points_m)
    np.testing.assert_array_equal(table["similarity"], expected.similarity)
    for found in (answer.similarity, best):
        assert found.header.frame_id == "map"
        assert found.header.stamp.sec * 10**9 + found.header.stamp.nanosec == STAMP_NS


def test_threshold_and_top_k_bound_the_reply(mapped_robot) -> None:
    everything = mapped_robot.call(QueryText, "query_text", prompts=["red"])
    one = mapped_robot.call(QueryText, "query_text", prompts=["red"], top_k=1)
    assert len(everything.instances) > 1
    assert [found.id for found in one.instances] == [everything.instances[0].id]

    threshold = everything.instances[0].score - 1e-3
    strict = mapped_robot.call(QueryText, "query_text", prompts=["red"], threshold=threshold)
    assert [found.id for found in strict.instances] == [everything.instances[0].id]
    assert from_cloud(strict.similarity)["similarity"].min() >= threshold


def test_fuse_reports_what_it_did(mapped_robot) -> None:
    fused = mapped_robot.call(Fuse, "fuse")
    semantic_map = mapped_robot.mapper.pipeline.semantic_map
    assert fused.success, fused.message
    assert fused.instances == semantic_map.instance_count > 0
    assert fused.updated == fused.instances
    assert fused.voxels == semantic_map.voxel_count > 0
    assert fused.duration.sec * 10**9 + fused.duration.nanosec > 0


def test_reset_empties_map_gates_and_latched_answer(robot) -> None:
    frame = wall_frame(STAMP_NS)
    robot.map(frame)
    assert robot.call(QueryText, "query_text", prompts=["red"], publish=True).success
    assert robot.call(Trigger, "reset").success
    assert robot.mapper.pipeline.semantic_map.voxel_count == 0
    assert not robot.call(QueryText, "query_text", prompts=["red"]).success
    # The same pose is a keyframe again, and its earlier stamp is no step back in time.
    robot.map(wall_frame(STAMP_NS - 10**9))


def test_a_defect_in_an_encoder_is_a_reply_and_not_the_end(robot, monkeypatch) -> None:
    robot.map(wall_frame(STAMP_NS))

    def fail(prompts):
        raise RuntimeError("out of memory")

    with monkeypatch.context() as patch:
        patch.setattr(robot.mapper.pipeline.trio.text, "encode_text", fail)
        answer = robot.call(QueryText, "query_text", prompts=["red"])
    assert not answer.success
    assert "out of memory" in answer.message
    assert robot.call(QueryText, "query_text", prompts=["red"]).success
