"""Small labelled frames made by hand."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fus3dmaps_core.frame import Intrinsics, PosedFrame
from fus3dmaps_lab.simulation.truth import LabelledFrame, Truth

CLASSES = ("", "wall", "table", "cup", "chair", "lamp")
BACKGROUND = frozenset({1})


def truth_of(classes: Sequence[int], parts: Sequence[int] | None = None) -> Truth:
    """Make instances 1, 2, ... of these classes, with parts 1, 2, ... of these instances, or one part each."""
    class_of_instance = np.array([0, *classes], np.int32)
    instance_of_part = np.arange(len(class_of_instance)) if parts is None else np.array([0, *parts])
    return Truth(CLASSES, BACKGROUND, class_of_instance, instance_of_part.astype(np.int32))


def labelled(parts: np.ndarray, stamp_ns: int = 0, depth_m: float | np.ndarray = 2.0, x_m: float = 0.0) -> LabelledFrame:
    """Make a frame that shows these parts, from (x, 0, 0) along z, about 60 degrees wide; part numbers are its colours."""
    height, width = parts.shape
    depth = np.broadcast_to(np.float32(depth_m), parts.shape).astype(np.float32)
    rgb = np.repeat((parts % 251).astype(np.uint8)[..., None], 3, axis=2)
    pose = np.eye(4)
    pose[0, 3] = x_m
    camera = Intrinsics(0.8 * width, 0.8 * width, (width - 1) / 2, (height - 1) / 2, width, height)
    return LabelledFrame(PosedFrame(stamp_ns, rgb, depth, camera, pose), pose, depth, parts.astype(np.int32))


def painted(height: int, width: int, rectangles: Sequence[tuple[int, int, int, int, int]]) -> np.ndarray:
    """Make (height, width) int32 parts: 1 everywhere, and (part, y0, x0, y1, x1) on top of it."""
    parts = np.ones((height, width), np.int32)
    for part, y0, x0, y1, x1 in rectangles:
        parts[y0:y1, x0:x1] = part
    return parts
