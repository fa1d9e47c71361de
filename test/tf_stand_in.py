"""A stand-in for tf2_ros: its Python interface over a plain table of transforms, filled by hand."""

from __future__ import annotations

import sys
from collections.abc import Callable
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from builtin_interfaces.msg import Time as TimeMessage
from geometry_msgs.msg import Pose, Quaternion, TransformStamped, Vector3
from nav_msgs.msg import Odometry
from rclpy.duration import Duration
from rclpy.time import Time
from robot import header
from scipy.spatial.transform import Rotation

from fus3dmaps_core.frame import PosedFrame


class TransformException(Exception):  # noqa: N818
    pass


class LookupException(TransformException):
    pass


class ConnectivityException(TransformException):
    pass


class ExtrapolationException(TransformException):
    pass


class InvalidArgumentException(TransformException):
    pass


class Buffer:
    """tf2's rules: linear and spherical interpolation per edge, a chain is known where all its edges are."""

    def __init__(self, cache_time: Duration | None = None, node: Any = None) -> None:
        self.static: dict[str, tuple[str, np.ndarray]] = {}
        self.moving: dict[str, tuple[str, dict[int, np.ndarray]]] = {}
        _buffers.append(self)

    def set_transform(self, transform: TransformStamped, authority: str) -> None:
        parent, samples = self.moving.setdefault(transform.child_frame_id, (transform.header.frame_id, {}))
        assert parent == transform.header.frame_id
        samples[stamp_of(transform)] = matrix(transform)

    def set_transform_static(self, transform: TransformStamped, authority: str) -> None:
        self.static[transform.child_frame_id] = (transform.header.frame_id, matrix(transform))

    def clear(self) -> None:
        for _, samples in self.moving.values():
            samples.clear()

    def can_transform(self, target_frame: str, source_frame: str, time: Time, timeout: Duration | None = None) -> bool:
        try:
            self.lookup_transform(target_frame, source_frame, time)
        except TransformException:
            return False
        return True

    def lookup_transform(
        self, target_frame: str, source_frame: str, time: Time, timeout: Duration | None = None
    ) -> TransformStamped:
        edges = self.static | self.moving
        known = edges.keys() | {parent for parent, _ in edges.values()}
        for role, frame in (("target", target_frame), ("source", source_frame)):
            if not frame or frame.startswith("/"):
                raise InvalidArgumentException(f"invalid {role}_frame '{frame}'")
            if frame not in known:
                raise LookupException(f'"{frame}" passed to lookupTransform argument {role}_frame does not exist.')
        up_target, up_source = self._up(target_frame), self._up(source_frame)
        shared = [frame for frame in up_source if frame in up_target]
        if not shared:
            raise ConnectivityException(f"'{target_frame}' and '{source_frame}' are not part of the same tree.")
        down = up_target[: up_target.index(shared[0])]
        up = up_source[: up_source.index(shared[0])]
        stamp_ns = time.nanoseconds
        if stamp_ns == 0:
            stamp_ns = min((max(self.moving[f][1], default=0) for f in down + up if f in self.moving), default=0)
        T = np.eye(4)
        for frame in up:
            T = self._edge(frame, stamp_ns) @ T
        T_back = np.eye(4)
        for frame in down:
            T_back = self._edge(frame, stamp_ns) @ T_back
        return stamped(target_frame, source_frame, stamp_ns, np.linalg.inv(T_back) @ T)

    def _up(self, frame: str) -> list[str]:
        edges = self.static | self.moving
        chain = [frame]
        while chain[-1] in edges:
            chain.append(edges[chain[-1]][0])
        return chain

    def _edge(self, frame: str, stamp_ns: int) -> np.ndarray:
        if frame in self.static:
            return self.static[frame][1]
        samples = self.moving[frame][1]
        before = [s for s in samples if s <= stamp_ns]
        after = [s for s in samples if s >= stamp_ns]
        if not before or not after:
            direction = "past" if not before else "future"
            raise ExtrapolationException(f"Lookup would require extrapolation into the {direction} for '{frame}'")
        start, end = max(before), min(after)
        if start == end:
            return samples[start]
        share = (stamp_ns - start) / (end - start)
        turn = Rotation.from_matrix(samples[start][:3, :3].T @ samples[end][:3, :3]).as_rotvec()
        T = np.eye(4)
        T[:3, :3] = samples[start][:3, :3] @ Rotation.from_rotvec(share * turn).as_matrix()
        T[:3, 3] = samples[start][:3, 3] + share * (samples[end][:3, 3] - samples[start][:3, 3])
        return T


class TransformListener:
    def __init__(self, buffer: Buffer, node: Any) -> None:
        self.listening = True
        self.buffer = buffer

    def unregister(self) -> None:
        self.listening = False


_buffers: list[Buffer] = []


def install(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make this module what ``import tf2_ros`` finds."""
    module = ModuleType("tf2_ros")
    kinds = (LookupException, ConnectivityException, ExtrapolationException, InvalidArgumentException, TransformException)
    for kind in (*kinds, Buffer, TransformListener):
        setattr(module, kind.__name__, kind)
    monkeypatch.setitem(sys.modules, "tf2_ros", module)


def latest_buffer() -> Buffer:
    """The one that was made last."""
    return _buffers[-1]


def stamp_of(message: Any) -> int:
    return message.header.stamp.sec * 10**9 + message.header.stamp.nanosec


def matrix(transform: TransformStamped) -> np.ndarray:
    t, q = transform.transform.translation, transform.transform.rotation
    T = np.eye(4)
    T[:3, 3] = t.x, t.y, t.z
    values = np.array([q.x, q.y, q.z, q.w])
    # tf2 refuses what is no rotation; here it passes as it is, for whoever has to notice.
    T[:3, :3] = Rotation.from_quat(values).as_matrix() if np.linalg.norm(values) > 0 else np.zeros((3, 3))
    return T


def stamped(parent: str, child: str, stamp_ns: int, T: np.ndarray) -> TransformStamped:
    message = TransformStamped(child_frame_id=child)
    message.header.frame_id = parent
    message.header.stamp = TimeMessage(sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    message.transform.translation = Vector3(**dict(zip("xyz", T[:3, 3].tolist(), strict=True)))
    message.transform.rotation = quaternion(T)
    return message


def quaternion(T: np.ndarray) -> Quaternion:
    return Quaternion(**dict(zip("xyzw", Rotation.from_matrix(T[:3, :3]).as_quat().tolist(), strict=True)))


def odometry(frame: PosedFrame, T_world_body: np.ndarray) -> Odometry:
    message = Odometry(header=header(frame.stamp_ns, "map"), child_frame_id="base_link")
    pose = Pose(orientation=quaternion(T_world_body))
    pose.position.x, pose.position.y, pose.position.z = T_world_body[:3, 3].tolist()
    message.pose.pose = pose
    return message


def before(make: Callable[[PosedFrame], Any], buffer: Buffer, parent: str, child: str) -> Callable[[PosedFrame], Any]:
    """A maker of messages that first tells TF where the camera of the frame is."""

    def made(frame: PosedFrame) -> Any:
        buffer.set_transform(stamped(parent, child, frame.stamp_ns, frame.T_world_camera), "test")
        return make(frame)

    return made
