"""What is published, with which QoS, and when."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from nav_msgs.msg import Path
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy
from robot import RELIABLE_INPUTS, wait_until
from sensor_msgs.msg import PointCloud2
from stand_ins import wall_frame
from std_srvs.srv import Trigger
from visualization_msgs.msg import MarkerArray

from fus3dmaps_msgs.srv import QueryText
from fus3dmaps_ros.topics.conversions import from_cloud

STAMP_NS = 1_700_000_000_123_456_789


def stamp_of(message: Any) -> int:
    return message.header.stamp.sec * 10**9 + message.header.stamp.nanosec


@pytest.mark.parametrize("name", ["similarity", "map", "instances", "path"])
def test_outputs_are_reliable_and_latched(mapped_robot, name) -> None:
    (endpoint,) = mapped_robot.user.get_publishers_info_by_topic(f"{mapped_robot.namespace}/fus3dmaps/{name}")
    assert endpoint.qos_profile.reliability == ReliabilityPolicy.RELIABLE
    assert endpoint.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL


@pytest.mark.parametrize(
    ("profile", "reliability"),
    [("sensor_data", ReliabilityPolicy.BEST_EFFORT), ("reliable", ReliabilityPolicy.RELIABLE)],
)
def test_inputs_have_the_qos_of_their_profile(make_robot, profile, reliability) -> None:
    robot = make_robot(**dict.fromkeys(RELIABLE_INPUTS, profile))
    for topic in ("rgb/image", "depth/image", "rgb/camera_info", "pose"):
        (endpoint,) = robot.user.get_subscriptions_info_by_topic(f"{robot.namespace}/{topic}")
        assert endpoint.qos_profile.reliability == reliability
        assert endpoint.qos_profile.durability == DurabilityPolicy.VOLATILE


def test_the_map_is_published_to_who_listens(mapped_robot) -> None:
    clouds = mapped_robot.listen(PointCloud2, "map")
    wait_until(lambda: clouds, "map received")
    assert (clouds[0].header.frame_id, stamp_of(clouds[0])) == ("map", STAMP_NS)
    table = from_cloud(clouds[0])
    voxels = mapped_robot.mapper.pipeline.semantic_map.voxels()
    assert table.dtype.names == ("x", "y", "z", "rgb", "instance")
    np.testing.assert_array_equal(np.stack([table[axis] for axis in "xyz"], axis=1), voxels.centers_m)
    np.testing.assert_array_equal(table["instance"], voxels.top_instance)


def test_instances_and_path_are_published_to_who_listens(mapped_robot) -> None:
    arrays, paths = mapped_robot.listen(MarkerArray, "instances"), mapped_robot.listen(Path, "path")
    wait_until(lambda: arrays and paths, "instances and path received")
    instances = mapped_robot.mapper.pipeline.semantic_map.instances()
    drawn = {marker.id for marker in arrays[0].markers if marker.ns == "boxes"}
    assert drawn == set(instances.ids[instances.voxel_counts >= 4].tolist())
    assert len(paths[0].poses) == 1


def test_an_unchanged_map_is_sent_once_and_a_changed_one_again(robot) -> None:
    robot.map(wall_frame(STAMP_NS))
    clouds = robot.listen(PointCloud2, "map")
    wait_until(lambda: clouds, "map received")
    robot.map(wall_frame(STAMP_NS + 10**9, x_m=0.5))
    wait_until(lambda: stamp_of(clouds[-1]) == STAMP_NS + 10**9, "changed map received")
    stamps = [stamp_of(cloud) for cloud in clouds]
    assert stamps == sorted(set(stamps))


def test_a_published_answer_is_latched_and_cleared_by_a_reset(robot) -> None:
    robot.map(wall_frame(STAMP_NS))
    silent = robot.call(QueryText, "query_text", prompts=["blue"])
    loud = robot.call(QueryText, "query_text", prompts=["red"], publish=True)
    late = robot.listen(PointCloud2, "similarity")
    wait_until(lambda: late, "latched answer received")
    assert late == [loud.similarity]
    assert silent.similarity != loud.similarity
    assert robot.call(Trigger, "reset").success
    wait_until(lambda: len(late) == 2, "cleared answer received")
    assert late[1].width == 0
    assert [field.name for field in late[1].fields] == ["x", "y", "z", "similarity", "rgb"]
