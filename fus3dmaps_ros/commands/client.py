"""A client of the mapper node: asks questions and collects what a picture of the answer needs."""

from __future__ import annotations

import time
from collections.abc import Sequence
from types import TracebackType
from typing import Any

import numpy as np
import rclpy
from nav_msgs.msg import Path as PathMessage
from numpy.typing import NDArray
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2

from fus3dmaps_core.answers.query import RankedInstance
from fus3dmaps_core.errors import QueryError
from fus3dmaps_core.messages.fields import stamp_ns, to_pose
from fus3dmaps_msgs.srv import QueryText
from fus3dmaps_ros.topics.conversions import cloud_points, from_cloud, from_instance, unpack_rgb
from fus3dmaps_ros.topics.qos import LATCHED


class MapperClient:
    """Talks to one mapper node, in a ROS context of its own. Use it as a context manager."""

    def __init__(self, node_name: str = "/fus3dmaps") -> None:
        """Connect to the node with this fully qualified name."""
        self._name = node_name
        self._context = Context()
        rclpy.init(context=self._context)
        self._node = Node("fus3dmaps_client", context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._query = self._node.create_client(QueryText, f"{node_name}/query_text")

    def __enter__(self) -> MapperClient:
        """Return itself."""
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """Disconnect."""
        self._executor.shutdown()
        self._node.destroy_node()
        rclpy.shutdown(context=self._context)

    def wait_until_ready(self, timeout_s: float) -> None:
        """Wait for the node's query service.

        Raises:
            QueryError: It does not appear in time.
        """
        if not self._query.wait_for_service(timeout_sec=timeout_s):
            raise QueryError(f"no node '{self._name}' answers on {self._name}/query_text within {timeout_s:.0f} s")

    def ask(
        self,
        prompts: Sequence[str],
        *,
        negative_prompts: Sequence[str] = (),
        layer: str = "",
        threshold: float = 0.0,
        top_k: int = 0,
        publish: bool = False,
        timeout_s: float = 60.0,
    ) -> QueryText.Response:
        """Ask where the things are that prompts name.

        Raises:
            QueryError: The node refuses, with its own words, or does not answer in time.
        """
        request = QueryText.Request(
            prompts=list(prompts),
            negative_prompts=list(negative_prompts),
            layer=layer,
            threshold=threshold,
            top_k=top_k,
            publish=publish,
        )
        future = self._query.call_async(request)
        self._executor.spin_until_future_complete(future, timeout_sec=timeout_s)
        if not future.done():
            self._query.remove_pending_request(future)
            raise QueryError(f"node '{self._name}' did not answer within {timeout_s:.0f} s")
        response = future.result()
        if not response.success:
            raise QueryError(response.message)
        return response

    def map_cloud(self, since_ns: int = 0, timeout_s: float = 30.0) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
        """Return the node's map: voxel centres (n, 3) in metres and their colours (n, 3).

        Args:
            since_ns: Oldest stamp that is accepted; the node first sends the map that it published last.
            timeout_s: Longest wait.

        Raises:
            QueryError: None is published in time.
        """
        table = from_cloud(self._receive(PointCloud2, "map", since_ns, timeout_s))
        return cloud_points(table), unpack_rgb(table["rgb"])

    def camera_poses(self, since_ns: int = 0, timeout_s: float = 30.0) -> NDArray[np.float64]:
        """Return the poses T_world_camera (n, 4, 4) of the node's keyframes.

        Args:
            since_ns: Oldest stamp that is accepted.
            timeout_s: Longest wait.

        Raises:
            QueryError: None is published in time.
        """
        message = self._receive(PathMessage, "path", since_ns, timeout_s)
        return np.array([to_pose(pose, "path") for pose in message.poses]).reshape(-1, 4, 4)

    def _receive(self, message_type: Any, topic: str, since_ns: int, timeout_s: float) -> Any:
        """Receive a message of one of the node's latched topics."""
        received: list[Any] = []
        subscription = self._node.create_subscription(message_type, f"{self._name}/{topic}", received.append, LATCHED)
        deadline = time.monotonic() + timeout_s
        try:
            while time.monotonic() < deadline:
                self._executor.spin_once(timeout_sec=0.2)
                if received and stamp_ns(received[-1]) >= since_ns:
                    return received[-1]
        finally:
            self._node.destroy_subscription(subscription)
        raise QueryError(f"nothing new is published on {self._name}/{topic} within {timeout_s:.0f} s")


def ranked_instances(response: QueryText.Response) -> list[RankedInstance]:
    """Return the instances of a reply, best first."""
    return [from_instance(found) for found in response.instances]


def similarity_points(
    response: QueryText.Response,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the similarity cloud of a reply: points (n, 3) in metres and similarities (n,)."""
    table = from_cloud(response.similarity)
    return cloud_points(table), np.array(table["similarity"])
