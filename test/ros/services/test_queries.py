"""Queries by image, labels for the whole map and the list of instances, over DDS."""

from __future__ import annotations

import math

import numpy as np
import pytest
from rclpy.parameter import Parameter
from robot import rgb_message, wait_until
from sensor_msgs.msg import Image, PointCloud2
from stand_ins import COLORS, wall_frame
from visualization_msgs.msg import Marker, MarkerArray

from fus3dmaps_core.answers.labels import label_voxels
from fus3dmaps_msgs.srv import LabelMap, ListInstances, QueryImage, QueryText
from fus3dmaps_ros.topics.conversions import from_cloud, unpack_rgb

STAMP_NS = 1_700_000_000_123_456_789


def picture(name: str, height: int = 24, width: int = 32) -> Image:
    message = Image(height=height, width=width, encoding="rgb8", step=3 * width)
    message.data.frombytes(np.full((height, width, 3), COLORS[name], np.uint8).tobytes())
    return message


def test_an_image_is_answered_like_the_text_that_means_the_same(mapped_robot) -> None:
    by_image = mapped_robot.call(QueryImage, "query_image", image=picture("blue"), negative_prompts=["grey"])
    by_text = mapped_robot.call(QueryText, "query_text", prompts=["blue"], negative_prompts=["grey"])
    assert by_image.success, by_image.message
    assert by_image.similarity == by_text.similarity
    assert [(each.id, each.score) for each in by_image.instances] == [(each.id, each.score) for each in by_text.instances]
    assert {each.prompt for each in by_image.instances} == {"image"}
    assert abs(by_image.instances[0].centroid.x - 0.5) < 0.06


def test_asking_by_image_is_no_change_of_the_map(mapped_robot) -> None:
    revision = mapped_robot.mapper.worker.revision
    assert mapped_robot.call(QueryImage, "query_image", image=picture("red"), top_k=1).success
    assert mapped_robot.mapper.worker.revision == revision


@pytest.mark.parametrize(
    ("fields", "named"),
    [
        ({"image": Image()}, "image"),
        ({"image": picture("red", height=4)}, "image"),
        ({"image": Image(height=10, width=10, encoding="yuv422", step=20)}, "image"),
        ({"image": Image(height=10, width=10, encoding="rgb8", step=30)}, "image"),
        ({"image": picture("red"), "layer": "sparse"}, "layer"),
        ({"image": picture("red"), "negative_prompts": [" "]}, "negative_prompts[0]"),
        ({"image": picture("red"), "threshold": math.nan}, "threshold"),
    ],
)
def test_a_malformed_image_query_is_refused_by_field(mapped_robot, fields, named) -> None:
    answer = mapped_robot.call(QueryImage, "query_image", **fields)
    assert not answer.success
    assert answer.message.startswith(named)
    assert not answer.instances


def test_every_voxel_gets_a_label(mapped_robot) -> None:
    labels = ["blue", "grey", "red"]
    answer = mapped_robot.call(LabelMap, "label_map", labels=labels)
    assert answer.success, answer.message
    table = from_cloud(answer.cloud)
    assert table.dtype.names == ("x", "y", "z", "label", "score", "rgb")
    pipeline = mapped_robot.mapper.pipeline
    expected = label_voxels(pipeline.semantic_map, pipeline.trio.text, labels)
    np.testing.assert_array_equal(np.stack([table[axis] for axis in "xyz"], axis=1), expected.points_m)
    np.testing.assert_array_equal(table["label"], expected.labels)
    np.testing.assert_array_equal(table["score"], expected.scores)
    # In the middle of the red square of wall_frame, of the blue one, and of the wall between them.
    for label, (x, y) in ((2, (-0.4, 0.0)), (0, (0.5, 0.1)), (1, (0.1, 0.0))):
        near = np.hypot(table["x"] - x, table["y"] - y) < 0.06
        assert near.any()
        assert set(table["label"][near].tolist()) == {label}
    colors = unpack_rgb(table["rgb"])
    assert len(np.unique(colors, axis=0)) == len(labels)
    assert all(len(np.unique(colors[table["label"] == label], axis=0)) == 1 for label in range(len(labels)))
    header = answer.cloud.header
    assert (header.frame_id, header.stamp.sec * 10**9 + header.stamp.nanosec) == ("map", STAMP_NS)


@pytest.mark.parametrize(
    ("fields", "named"),
    [({"labels": []}, "labels"), ({"labels": ["a", ""]}, "labels[1]"), ({"labels": ["a"], "layer": "x"}, "layer")],
)
def test_malformed_labels_are_refused_by_field(mapped_robot, fields, named) -> None:
    answer = mapped_robot.call(LabelMap, "label_map", **fields)
    assert not answer.success
    assert answer.message.startswith(named)


def test_instances_are_listed_with_their_boxes(mapped_robot) -> None:
    instances = mapped_robot.mapper.pipeline.semantic_map.instances()
    everything = mapped_robot.call(ListInstances, "list_instances", min_voxels=1)
    assert everything.success, everything.message
    assert [each.id for each in everything.instances] == instances.ids[instances.voxel_counts >= 1].tolist()
    for each in everything.instances:
        (row,) = np.flatnonzero(instances.ids == each.id)
        assert (each.voxels, each.weight, each.score) == (instances.voxel_counts[row], instances.weights[row], 0.0)
        for point, array in (
            (each.centroid, instances.centroids_m),
            (each.box_min, instances.boxes_min_m),
            (each.box_max, instances.boxes_max_m),
        ):
            np.testing.assert_array_equal([point.x, point.y, point.z], array[row].astype(float))
    most = max(each.voxels for each in everything.instances)
    largest = mapped_robot.call(ListInstances, "list_instances", min_voxels=most)
    assert {each.voxels for each in largest.instances} == {most}
    assert mapped_robot.call(ListInstances, "list_instances", min_voxels=most + 1).instances == []


def test_a_published_answer_has_boxes_with_prompt_and_score_and_labels_have_a_cloud(robot) -> None:
    robot.map(wall_frame(STAMP_NS))
    reply = robot.call(QueryText, "query_text", prompts=["red", "blue"], top_k=1, publish=True)
    labels = robot.call(LabelMap, "label_map", labels=["red", "grey"], publish=True)
    answers, clouds = robot.listen(MarkerArray, "answer"), robot.listen(PointCloud2, "labels")
    wait_until(lambda: answers and clouds, "latched answers received")
    assert clouds == [labels.cloud]
    texts = [marker for marker in answers[0].markers if marker.type == Marker.TEXT_VIEW_FACING]
    assert [marker.text for marker in texts] == [f"{each.prompt} {each.score:.2f}" for each in reply.instances]
    boxes = [marker for marker in answers[0].markers if marker.type == Marker.CUBE]
    for box, found in zip(boxes, reply.instances, strict=True):
        assert box.pose.position.x == pytest.approx((found.box_min.x + found.box_max.x) / 2)
        assert box.scale.z == pytest.approx(found.box_max.z - found.box_min.z)


def test_a_hundred_queries_at_once_are_all_answered(mapped_robot) -> None:
    client = mapped_robot.user.create_client(QueryText, "fus3dmaps/query_text")
    assert client.wait_for_service(60)
    futures = [client.call_async(QueryText.Request(prompts=["red"], threshold=0.9)) for _ in range(100)]
    # The client keeps ten replies that its thread has not taken yet; the node takes all requests.
    wait_until(lambda: sum(future.done() for future in futures) == 100, "a hundred answers")
    assert all(future.result().success for future in futures)


def test_a_camera_image_itself_can_be_asked_for(mapped_robot) -> None:
    assert mapped_robot.call(QueryImage, "query_image", image=rgb_message(wall_frame(STAMP_NS)), top_k=2).success


def test_top_k_of_images_follows_the_parameter(robot) -> None:
    robot.map(wall_frame(STAMP_NS))
    assert robot.mapper.set_parameters([Parameter("query.top_k", value=1)])[0].successful
    assert len(robot.call(QueryImage, "query_image", image=picture("red")).instances) == 1
