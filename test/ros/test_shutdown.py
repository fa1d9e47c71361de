"""A signal ends the node, and a map that is saved by period is saved a last time."""

from __future__ import annotations

import signal
import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped
from node_process import STAND_IN, end, wait_for_line
from rclpy.node import Node
from robot import TIMEOUT_S, camera_info_message, depth_message, pose_message, rgb_message, wait_until
from sensor_msgs.msg import CameraInfo, Image
from stand_ins import wall_frame

from fus3dmaps_core.frame import PosedFrame
from fus3dmaps_core.saved_maps.directory import list_maps, map_path
from fus3dmaps_core.saved_maps.storage import load_map
from fus3dmaps_msgs.srv import QueryText
from fus3dmaps_ros.topics.qos import named_qos

START_NS = 1_700_000_000 * 10**9
FRAMES = [wall_frame(START_NS + number * 10**8, x_m=0.5 * number) for number in range(4)]
OUTLETS = (
    (CameraInfo, "rgb/camera_info", camera_info_message),
    (PoseStamped, "pose", pose_message),
    (Image, "rgb/image", rgb_message),
    (Image, "depth/image", depth_message),
)


class Camera:
    """What a node in another process sees."""

    def __init__(self, user: Node) -> None:
        self._user = user
        qos = named_qos("transient_local", 100)  # Whatever discovery has not done yet, nothing is lost.
        self._publishers = [(user.create_publisher(kind, topic, qos), make) for kind, topic, make in OUTLETS]
        self._client = user.create_client(QueryText, "/fus3dmaps/query_text")

    def map(self, frames: list[PosedFrame]) -> None:
        """Publish frames and wait until the last one is in the map."""
        assert self._client.wait_for_service(TIMEOUT_S)
        for frame in frames:
            for publisher, make in self._publishers:
                publisher.publish(make(frame))
        wait_until(lambda: self._mapped_ns() == frames[-1].stamp_ns, "the last frame mapped")

    def _mapped_ns(self) -> int:
        future = self._client.call_async(QueryText.Request(prompts=["red"]))
        wait_until(future.done, "an answer")
        stamp = future.result().similarity.header.stamp
        return stamp.sec * 10**9 + stamp.nanosec


@pytest.fixture
def camera(user) -> Camera:
    return Camera(user)


@pytest.fixture
def start_saving(start, tmp_path) -> Callable[..., subprocess.Popen[str]]:
    """Starts a node that saves by a period that never ends."""

    def begin(*arguments: str, period_s: float = 3600.0, **environment: str) -> subprocess.Popen[str]:
        parameters = {
            "node.map_directory": str(tmp_path),
            "node.autosave_period_s": str(period_s),
            "node.queue_size": str(len(FRAMES)),
        }
        parameters |= {f"input.{stream}_qos": "transient_local" for stream in ("rgb", "depth", "camera_info", "pose")}
        given = [word for name, value in parameters.items() for word in ("-p", f"{name}:={value}")]
        return start([*STAND_IN, "--ros-args", *given, *arguments], **environment)

    return begin


def check_newest(root: Path, frames: list[PosedFrame]) -> None:
    """The newest map holds these frames."""
    semantic_map, info = load_map(map_path(root, list_maps(root)[0]))
    assert semantic_map.voxel_count > 500
    assert info.stamp_ns == frames[-1].stamp_ns
    np.testing.assert_array_equal(info.camera_poses, [frame.T_world_camera for frame in frames])


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_what_was_mapped_since_the_last_save_is_saved_at_the_end(start_saving, camera, tmp_path, number) -> None:
    node = start_saving()
    camera.map(FRAMES)
    assert list_maps(tmp_path) == []
    output = end(node, number)
    assert "saving the map" in output
    assert "in the middle of" not in output
    check_newest(tmp_path, FRAMES)


def test_a_map_that_has_not_changed_or_is_not_saved_by_period_is_left(start_saving, camera, tmp_path) -> None:
    node = start_saving(period_s=0.0)
    camera.map(FRAMES[:1])
    assert "saving the map" not in end(node, signal.SIGTERM)
    assert list_maps(tmp_path) == []
    assert "saving the map" not in end(ready(start_saving()), signal.SIGTERM)
    assert list_maps(tmp_path) == []


def has_ended(node: subprocess.Popen[str], number: signal.Signals) -> bool:
    """Whether it has; else it is signalled: signals that come together count as one."""
    node.send_signal(number)
    return node.poll() is not None


def ready(node: subprocess.Popen[str]) -> subprocess.Popen[str]:
    wait_for_line(node, "ready")
    return node


@pytest.mark.parametrize("hurried", [True, False], ids=["a second signal", "the time limit"])
def test_a_last_save_that_hangs_is_given_up_and_the_map_before_it_stays(start_saving, camera, tmp_path, hurried) -> None:
    first = start_saving()
    camera.map(FRAMES[:2])
    end(first, signal.SIGTERM)

    limit_s = 3600.0 if hurried else 1.0
    second = start_saving("-p", "node.resume:=true", "-p", f"node.service_timeout_s:={limit_s}", HANGING_SAVES="1")
    camera.map(FRAMES[2:])
    second.send_signal(signal.SIGINT)
    wait_for_line(second, "before the commit")
    if hurried:
        wait_until(lambda: has_ended(second, signal.SIGTERM), "ended in the middle of the save")
    output, _ = second.communicate(timeout=TIMEOUT_S)
    assert second.returncode == 0, output
    assert "ending in the middle of a save" in output
    assert "Traceback" not in output
    check_newest(tmp_path, FRAMES[:2])
