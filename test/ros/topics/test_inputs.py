"""Bad input is counted and named, and mapping goes on."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import rclpy
from rclpy.context import Context
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy
from robot import (
    CallbackThreads,
    camera_info_message,
    depth_message,
    header,
    pose_message,
    rgb_message,
    wait_until,
)
from sensor_msgs.msg import CameraInfo, Image
from stand_ins import wall_frame

from fus3dmaps_core.config.schema import Config
from fus3dmaps_core.ledger import Drops
from fus3dmaps_ros.node.drop_log import DropLog
from fus3dmaps_ros.topics.inputs import Inputs
from fus3dmaps_ros.topics.qos import named_qos

SECOND_NS = 10**9
START_NS = 1_700_000_000 * SECOND_NS


def changed(message: Any, **values: Any) -> Any:
    for name, value in values.items():
        setattr(message, name, value)
    return message


def nan_pose(frame: Any) -> Any:
    message = pose_message(frame)
    message.pose.position.x = math.nan
    return message


def unnormalised_pose(frame: Any) -> Any:
    message = pose_message(frame)
    message.pose.orientation.w = 0.3
    return message


def no_focal_length(frame: Any) -> Any:
    message = camera_info_message(frame)
    message.k[0] = 0.0
    return message


FAULTS: list[tuple[str, str, str, Callable[[Any], Any]]] = [
    ("bad_pose", "pose", "pose", nan_pose),
    ("bad_pose", "pose", "pose", unnormalised_pose),
    ("wrong_frame", "pose", "pose", lambda frame: changed(pose_message(frame), header=header(frame.stamp_ns, "odom"))),
    ("unknown_encoding", "rgb", "rgb/image", lambda frame: changed(rgb_message(frame), encoding="yuv422")),
    ("unknown_encoding", "depth", "depth/image", lambda frame: changed(depth_message(frame), encoding="rgb8")),
    ("size_mismatch", "rgb", "rgb/image", lambda frame: changed(rgb_message(frame), height=479)),
    ("size_mismatch", "depth", "depth/image", lambda frame: changed(depth_message(frame), height=481)),
    ("bad_image", "rgb", "rgb/image", lambda frame: changed(rgb_message(frame), step=3)),
    ("bad_intrinsics", "info", "rgb/camera_info", no_focal_length),
]


def test_every_bad_message_is_counted_and_mapping_goes_on(robot) -> None:
    robot.map(wall_frame(START_NS))
    expected: dict[str, int] = {}
    for index, (reason, stream, _, make) in enumerate(FAULTS):
        robot.publishers[stream].publish(make(wall_frame(START_NS + (1 + index) * SECOND_NS // 10, x_m=1.0)))
        expected[reason] = expected.get(reason, 0) + 1
        wait_until(lambda: robot.mapper.drops.counts() == expected, f"counted: {expected}")
    robot.map(wall_frame(START_NS + 2 * SECOND_NS, x_m=0.5))
    assert robot.mapper.drops.counts() == expected
    for reason, count in expected.items():
        assert f"{reason} {count}" in robot.mapper.status()


@pytest.mark.parametrize(("reason", "stream", "topic", "make"), FAULTS)
def test_the_log_names_the_topic(robot_with_log, reason, stream, topic, make) -> None:
    robot, lines = robot_with_log
    robot.publishers["info"].publish(camera_info_message(wall_frame(START_NS)))
    robot.publishers[stream].publish(make(wall_frame(START_NS)))
    wait_until(lambda: any(f"({reason}): {topic}" in line for line in lines), f"{reason} logged")


@pytest.fixture
def robot_with_log(make_robot, monkeypatch):
    """A robot and the lines it logs as drops."""
    lines: list[str] = []
    monkeypatch.setattr("fus3dmaps_ros.mapper_node.DropLog", lambda warn: DropLog(lines.append))
    return make_robot(), lines


def test_stamps_that_run_backwards_are_counted_and_a_restart_is_followed(robot) -> None:
    robot.map(wall_frame(START_NS))
    robot.publishers["rgb"].publish(rgb_message(wall_frame(START_NS - SECOND_NS)))
    robot.publishers["depth"].publish(depth_message(wall_frame(START_NS - SECOND_NS)))
    wait_until(lambda: robot.mapper.drops.counts()["stamp_backwards"] == 2, "backward stamps counted")
    robot.map(wall_frame(START_NS + SECOND_NS, x_m=0.5))
    # A simulation that starts again.
    robot.map(wall_frame(SECOND_NS, x_m=1.0))
    assert robot.mapper.drops.counts()["time_jump"] >= 1


def test_an_image_without_depth_or_pose_is_given_up_and_counted(robot) -> None:
    robot.map(wall_frame(START_NS))
    lonely = wall_frame(START_NS + SECOND_NS)
    robot.publishers["rgb"].publish(rgb_message(lonely))
    robot.map(wall_frame(START_NS + 5 * SECOND_NS, x_m=0.5))
    counts = robot.mapper.drops.counts()
    assert counts["no_depth"] + counts["no_pose"] + counts["pose_gap"] == 1


def test_a_closed_robot_hears_nothing(robot) -> None:
    robot.map(wall_frame(START_NS))
    robot.mapper._inputs.close()
    robot.mapper._inputs.close()
    wait_until(
        lambda: not any(publisher.get_subscription_count() for publisher in robot.publishers.values()), "unsubscribed"
    )


def test_changes_of_the_camera_are_counted_and_followed(robot) -> None:
    robot.map(wall_frame(START_NS))
    frame = wall_frame(START_NS + SECOND_NS, x_m=0.5)
    closer = replace(frame, intrinsics=replace(frame.intrinsics, fx=600.0))
    robot.makers["rgb"] = lambda frame: changed(rgb_message(frame), header=header(frame.stamp_ns, "another_camera"))
    robot.map(closer)
    robot.map(replace(closer, stamp_ns=START_NS + 2 * SECOND_NS, T_world_camera=np.eye(4)))
    assert robot.mapper.drops.counts() == {"intrinsics_changed": 1, "frame_id_changed": 1}


@pytest.mark.parametrize(
    ("profile", "reliability", "durability"),
    [
        ("sensor_data", ReliabilityPolicy.BEST_EFFORT, DurabilityPolicy.VOLATILE),
        ("reliable", ReliabilityPolicy.RELIABLE, DurabilityPolicy.VOLATILE),
        ("transient_local", ReliabilityPolicy.RELIABLE, DurabilityPolicy.TRANSIENT_LOCAL),
        ("best_available", ReliabilityPolicy.RELIABLE, DurabilityPolicy.TRANSIENT_LOCAL),  # Nobody offers less.
    ],
)
def test_each_input_has_the_qos_of_its_profile(profile, reliability, durability) -> None:
    with node_alone() as node:
        config = Config().with_values({"input.depth_qos": profile})
        inputs = Inputs(node, config, lambda paired: None, Drops())
        found = {}
        for topic in ("rgb/image", "depth/image", "rgb/camera_info", "pose"):
            (endpoint,) = node.get_subscriptions_info_by_topic(f"/{topic}")
            found[topic] = (endpoint.qos_profile.reliability, endpoint.qos_profile.durability)
        default = (ReliabilityPolicy.BEST_EFFORT, DurabilityPolicy.VOLATILE)
        assert found == {**dict.fromkeys(found, default), "depth/image": (reliability, durability)}
        inputs.close()


def test_best_available_takes_what_the_publisher_offers() -> None:
    with node_alone() as node:
        node.create_publisher(Image, "depth/image", named_qos("sensor_data", 1))
        config = Config().with_values({"input.depth_qos": "best_available"})
        inputs = Inputs(node, config, lambda paired: None, Drops())
        (endpoint,) = node.get_subscriptions_info_by_topic("/depth/image")
        assert endpoint.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT
        assert endpoint.qos_profile.durability == DurabilityPolicy.VOLATILE
        inputs.close()


def test_a_latched_camera_model_is_heard_by_who_comes_late() -> None:
    with node_alone() as node:
        latched = node.create_publisher(CameraInfo, "rgb/camera_info", named_qos("transient_local", 1))
        latched.publish(camera_info_message(wall_frame(START_NS)))
        config = Config().with_values({"input.camera_info_qos": "transient_local"})
        heard: list[tuple[str, int]] = []
        Inputs(node, config, lambda paired: None, Drops(), lambda topic, stamp_ns: heard.append((topic, stamp_ns)))
        with CallbackThreads(node.context, node):
            wait_until(lambda: heard == [("rgb/camera_info", START_NS)], "camera model heard")


@contextmanager
def node_alone() -> Iterator[Node]:
    context = Context()
    rclpy.init(args=[], context=context)
    node = Node("alone", context=context)
    try:
        yield node
    finally:
        node.destroy_node()
        rclpy.shutdown(context=context)
