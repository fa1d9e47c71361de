"""Answers as ``vision_msgs`` boxes, which navigation and manipulation stacks read, if that package is installed."""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from types import ModuleType

from geometry_msgs.msg import Point, Vector3
from std_msgs.msg import Header

from fus3dmaps_msgs.msg import SemanticInstance


def vision_messages() -> ModuleType | None:
    """Return the module ``vision_msgs.msg``, or None if it is not installed."""
    try:
        return importlib.import_module("vision_msgs.msg")
    except ImportError:
        return None


def to_detections(messages: ModuleType, header: Header, found: Sequence[SemanticInstance]) -> object:
    """Make a ``Detection3DArray`` of the instances of an answer.

    Args:
        messages: The module from :func:`vision_messages`.
        header: Map frame, and stamp of the map.
        found: The instances; each becomes an axis-aligned box with one hypothesis, the prompt and its score, at the
            instance's centroid.
    """
    detections = messages.Detection3DArray(header=header)
    for instance in found:
        low, high = instance.box_min, instance.box_max
        detection = messages.Detection3D(header=header, id=str(instance.id))
        detection.bbox.center.position = Point(x=(low.x + high.x) / 2, y=(low.y + high.y) / 2, z=(low.z + high.z) / 2)
        detection.bbox.center.orientation.w = 1.0
        detection.bbox.size = Vector3(x=high.x - low.x, y=high.y - low.y, z=high.z - low.z)
        result = messages.ObjectHypothesisWithPose()
        result.hypothesis.class_id = instance.prompt
        result.hypothesis.score = float(instance.score)
        result.pose.pose.position = instance.centroid
        result.pose.pose.orientation.w = 1.0
        detection.results.append(result)
        detections.detections.append(detection)
    return detections
