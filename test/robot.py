"""A mapper node with stand-in models in this process, and a user who plays its camera and calls its services."""

from __future__ import annotations

import itertools
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import rclpy
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseStamped
from rclpy.context import Context
from rclpy.node import Node
from rclpy.parameter import Parameter
from sensor_msgs.msg import CameraInfo, Image
from stand_ins import ColorSegmenter, color_trio
from std_msgs.msg import Header

from fus3dmaps_core.frame import PosedFrame
from fus3dmaps_core.pipeline import Pipeline
from fus3dmaps_ros.inputs import input_qos
from fus3dmaps_ros.mapper_node import CallbackExecutor, MapperNode

TIMEOUT_S = 60.0


def wait_until(condition: Callable[[], Any], what: str) -> Any:
    """Poll until a condition holds, and fail naming it if it never does."""
    deadline = time.monotonic() + TIMEOUT_S
    while time.monotonic() < deadline:
        found = condition()
        if found:
            return found
        time.sleep(0.01)
    pytest.fail(f"did not happen within {TIMEOUT_S:.0f} s: {what}")


def stand_in_pipeline(config: Any) -> Pipeline:
    return Pipeline(config, color_trio(), ColorSegmenter())


def header(stamp_ns: int, frame: str = "camera") -> Header:
    return Header(stamp=Time(sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9), frame_id=frame)


def rgb_message(frame: PosedFrame) -> Image:
    height, width = frame.rgb.shape[:2]
    return _image(frame.stamp_ns, height, width, "rgb8", 3 * width, frame.rgb)


def depth_message(frame: PosedFrame) -> Image:
    height, width = frame.depth_m.shape
    return _image(frame.stamp_ns, height, width, "32FC1", 4 * width, frame.depth_m)


def _image(stamp_ns: int, height: int, width: int, encoding: str, step: int, pixels: np.ndarray) -> Image:
    message = Image(header=header(stamp_ns), height=height, width=width, encoding=encoding, step=step)
    message.data.frombytes(pixels.tobytes())
    return message


def camera_info_message(frame: PosedFrame) -> CameraInfo:
    camera = frame.intrinsics
    message = CameraInfo(header=header(frame.stamp_ns), height=camera.height, width=camera.width)
    message.k = camera.matrix.reshape(-1)
    return message


def pose_message(frame: PosedFrame) -> PoseStamped:
    """The stand-in camera never turns."""
    message = PoseStamped(header=header(frame.stamp_ns, "map"))
    position = message.pose.position
    position.x, position.y, position.z = (float(value) for value in frame.T_world_camera[:3, 3])
    message.pose.orientation.w = 1.0
    return message


class CallbackThreads:
    """Runs the callbacks of nodes, each in threads of its own, for as long as the context lasts."""

    def __init__(self, context: Context, *nodes: Node) -> None:
        self._executors = [CallbackExecutor(4, context=context) for _ in nodes]
        self._threads = [threading.Thread(target=executor.spin, daemon=True) for executor in self._executors]
        for executor, node in zip(self._executors, nodes, strict=True):
            executor.add_node(node)

    def __enter__(self) -> None:
        for thread in self._threads:
            thread.start()

    def __exit__(self, *_: object) -> None:
        assert all(executor.finish(TIMEOUT_S) for executor in self._executors)
        for thread in self._threads:
            thread.join(TIMEOUT_S)
            assert not thread.is_alive()


_numbers = itertools.count()


class Robot:
    """A mapper node with stand-in models, and a second node that plays the camera and the user."""

    def __init__(self, make_pipeline: Callable[[Any], Pipeline] = stand_in_pipeline, **parameters: Any) -> None:
        self._odometry = parameters.get("input.pose_source") == "odometry"
        self.context = Context()
        rclpy.init(args=[], context=self.context)
        # Robots of several tests may live at the same time.
        self.namespace = f"/robot_{next(_numbers)}"
        overrides = {"node.input_qos": "reliable", "node.publish_period_s": 0.1, "node.queue_size": 100, **parameters}
        self.mapper = MapperNode(
            make_pipeline,
            context=self.context,
            namespace=self.namespace,
            parameter_overrides=[Parameter(name, value=value) for name, value in overrides.items()],
        )
        self.user = Node("user", context=self.context, namespace=self.namespace)
        self._threads = CallbackThreads(self.context, self.mapper, self.user)
        self._threads.__enter__()
        qos = input_qos("reliable", 100)
        self.publishers = {
            "rgb": self.user.create_publisher(Image, "rgb/image", qos),
            "depth": self.user.create_publisher(Image, "depth/image", qos),
            "info": self.user.create_publisher(CameraInfo, "rgb/camera_info", qos),
            "pose": self.user.create_publisher(PoseStamped, "pose", qos),
        }
        expected = [outlet for name, outlet in self.publishers.items() if name != "pose" or not self._odometry]
        wait_until(lambda: all(outlet.get_subscription_count() for outlet in expected), "inputs matched")

    def show(self, frame: PosedFrame) -> None:
        """Publish all that belongs to a frame."""
        for name, make in (
            ("info", camera_info_message),
            ("pose", pose_message),
            ("rgb", rgb_message),
            ("depth", depth_message),
        ):
            self.publishers[name].publish(make(frame))

    def map(self, frame: PosedFrame) -> None:
        """Publish a frame and wait until it is in the map."""
        worker = self.mapper.worker
        revision = worker.revision
        self.show(frame)
        wait_until(
            lambda: worker.stamp_ns == frame.stamp_ns and worker.revision > revision, f"frame {frame.stamp_ns} mapped"
        )

    def call(self, service_type: Any, name: str, **fields: Any) -> Any:
        client = self.user.create_client(service_type, f"fus3dmaps/{name}")
        assert client.wait_for_service(TIMEOUT_S), name
        future = client.call_async(service_type.Request(**fields))
        wait_until(future.done, f"reply of {name}")
        self.user.destroy_client(client)
        return future.result()

    def close(self) -> None:
        self._threads.__exit__()
        assert self.mapper.stop(TIMEOUT_S)
        self.mapper.destroy_node()
        self.user.destroy_node()
        rclpy.shutdown(context=self.context)
