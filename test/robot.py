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
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from rclpy.context import Context
from rclpy.node import Node
from rclpy.parameter import Parameter
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from stand_ins import ColorSegmenter, color_trio
from std_msgs.msg import Header

from fus3dmaps_core.frame import PosedFrame
from fus3dmaps_core.pipeline import Pipeline
from fus3dmaps_ros.mapper_node import MapperNode
from fus3dmaps_ros.node.executor import CallbackExecutor
from fus3dmaps_ros.topics.qos import LATCHED, named_qos

TIMEOUT_S = 60.0
RELIABLE_INPUTS = {f"input.{stream}_qos": "reliable" for stream in ("rgb", "depth", "camera_info", "pose")}


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


def pose_with_covariance_message(frame: PosedFrame) -> PoseWithCovarianceStamped:
    stamped = pose_message(frame)
    message = PoseWithCovarianceStamped(header=stamped.header)
    message.pose.pose = stamped.pose
    return message


def odometry_message(frame: PosedFrame) -> Odometry:
    stamped = pose_message(frame)
    message = Odometry(header=stamped.header, child_frame_id="base_link")
    message.pose.pose = stamped.pose
    return message


def compressed_message(stamp_ns: int, image_format: str, data: bytes) -> CompressedImage:
    message = CompressedImage(header=header(stamp_ns), format=image_format)
    message.data.frombytes(data)
    return message


POSES = {
    "pose": (PoseStamped, "pose", pose_message),
    "pose_with_covariance": (PoseWithCovarianceStamped, "pose_with_covariance", pose_with_covariance_message),
    "odometry": (Odometry, "odom", odometry_message),
}


class CallbackThreads:
    """Runs the callbacks of nodes, each in threads of its own, for as long as the context lasts."""

    def __init__(self, context: Context, *nodes: Node) -> None:
        self._executors = [CallbackExecutor(context=context) for _ in nodes]
        self._threads = [threading.Thread(target=executor.spin, daemon=True) for executor in self._executors]
        for executor, node in zip(self._executors, nodes, strict=True):
            executor.add_node(node)

    def __enter__(self) -> None:
        for thread in self._threads:
            thread.start()

    def __exit__(self, *_: object) -> None:
        assert all(executor.shutdown(TIMEOUT_S) for executor in self._executors)
        for thread in self._threads:
            thread.join(TIMEOUT_S)
            assert not thread.is_alive()


_numbers = itertools.count()


class Robot:
    """A mapper node with stand-in models, and a second node that plays the camera and the user.

    It publishes what the parameters ask for: poses from the source, images in the transport, those of each of several
    cameras, a camera model of depth that is not registered. ``makers`` holds what makes the message of each publisher from a
    frame; the test brings it for images in a transport other than raw and for the model of the depth camera. With several
    cameras the names start with theirs: ``front/rgb``.
    """

    def __init__(self, make_pipeline: Callable[[Any], Pipeline] = stand_in_pipeline, **parameters: Any) -> None:
        self.context = Context()
        rclpy.init(args=[], context=self.context)
        # Robots of several tests may live at the same time.
        self.namespace = f"/robot_{next(_numbers)}"
        overrides = {**RELIABLE_INPUTS, "node.publish_period_s": 0.1, "node.queue_size": 100, **parameters}
        self.mapper = MapperNode(
            make_pipeline,
            context=self.context,
            namespace=self.namespace,
            parameter_overrides=[Parameter(name, value=value) for name, value in overrides.items()],
        )
        self.user = Node("user", context=self.context, namespace=self.namespace)
        self._threads = CallbackThreads(self.context, self.mapper, self.user)
        self._threads.__enter__()
        qos = named_qos("reliable", 100)
        source = parameters.get("input.pose_source", "pose")
        outlets: dict[str, tuple[Any, str, Any]] = {}
        if source in POSES:
            outlets["pose"] = POSES[source]
        cameras = str(parameters.get("input.cameras", ""))
        for camera in (f"{name}/" if name else "" for name in cameras.split(",")):
            outlets[f"{camera}info"] = (CameraInfo, f"{camera}rgb/camera_info", camera_info_message)
            if not parameters.get("input.depth_registered", True):
                outlets[f"{camera}depth_info"] = (CameraInfo, f"{camera}depth/camera_info", None)
            for name, make in (("rgb", rgb_message), ("depth", depth_message)):
                transport = parameters.get(f"input.{name}_transport", "raw")
                raw = transport == "raw"
                topic = f"{camera}{name}/image" + ("" if raw else f"/{transport}")
                outlets[f"{camera}{name}"] = (Image if raw else CompressedImage, topic, make)
        self.makers: dict[str, Callable[[PosedFrame], Any]] = {name: make for name, (_, _, make) in outlets.items()}
        self.publishers = {
            name: self.user.create_publisher(message_type, topic, qos) for name, (message_type, topic, _) in outlets.items()
        }
        if parameters.get("node.autostart", True):
            self.mapper.bring_up()
            self.connect()

    def connect(self) -> None:
        """Wait until the camera's messages reach the node, which must be active."""
        wait_until(lambda: all(outlet.get_subscription_count() for outlet in self.publishers.values()), "inputs matched")

    def show(self, frame: PosedFrame, camera: str = "") -> None:
        """Publish all that belongs to a frame, of one of several cameras where it is named."""
        for name, publisher in self.publishers.items():
            if name == "pose" or name.rpartition("/")[0] == camera:
                publisher.publish(self.makers[name](frame))

    def map(self, frame: PosedFrame, camera: str = "") -> None:
        """Publish a frame and wait until it is in the map."""
        worker = self.mapper.worker
        revision = worker.revision
        self.show(frame, camera)
        wait_until(
            lambda: worker.stamp_ns == frame.stamp_ns and worker.revision > revision, f"frame {frame.stamp_ns} mapped"
        )

    def call(self, service_type: Any, service: str, /, **fields: Any) -> Any:
        client = self.user.create_client(service_type, f"fus3dmaps/{service}")
        assert client.wait_for_service(TIMEOUT_S), service
        future = client.call_async(service_type.Request(**fields))
        wait_until(future.done, f"reply of {service}")
        self.user.destroy_client(client)
        return future.result()

    def listen(self, message_type: Any, name: str) -> list[Any]:
        """Messages of one of the node's own topics as they come."""
        received: list[Any] = []
        self.user.create_subscription(message_type, f"fus3dmaps/{name}", received.append, LATCHED)
        return received

    def close(self) -> None:
        self._threads.__exit__()
        assert self.mapper.stop(TIMEOUT_S)
        autosave = self.mapper.autosave
        assert autosave is None or autosave.stop(TIMEOUT_S)
        self.mapper.destroy_node()
        self.user.destroy_node()
        rclpy.shutdown(context=self.context)
