"""TF through tf2's own interface: a stand-in everywhere, and tf2_ros itself where it is installed."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from importlib.util import find_spec

import numpy as np
import pytest
import rclpy
import ros_messages as ros
import tf_stand_in
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from rclpy.context import Context
from rclpy.node import Node
from robot import Robot, wait_until
from scipy.spatial.transform import Rotation
from stand_ins import wall_frame

from fus3dmaps_core.errors import ConfigError
from fus3dmaps_core.sources.transforms import NoTransform, TransformGap, TransformTree
from fus3dmaps_ros.topics.tf_poses import TfListener

S = 10**9
START_NS = 1_700_000_000 * S
INSTALLED = ["stand_in", *(["tf2_ros"] if find_spec("tf2_ros") else [])]


@pytest.fixture
def node() -> Iterator[Node]:
    context = Context()
    rclpy.init(args=[], context=context)
    node = Node("listener", context=context)
    yield node
    node.destroy_node()
    rclpy.shutdown(context=context)


@pytest.fixture(params=INSTALLED)
def listener(request, monkeypatch, node) -> TfListener:
    if request.param == "stand_in":
        tf_stand_in.install(monkeypatch)
    return TfListener(node)


def pose(x_m: float, yaw_rad: float = 0.0) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("z", yaw_rad).as_matrix()
    T[0, 3] = x_m
    return T


def move(listener: TfListener, parent: str, child: str, stamp_ns: int, T: np.ndarray) -> None:
    listener._buffer.set_transform(tf_stand_in.stamped(parent, child, stamp_ns, T), "test")


def fix(listener: TfListener, parent: str, child: str, T: np.ndarray) -> None:
    listener._buffer.set_transform_static(tf_stand_in.stamped(parent, child, 0, T), "test")


def test_a_chain_is_interpolated_to_the_stamp(listener) -> None:
    for offset_ns, x_m, yaw_rad in ((0, 0.0, 0.0), (S, 2.0, 1.0)):
        move(listener, "map", "odom", START_NS + offset_ns, pose(x_m, yaw_rad))
    fix(listener, "odom", "camera", pose(1.0))
    T = listener.lookup("/map", "/camera", START_NS + S // 4)
    np.testing.assert_allclose(T, pose(0.5, 0.25) @ pose(1.0), atol=1e-9)
    back = listener.lookup("camera", "map", START_NS + S // 4)
    np.testing.assert_allclose(back @ T, np.eye(4), atol=1e-9)
    np.testing.assert_allclose(listener.lookup("odom", "camera", 5), pose(1.0), atol=1e-12)


def test_why_there_is_no_transform(listener) -> None:
    for offset_ns in (0, S):
        move(listener, "map", "base", START_NS + offset_ns, pose(1.0))
    fix(listener, "elsewhere", "island", pose(1.0))
    for target, source, stamp_ns, gap, named in (
        ("map", "camera", START_NS, TransformGap.UNKNOWN_FRAME, "camera"),
        ("map", "island", START_NS, TransformGap.NOT_CONNECTED, "island"),
        ("map", "base", START_NS + S + 1, TransformGap.AFTER_LAST, "future"),
        ("map", "base", START_NS - 1, TransformGap.BEFORE_FIRST, "past"),
    ):
        answer = listener.lookup(target, source, stamp_ns)
        assert isinstance(answer, NoTransform)
        assert answer.gap == gap
        assert named in answer.detail


def test_a_stamp_between_edges_that_share_no_time_may_still_be_known(listener) -> None:
    """One edge lags: the other one's history begins after the lagging one's end."""
    move(listener, "map", "odom", START_NS, pose(1.0))
    move(listener, "odom", "base", START_NS + S, pose(1.0))
    answer = listener.lookup("map", "base", START_NS + S)
    assert isinstance(answer, NoTransform)
    assert answer.gap == TransformGap.AFTER_LAST


def test_what_moved_is_forgotten_and_what_is_fixed_stays(listener) -> None:
    move(listener, "map", "base", START_NS, pose(1.0))
    fix(listener, "base", "camera", pose(1.0))
    listener.clear()
    assert isinstance(listener.lookup("map", "camera", START_NS), NoTransform)
    np.testing.assert_allclose(listener.lookup("base", "camera", START_NS), pose(1.0), atol=1e-12)


def test_without_tf2_the_package_is_named(node, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "tf2_ros", None)  # As if it were not installed.
    with pytest.raises(ConfigError, match=r"input\.pose_source.*apt install ros-jazzy-tf2-ros-py"):
        TfListener(node)


EDGES = st.lists(
    st.tuples(
        st.sampled_from(["a", "b", "c"]),
        st.integers(0, 40),
        st.tuples(*[st.floats(-3, 3)] * 6),
    ),
    min_size=1,
    max_size=30,
)


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(edges=EDGES, stamp=st.integers(0, 40), target=st.sampled_from("mabc"), source=st.sampled_from("mabc"))
def test_the_tree_for_recordings_agrees_with_tf2(node, edges, stamp, target, source) -> None:
    """Frames a, b, c hang from each other in a chain under m; each edge has samples at random times, c is fixed."""
    parents = {"a": "m", "b": "a", "c": "b"}
    with pytest.MonkeyPatch.context() as monkeypatch:
        tf_stand_in.install(monkeypatch)
        listener = TfListener(node)
    tree = TransformTree(max_gap_s=100.0)
    seen = set()
    for child, tenths, values in sorted(edges, key=lambda edge: (edge[0], edge[1])):
        if (child, tenths) in seen:
            continue
        seen.add((child, tenths))
        T = np.eye(4)
        T[:3, :3] = Rotation.from_rotvec(np.array(values[:3]) / 2).as_matrix()
        T[:3, 3] = values[3:]
        message = tf_stand_in.stamped(parents[child], child, START_NS + tenths * S // 10, T)
        fixed = child == "c"
        (fix if fixed else move)(listener, parents[child], child, *([T] if fixed else [tf_stand_in.stamp_of(message), T]))
        assert not tree.add(ros.make("tf2_msgs/msg/TFMessage", [message]), "/tf", static=fixed)
    if target == source:
        return
    stamp_ns = START_NS + stamp * S // 10
    expected, found = listener.lookup(target, source, stamp_ns), tree.lookup(target, source, stamp_ns)
    if isinstance(expected, NoTransform):
        assert isinstance(found, NoTransform)
        ended = {TransformGap.BEFORE_FIRST, TransformGap.AFTER_LAST}  # With two edges lacking, which is named first differs.
        assert found.gap == expected.gap or {found.gap, expected.gap} <= ended
    else:
        np.testing.assert_allclose(found, expected, atol=1e-9)


@pytest.fixture
def tf_robot(make_robot, monkeypatch) -> Robot:
    tf_stand_in.install(monkeypatch)
    return make_robot(**{"input.pose_source": "tf", "input.tf_timeout_s": 1.0, "input.camera_frame": "optical"})


def test_an_image_waits_for_its_transform(tf_robot) -> None:
    buffer = tf_stand_in.latest_buffer()
    frame = wall_frame(START_NS + S // 2, x_m=0.25)
    tf_robot.show(frame)
    for offset_ns, x_m in ((0, 0.0), (S, 0.5)):
        buffer.set_transform(tf_stand_in.stamped("map", "optical", START_NS + offset_ns, pose(x_m)), "test")
    wait_until(lambda: tf_robot.mapper.worker.stamp_ns == frame.stamp_ns, "frame mapped")
    assert not tf_robot.mapper.drops.counts()


def test_images_without_a_transform_are_given_up_by_name(tf_robot) -> None:
    for i in range(4):
        tf_robot.show(wall_frame(START_NS + i * S))
    wait_until(lambda: tf_robot.mapper.drops.counts() == {"tf_unknown_frame": 2}, "two are past the timeout")


def test_a_closed_robot_listens_to_tf_no_more(tf_robot) -> None:
    inputs = tf_robot.mapper._inputs
    inputs.close()
    assert not inputs._tf._listener.listening
