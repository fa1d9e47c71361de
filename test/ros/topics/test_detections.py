"""Answers as vision_msgs boxes, against stand-ins of its messages, which are no part of a pip environment."""

from __future__ import annotations

import sys
from types import ModuleType, SimpleNamespace
from typing import Any

from geometry_msgs.msg import Point, Pose, PoseWithCovariance
from std_msgs.msg import Header

from fus3dmaps_msgs.msg import SemanticInstance
from fus3dmaps_ros.topics.detections import to_detections, vision_messages


class _Message(SimpleNamespace):
    """As a generated message: fields by keyword, the others by default."""

    def __init__(self, **fields: Any) -> None:
        super().__init__(**{**self.defaults(), **fields})

    def defaults(self) -> dict[str, Any]:
        return {}


class Detection3DArray(_Message):
    def defaults(self) -> dict[str, Any]:
        return {"detections": []}


class Detection3D(_Message):
    def defaults(self) -> dict[str, Any]:
        return {"bbox": SimpleNamespace(center=Pose(), size=None), "results": []}


class ObjectHypothesisWithPose(_Message):
    def defaults(self) -> dict[str, Any]:
        return {"hypothesis": SimpleNamespace(class_id="", score=0.0), "pose": PoseWithCovariance()}


def stand_in() -> ModuleType:
    module = ModuleType("vision_msgs.msg")
    for kind in (Detection3DArray, Detection3D, ObjectHypothesisWithPose):
        setattr(module, kind.__name__, kind)
    return module


def test_the_package_is_used_where_it_is_installed(monkeypatch) -> None:
    module = stand_in()
    monkeypatch.setitem(sys.modules, "vision_msgs", ModuleType("vision_msgs"))
    monkeypatch.setitem(sys.modules, "vision_msgs.msg", module)
    assert vision_messages() is module
    monkeypatch.setitem(sys.modules, "vision_msgs.msg", None)
    assert vision_messages() is None


def test_an_instance_is_a_box_with_one_hypothesis() -> None:
    header = Header(frame_id="map")
    found = SemanticInstance(
        header=header,
        id=7,
        prompt="mug",
        score=0.5,
        centroid=Point(x=1.1, y=2.0, z=3.0),
        box_min=Point(x=1.0, y=1.5, z=2.0),
        box_max=Point(x=2.0, y=2.5, z=4.0),
    )
    array = to_detections(stand_in(), header, [found])
    assert array.header == header
    (detection,) = array.detections
    assert (detection.header, detection.id) == (header, "7")
    center, size = detection.bbox.center.position, detection.bbox.size
    assert (center.x, center.y, center.z) == (1.5, 2.0, 3.0)
    assert (size.x, size.y, size.z) == (1.0, 1.0, 2.0)
    assert detection.bbox.center.orientation.w == 1.0
    (result,) = detection.results
    assert (result.hypothesis.class_id, result.hypothesis.score) == ("mug", 0.5)
    assert result.pose.pose.position == found.centroid


def test_no_instances_are_an_empty_array() -> None:
    assert to_detections(stand_in(), Header(), []).detections == []
