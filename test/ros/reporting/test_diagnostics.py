"""The state of the mapping over DDS, from a small node that stands in for the mapper."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.context import Context
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from robot import CallbackThreads, wait_until
from sensor_msgs.msg import Image

from fus3dmaps_core.health.diagnosis import Diagnosis, MapSizes
from fus3dmaps_core.health.input_problems import Offer
from fus3dmaps_core.health.mapping_problems import MemoryState
from fus3dmaps_core.sources.streams import Stream
from fus3dmaps_ros.reporting.diagnostics import Diagnostics, publishers_of

DEPTH = Stream("depth/image", "depth", "sensor_msgs/msg/Image", "input.depth_topic", "reliable", lambda message: None)
BEST_EFFORT = QoSProfile(
    history=HistoryPolicy.KEEP_LAST,
    depth=5,
    reliability=ReliabilityPolicy.BEST_EFFORT,
    durability=DurabilityPolicy.VOLATILE,
)


class Clock:
    def __init__(self) -> None:
        self.now_s = 0.0

    def __call__(self) -> float:
        return self.now_s


class Setup:
    """A node in a namespace that publishes its state, and another that listens to it and plays the camera."""

    def __init__(self) -> None:
        self.context = Context()
        rclpy.init(args=[], context=self.context)
        self.mapper = Node("fus3dmaps", namespace="/robot", context=self.context)
        self.user = Node("driver", namespace="/camera", context=self.context)
        self.clock = Clock()
        self.diagnosis = Diagnosis([DEPTH], sync_tolerance_s=0.02, max_wait_s=2.0, clock=self.clock)
        self.diagnostics = Diagnostics(
            self.mapper,
            self.diagnosis,
            [DEPTH.topic],
            lambda: MapSizes(12, 3, {"dense": 2**20}),
            lambda: [MemoryState("host", 95 * 2**20, 100 * 2**20)],
            hardware_id="cpu",
            period_s=0.05,
        )
        self.received: list[DiagnosticArray] = []
        self.user.create_subscription(DiagnosticArray, "/diagnostics", self.received.append, 10)
        self._threads = CallbackThreads(self.context, self.mapper, self.user)
        self._threads.__enter__()

    def status(self, part: str) -> DiagnosticStatus | None:
        found = [
            status for status in (self.received[-1].status if self.received else []) if status.name.endswith(f": {part}")
        ]
        return found[0] if found else None

    def inputs_say(self, text: str) -> Any:
        return wait_until(
            lambda: (status := self.status("inputs")) is not None and text in status.message and status, f"'{text}' said"
        )

    def close(self) -> None:
        self._threads.__exit__()
        self.mapper.destroy_node()
        self.user.destroy_node()
        rclpy.shutdown(context=self.context)


@pytest.fixture
def setup() -> Iterator[Setup]:
    setup = Setup()
    yield setup
    setup.close()


def test_there_is_one_status_per_part_with_level_and_figures(setup) -> None:
    wait_until(lambda: setup.received, "diagnostics received")
    message = setup.received[-1]
    assert [status.name for status in message.status] == [
        f"robot/fus3dmaps: {part}" for part in ("inputs", "mapping", "map", "memory")
    ]
    assert {status.hardware_id for status in message.status} == {"cpu"}
    assert message.header.stamp.sec > 0
    values = {pair.key: pair.value for pair in setup.status("map").values}
    assert values == {"voxels": "12", "instances": "3", "dense (MiB)": "1.0"}
    assert setup.status("map").level == DiagnosticStatus.OK
    memory = setup.status("memory")
    assert memory.level == DiagnosticStatus.WARN
    assert "95%" in memory.message
    assert [(pair.key, pair.value) for pair in memory.values] == [("host", "95.0 MiB of 100.0 MiB")]


def test_a_topic_without_publisher_and_then_one_of_another_qos_are_told_apart(setup) -> None:
    setup.clock.now_s = 5.0
    assert setup.inputs_say("no message on depth/image for 5 s: it has no publisher").level == DiagnosticStatus.ERROR
    publisher = setup.user.create_publisher(Image, "/robot/depth/image", BEST_EFFORT)
    said = setup.inputs_say("no message on depth/image for 5 s; its publisher offers BEST_EFFORT, we ask RELIABLE")
    assert "input.depth_qos" in said.message
    assert publishers_of(setup.mapper, "depth/image") == [Offer("/camera/driver", "BEST_EFFORT", "VOLATILE")]
    setup.user.destroy_publisher(publisher)
    setup.inputs_say("it has no publisher")


def test_messages_end_the_complaint(setup) -> None:
    setup.clock.now_s = 5.0
    setup.inputs_say("no message on depth/image")
    setup.diagnosis.arrived("depth/image", 10**9, 10**9)
    assert setup.inputs_say("all inputs arrive").level == DiagnosticStatus.OK


def test_what_waits_without_frames_is_stale(setup) -> None:
    setup.clock.now_s = 60.0
    wait_until(
        lambda: (status := setup.status("mapping")) is not None and status.level == DiagnosticStatus.STALE,
        "mapping is stale",
    )


def test_closing_takes_the_topic_back(setup) -> None:
    wait_until(lambda: setup.received, "diagnostics received")
    setup.diagnostics.close()
    wait_until(lambda: not setup.user.get_publishers_info_by_topic("/diagnostics"), "topic gone")
