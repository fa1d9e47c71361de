"""Faults of every kind against the live node: each is counted and named, the node lives on, the map keeps what it had."""

from __future__ import annotations

import itertools
import math
import re
import threading
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from compressed_messages import compressed_depth_rvl, jpeg
from robot import (
    TIMEOUT_S,
    Robot,
    camera_info_message,
    compressed_message,
    depth_message,
    header,
    pose_message,
    rgb_message,
    wait_until,
)
from stand_ins import wall_frame

from fus3dmaps_core.frame import PosedFrame
from fus3dmaps_core.saved_maps.directory import map_path
from fus3dmaps_core.saved_maps.storage import load_map
from fus3dmaps_msgs.srv import QueryText, SaveMap
from fus3dmaps_ros.topics.qos import SERVICE_QOS

SECOND_NS = 10**9
START_NS = 1_700_000_000 * SECOND_NS
PAGE = Path(__file__).resolve().parents[2] / "docs" / "reliability.md"


def changed(message: Any, **values: Any) -> Any:
    for name, value in values.items():
        setattr(message, name, value)
    return message


def with_values(make: Callable[[PosedFrame], Any], **values: Any) -> Callable[[PosedFrame], Any]:
    return lambda frame: changed(make(frame), **values)


def pose_with(**values: float) -> Callable[[PosedFrame], Any]:
    """A pose whose position (x, y, z) or orientation (w) is overwritten."""

    def make(frame: PosedFrame) -> Any:
        message = pose_message(frame)
        for name, value in values.items():
            setattr(message.pose.orientation if name == "w" else message.pose.position, name, value)
        return message

    return make


def camera_with(focal_px: float) -> Callable[[PosedFrame], Any]:
    def make(frame: PosedFrame) -> Any:
        message = camera_info_message(frame)
        message.k[0] = focal_px
        return message

    return make


def cut(message: Any, count: int) -> Any:
    """Without the last bytes of its data."""
    del message.data[-count:]
    return message


def later(make: Callable[[PosedFrame], Any], seconds: float) -> Callable[[PosedFrame], Any]:
    return lambda frame: make(replace(frame, stamp_ns=frame.stamp_ns + round(seconds * SECOND_NS)))


@dataclass(frozen=True)
class Fault:
    """One message that is wrong.

    Attributes:
        name: As docs/reliability.md lists it.
        reason: Under which it is counted.
        publisher: On which of the robot's publishers it comes.
        make: Makes it from a frame one second after the last good one.
    """

    name: str
    reason: str
    publisher: str
    make: Callable[[PosedFrame], Any]


FAULTS = (
    Fault("a pose that is not a number", "bad_pose", "pose", pose_with(x=math.nan)),
    Fault("a pose at infinity", "bad_pose", "pose", pose_with(z=math.inf)),
    Fault("a quaternion that is not of unit length", "bad_pose", "pose", pose_with(w=0.3)),
    Fault(
        "a pose in another frame",
        "wrong_frame",
        "pose",
        lambda frame: changed(pose_message(frame), header=header(0, "odom")),
    ),
    Fault("a colour image without pixels", "bad_image", "rgb", with_values(rgb_message, width=0, height=0)),
    Fault("a depth image without pixels", "bad_image", "depth", with_values(depth_message, width=0, height=0)),
    Fault("a colour image of unknown encoding", "unknown_encoding", "rgb", with_values(rgb_message, encoding="yuv422_yuy2")),
    Fault("a depth image on the colour topic", "unknown_encoding", "rgb", depth_message),
    Fault("a colour image on the depth topic", "unknown_encoding", "depth", rgb_message),
    Fault("a colour image whose data is cut", "size_mismatch", "rgb", lambda frame: cut(rgb_message(frame), 100)),
    Fault("a depth image whose data is cut", "size_mismatch", "depth", lambda frame: cut(depth_message(frame), 100)),
    Fault("rows shorter than the width says", "bad_image", "rgb", with_values(rgb_message, step=100)),
    Fault("a camera model without focal length", "bad_intrinsics", "info", camera_with(0.0)),
    Fault("a camera model that is not a number", "bad_intrinsics", "info", camera_with(math.nan)),
    Fault(
        "an unknown lens model", "bad_intrinsics", "info", with_values(camera_info_message, distortion_model="fov", d=[1.0])
    ),
    Fault("intrinsics that change", "intrinsics_changed", "info", camera_with(500.0)),
    Fault("a colour image of another size than its camera model", "size_mismatch", "rgb", lambda _: small_image()),
    Fault(
        "a frame id that changes",
        "frame_id_changed",
        "rgb",
        lambda frame: changed(rgb_message(frame), header=header(frame.stamp_ns, "another_camera")),
    ),
    Fault("a stamp that runs backwards", "stamp_backwards", "rgb", later(rgb_message, -1.5)),
    Fault("a stamp that repeats", "stamp_repeated", "rgb", later(rgb_message, -1.0)),
    Fault("a clock that jumps back an hour", "time_jump", "rgb", later(rgb_message, -3600.0)),
)


def small_image() -> Any:
    frame = wall_frame(START_NS + SECOND_NS)
    rgb = np.ascontiguousarray(frame.rgb[:240, :320])
    return rgb_message(replace(frame, rgb=rgb, intrinsics=frame.intrinsics.resized(320, 240)))


@pytest.fixture
def heard(make_robot) -> Callable[..., tuple[Robot, list[tuple[str, str]]]]:
    """A robot that has mapped a frame, and the drops that it names from then on: reason and sentence."""

    def make(**parameters: Any) -> tuple[Robot, list[tuple[str, str]]]:
        robot = make_robot(**parameters)
        for name, encode in (("rgb", encoded_color), ("depth", encoded_depth)):
            if parameters.get(f"input.{name}_transport"):
                robot.makers[name] = encode
        robot.map(wall_frame(START_NS))
        drops: list[tuple[str, str]] = []
        robot.mapper.drops.tell(lambda reason, sentence, number: drops.append((reason, sentence)))
        return robot, drops

    return make


def encoded_color(frame: PosedFrame) -> Any:
    return compressed_message(frame.stamp_ns, *jpeg(frame.rgb))


def encoded_depth(frame: PosedFrame) -> Any:
    return compressed_message(frame.stamp_ns, *compressed_depth_rvl((1000 * frame.depth_m).astype(np.uint16)))


def content(robot: Robot) -> dict[str, bytes]:
    return {name: array.tobytes() for name, array in robot.mapper.pipeline.semantic_map.export_state().items()}


def check_it_lives(robot: Robot, stamp_ns: int) -> None:
    """A good frame is mapped and a question answered."""
    voxels = robot.mapper.pipeline.semantic_map.voxel_count
    robot.map(wall_frame(stamp_ns, x_m=-0.7))
    assert robot.mapper.pipeline.semantic_map.voxel_count > voxels
    assert robot.call(QueryText, "query_text", prompts=["red"]).success


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)
def test_a_bad_message_is_counted_and_named_and_costs_nothing(heard, fault: Fault) -> None:
    robot, drops = heard()
    before, counted = content(robot), robot.mapper.drops.counts()[fault.reason]
    topic = {"info": "rgb/camera_info", "pose": "pose"}.get(fault.publisher, f"{fault.publisher}/image")
    robot.publishers[fault.publisher].publish(fault.make(wall_frame(START_NS + SECOND_NS)))
    wait_until(lambda: any(reason == fault.reason for reason, _ in drops), f"{fault.name} is counted as {fault.reason}")
    assert robot.mapper.drops.counts()[fault.reason] > counted
    assert any(topic in sentence for reason, sentence in drops if reason == fault.reason)
    assert content(robot) == before
    jumped_back = fault.reason == "time_jump"
    check_it_lives(robot, START_NS + (-3500 if jumped_back else 20) * SECOND_NS)


@pytest.mark.parametrize(("name", "size"), [("rgb", 400), ("depth", 40)], ids=["truncated JPEG", "truncated depth"])
def test_truncated_compressed_data_is_counted_and_named(heard, name: str, size: int) -> None:
    robot, drops = heard(**{"input.rgb_transport": "compressed", "input.depth_transport": "compressedDepth"})
    before = content(robot)
    for outlet, publisher in robot.publishers.items():
        message = robot.makers[outlet](wall_frame(START_NS + SECOND_NS, x_m=0.5))
        publisher.publish(cut(message, size) if outlet == name else message)
    wait_until(lambda: any(reason == "bad_compression" for reason, _ in drops), "counted")
    assert any(f"{name}/image" in sentence for reason, sentence in drops if reason == "bad_compression")
    assert content(robot) == before
    check_it_lives(robot, START_NS + 20 * SECOND_NS)


def test_depth_without_a_reading_maps_nothing(robot) -> None:
    robot.map(wall_frame(START_NS))
    before = content(robot)
    blind = wall_frame(START_NS + SECOND_NS, x_m=0.3)
    for value in (math.nan, math.inf, -1.0):
        blind = replace(blind, stamp_ns=blind.stamp_ns + SECOND_NS // 10, depth_m=np.full((480, 640), value, np.float32))
        robot.show(blind)
    wait_until(lambda: robot.mapper.worker.ledger.counts().frames == 4 and not robot.mapper.worker.waiting, "all taken")
    check_it_lives(robot, START_NS + 20 * SECOND_NS)
    assert len(before["voxel_coordinates"]) < len(content(robot)["voxel_coordinates"])


def test_ten_times_the_rate_drops_the_oldest_and_counts_them(heard, monkeypatch) -> None:
    robot, drops = heard(**{"node.queue_size": 2})
    process = robot.mapper.pipeline.process

    def ten_times_slower(frame: PosedFrame) -> Any:
        target = counted() + 10
        wait_until(lambda: counted() >= target or flooded.is_set(), "ten frames came meanwhile")
        return process(frame)

    def counted() -> int:
        return robot.mapper.worker.ledger.counts().frames

    flooded = threading.Event()
    monkeypatch.setattr(robot.mapper.pipeline, "process", ten_times_slower)
    numbers = itertools.count(1)

    def show_another() -> bool:
        number = next(numbers)
        robot.show(wall_frame(START_NS + number * SECOND_NS // 300, x_m=0.02 * number))
        return robot.mapper.drops.counts()["queue_full"] >= 30

    wait_until(show_another, "thirty frames had to go")
    flooded.set()
    wait_until(lambda: not robot.mapper.worker.waiting, "the queue is empty")
    assert any(reason == "queue_full" for reason, _ in drops)
    monkeypatch.undo()
    check_it_lives(robot, START_NS + 20 * SECOND_NS)


def test_publishers_that_restart_are_heard_again(robot) -> None:
    robot.map(wall_frame(START_NS))
    for name, old in list(robot.publishers.items()):
        robot.publishers[name] = robot.user.create_publisher(old.msg_type, old.topic_name, old.qos_profile)
        robot.user.destroy_publisher(old)
    robot.connect()
    check_it_lives(robot, START_NS + 20 * SECOND_NS)


def test_two_publishers_of_one_topic_are_told_by_their_stamps(heard) -> None:
    robot, drops = heard()
    outlet = robot.publishers["rgb"]
    other = robot.user.create_publisher(outlet.msg_type, outlet.topic_name, outlet.qos_profile)
    wait_until(lambda: other.get_subscription_count() == 1, "the second one is matched")
    frame = wall_frame(START_NS + SECOND_NS, x_m=0.5)
    robot.map(frame)
    other.publish(rgb_message(frame))
    other.publish(rgb_message(replace(frame, stamp_ns=frame.stamp_ns - SECOND_NS // 2)))
    wait_until(lambda: {"stamp_repeated", "stamp_backwards"} <= {reason for reason, _ in drops}, "both are counted")
    assert robot.mapper.drops.counts()["stamp_repeated"] == 1


@pytest.mark.parametrize(
    ("prompt", "success"),
    [
        ("x" * 2**20, False),
        ("\u202e\U0001f9a5\u0301 \ud55c\uae00", True),
        ("\n\t\u200b", True),
        ("\u00a0", False),
        ("'; DROP TABLE voxels; --", True),
    ],
    ids=["a prompt of 1 MB", "odd Unicode", "control characters", "a blank that is no space", "quotes"],
)
def test_odd_prompts_are_answered_or_refused(mapped_robot, prompt: str, success: bool) -> None:
    reply = mapped_robot.call(QueryText, "query_text", prompts=[prompt])
    assert reply.success == success, reply.message
    assert success or "prompts[0]" in reply.message


def test_a_hundred_queries_at_once_are_all_answered(robot) -> None:
    robot.map(wall_frame(START_NS))
    # With the default, the user's own side would keep ten requests and ten replies.
    client = robot.user.create_client(QueryText, "fus3dmaps/query_text", qos_profile=SERVICE_QOS)
    assert client.wait_for_service(TIMEOUT_S)
    futures = [client.call_async(QueryText.Request(prompts=["red"])) for _ in range(100)]
    wait_until(lambda: all(future.done() for future in futures), "100 replies")
    replies = [future.result() for future in futures]
    assert all(reply.success for reply in replies)
    assert {tuple(found.id for found in reply.instances) for reply in replies} == {
        tuple(found.id for found in replies[0].instances)
    }
    robot.user.destroy_client(client)


def test_a_full_disk_refuses_the_save_and_the_last_map_stays(heard, tmp_path, monkeypatch) -> None:
    robot, _ = heard(**{"node.map_directory": str(tmp_path)})
    assert robot.call(SaveMap, "save_map", name="home").success

    def no_space(*_: Any, **__: Any) -> int:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr("fus3dmaps_core.saved_maps.files.np.save", no_space)
        robot.map(wall_frame(START_NS + SECOND_NS, x_m=0.5))
        reply = robot.call(SaveMap, "save_map", name="home")
    assert not reply.success
    assert "No space left" in reply.message
    assert load_map(map_path(tmp_path, "home"))[0].voxel_count > 0
    check_it_lives(robot, START_NS + 20 * SECOND_NS)


def test_the_page_lists_the_faults() -> None:
    rows = re.findall(r"^\| ([^|]+?) \| `(\w+)`", PAGE.read_text(), flags=re.MULTILINE)
    assert set(rows) >= {(fault.name, fault.reason) for fault in FAULTS}
