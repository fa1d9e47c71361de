"""Transforms between frames over time: the interface to TF, and a buffer for recordings, which are read without ROS."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from fus3dmaps_core.errors import FrameError
from fus3dmaps_core.geometry.trajectory import PoseBuffer, PoseGap
from fus3dmaps_core.messages import fields

_KEEP_NS = 10_000_000_000  # As tf2 does: longer than any image waits.
_TIME_JUMP_NS = 3_000_000_000


class TransformGap(Enum):
    """Why a transform is not known at a stamp. It may still come if it is after the last one or not known at all."""

    UNKNOWN_FRAME = "nobody publishes this frame"
    NOT_CONNECTED = "the frames are not connected"
    BEFORE_FIRST = "before the first transform"
    AFTER_LAST = "after the last transform"
    TOO_WIDE = "between transforms too far apart"
    UNUSABLE = "not a rigid transform"


@dataclass(frozen=True)
class NoTransform:
    """The result of a lookup that found no transform.

    Attributes:
        gap: The reason.
        detail: The reason in words, with the names of frames.
    """

    gap: TransformGap
    detail: str


class TransformBuffer(Protocol):
    """The transforms known so far: an adapter of tf2's buffer on a robot, :class:`TransformTree` for recordings."""

    def lookup(self, target_frame: str, source_frame: str, stamp_ns: int) -> NDArray[np.float64] | NoTransform:
        """Look up the transform at a stamp, without waiting.

        Args:
            target_frame: Frame into which points are transformed.
            source_frame: Frame in which they are given.
            stamp_ns: Nanoseconds.

        Returns:
            (4, 4) float64 T_target_source, or why there is none.
        """

    def clear(self) -> None:
        """Remove all moving transforms; static ones stay."""


class TransformTree:
    """Transforms of ``tf2_msgs/TFMessage``: every edge is interpolated, and frames are joined at their common ancestor.

    A frame that gets a new parent loses the old one. Not thread-safe.
    """

    def __init__(self, max_gap_s: float) -> None:
        """Start empty. Transforms of one edge that are more than ``max_gap_s`` seconds apart are not interpolated."""
        self._max_gap_s = max_gap_s
        self._parents: dict[str, str] = {}
        self._moving: dict[str, PoseBuffer] = {}
        self._static: dict[str, NDArray[np.float64]] = {}

    def add(self, message: Any, topic: str, *, static: bool) -> list[FrameError]:
        """Add the transforms of a message.

        Args:
            message: ``tf2_msgs/TFMessage``.
            topic: Where it came from, for error messages.
            static: Whether its transforms hold at all times, like those on ``/tf_static``.

        Returns:
            One error with reason ``bad_transform`` for each transform that cannot be used; the others were added.
        """
        refused = []
        for stamped in message.transforms:
            try:
                self._add_edge(stamped, topic, static)
            except FrameError as error:
                refused.append(FrameError(str(error), reason="bad_transform"))
        return refused

    def lookup(self, target_frame: str, source_frame: str, stamp_ns: int) -> NDArray[np.float64] | NoTransform:
        """Look up the transform at a stamp; see :class:`TransformBuffer`."""
        target, source = _plain(target_frame), _plain(source_frame)
        if target == source:
            return np.eye(4)
        known = self._parents.keys() | set(self._parents.values())
        for frame in (target, source):
            if frame not in known:
                return NoTransform(TransformGap.UNKNOWN_FRAME, f"frame '{frame}' does not exist in TF")
        up_target, up_source = self._ancestors(target), self._ancestors(source)
        common = next((frame for frame in up_source if frame in up_target), None)
        if common is None:
            return NoTransform(TransformGap.NOT_CONNECTED, f"frames '{target}' and '{source}' are in two trees of TF")
        T_common_target = self._climb(up_target[: up_target.index(common)], stamp_ns)
        if isinstance(T_common_target, NoTransform):
            return T_common_target
        T_common_source = self._climb(up_source[: up_source.index(common)], stamp_ns)
        if isinstance(T_common_source, NoTransform):
            return T_common_source
        return np.asarray(np.linalg.inv(T_common_target) @ T_common_source)

    def clear(self) -> None:
        """Remove all moving transforms; static ones stay."""
        for frame in self._moving:
            del self._parents[frame]
        self._moving.clear()

    def _add_edge(self, stamped: Any, topic: str, static: bool) -> None:
        parent, child = _plain(stamped.header.frame_id), _plain(stamped.child_frame_id)
        if not parent or not child or parent == child:
            raise FrameError(f"{topic}: transform from '{child}' to '{parent}'")
        if child in self._ancestors(parent):
            raise FrameError(f"{topic}: transform from '{child}' to '{parent}' closes a loop")
        T_parent_child = fields.transform_of(stamped, topic)
        if self._parents.get(child) != parent or static != (child in self._static):
            self._moving.pop(child, None)
            self._static.pop(child, None)
            self._parents[child] = parent
        if static:
            self._static[child] = T_parent_child
            return
        buffer = self._moving.setdefault(child, PoseBuffer(self._max_gap_s))
        stamp_ns = fields.stamp_ns(stamped)
        if buffer.last_ns is not None and stamp_ns <= buffer.last_ns:
            if buffer.last_ns - stamp_ns <= _TIME_JUMP_NS:
                return  # Publishers repeat transforms; that is no fault.
            buffer.clear()
        buffer.add(stamp_ns, T_parent_child)
        buffer.forget_before(stamp_ns - _KEEP_NS)

    def _ancestors(self, frame: str) -> list[str]:
        """List the frame, its parent and so on, up to the root."""
        chain = [frame]
        while chain[-1] in self._parents:
            chain.append(self._parents[chain[-1]])
        return chain

    def _climb(self, frames: list[str], stamp_ns: int) -> NDArray[np.float64] | NoTransform:
        """Chain the transforms from the first frame to the parent of the last."""
        T = np.eye(4)
        for frame in frames:
            edge = self._static[frame] if frame in self._static else self._moving[frame].lookup(stamp_ns)
            if isinstance(edge, PoseGap):
                names = f"the transform from '{frame}' to '{self._parents[frame]}'"
                return NoTransform(TransformGap[edge.name], f"{names} is not known: {edge.value}")
            T = edge @ T
        return T


def _plain(frame: str) -> str:
    """Return the name as tf2 expects it; ROS 1 wrote a slash before it."""
    return frame.lstrip("/")
