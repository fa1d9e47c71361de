"""A recording comes out as it went in, at its pace, with the clock."""

from __future__ import annotations

import os
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import rclpy
from geometry_msgs.msg import PoseStamped
from rclpy.context import Context
from rclpy.node import Node
from rclpy.qos import QoSProfile
from robot import CallbackThreads, wait_until
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, Image
from stand_ins import wall_frame

from fus3dmaps_core.errors import RecordingError
from fus3dmaps_core.recordings.reader import RecordingReader
from fus3dmaps_core.recordings.recorded_files import RawMessage, TopicSummary
from fus3dmaps_core.recordings.writer import RecordingWriter
from fus3dmaps_ros import player_node
from fus3dmaps_ros.player_node import Player
from fus3dmaps_ros.topics.transport import enlarge_shared_memory

START_NS = 1_700_000_000 * 10**9
STEP_NS = 100_000_000
TYPES = {
    "sensor_msgs/msg/Image": Image,
    "sensor_msgs/msg/CameraInfo": CameraInfo,
    "geometry_msgs/msg/PoseStamped": PoseStamped,
}


@pytest.fixture(scope="module")
def bag(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("recording") / "wall.mcap"
    with RecordingWriter(path) as writer:
        for index in range(5):
            writer.write(wall_frame(START_NS + index * STEP_NS, x_m=0.1 * index))
    return path


@pytest.fixture
def context() -> Iterator[Context]:
    context = Context()
    rclpy.init(args=[], context=context)
    yield context
    rclpy.shutdown(context=context)


def test_every_message_arrives_byte_for_byte(bag, context) -> None:
    listener = Node("listener", context=context)
    received: dict[str, list[bytes]] = {}
    clock: list[int] = []
    with RecordingReader(bag) as recording, CallbackThreads(context, listener):
        expected: dict[str, list[bytes]] = {}
        for message in recording.messages():
            expected.setdefault(message.topic, []).append(bytes(message.data))
        player = Player(recording, context=context)
        qos = QoSProfile(depth=100)
        for topic, summary in recording.topics.items():
            store = received.setdefault(topic, [])
            listener.create_subscription(TYPES[summary.msgtype], topic, store.append, qos, raw=True)
        listener.create_subscription(
            Clock, "/clock", lambda tick: clock.append(tick.clock.sec * 10**9 + tick.clock.nanosec), qos
        )
        player.wait_for_subscribers(60)
        player.play(rate=0)
        player.drain()
        wait_until(lambda: sum(map(len, received.values())) == sum(map(len, expected.values())), "everything received")
        wait_until(lambda: clock and clock[-1] == START_NS + 4 * STEP_NS, "last tick received")
        player.destroy_node()
    assert received == expected
    assert clock == sorted(clock)


class FakeTime:
    """A clock that only sleeping moves."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def monotonic(self) -> float:
        return self.now_s

    def sleep(self, seconds: float) -> None:
        self.now_s += seconds


def recording_of(stamps_ns: list[int], msgtype: str = "sensor_msgs/msg/CameraInfo") -> Any:
    return SimpleNamespace(
        path=Path("fake"),
        topics={"/info": TopicSummary("/info", msgtype, len(stamps_ns))},
        start_ns=stamps_ns[0],
        duration_s=(stamps_ns[-1] - stamps_ns[0]) / 1e9,
        messages=lambda topics: (RawMessage("/info", msgtype, stamp_ns, b"") for stamp_ns in stamps_ns),
    )


@pytest.mark.parametrize("rate", [0.5, 1.0, 4.0])
def test_messages_keep_their_pace_and_the_clock_runs_between_them(context, monkeypatch, rate) -> None:
    stamps_ns = [START_NS, START_NS + 10_000_000, START_NS + 800_000_000]
    player = Player(recording_of(stamps_ns), context=context)
    fake = FakeTime()
    monkeypatch.setattr(player_node, "time", fake)
    ticks: list[tuple[float, int]] = []
    monkeypatch.setattr(player, "_tick", lambda stamp_ns: ticks.append((fake.now_s, stamp_ns)))
    for message in player._paced(rate, fake.now_s):
        assert fake.now_s - 100.0 == pytest.approx((message.stamp_ns - START_NS) / 1e9 / rate, abs=1e-6)
        assert ticks[-1] == (fake.now_s, message.stamp_ns)
    walls_s, shown_ns = zip(*ticks, strict=True)
    assert max(after - before for before, after in pairwise(walls_s)) < 1 / 50
    assert list(shown_ns) == sorted(shown_ns)
    assert all(abs((shown - START_NS) / 1e9 / rate - (wall - 100.0)) < 1e-3 for wall, shown in ticks)
    player.destroy_node()


def test_nobody_listening_is_an_error_that_names_the_topics(context) -> None:
    player = Player(recording_of([START_NS]), context=context)
    with pytest.raises(RecordingError, match="nobody subscribed to /info within 0 s"):
        player.wait_for_subscribers(0.1)
    player.destroy_node()


def test_a_recording_of_unknown_types_only_is_refused(context) -> None:
    with pytest.raises(RecordingError, match="no topic of an installed message type"):
        Player(recording_of([START_NS], "nowhere_msgs/msg/Thing"), context=context)


@pytest.mark.parametrize("content", [None, b"", b"not a recording"])
def test_an_unreadable_recording_is_one_line_and_exit_code_one(tmp_path, signals, monkeypatch, capsys, content) -> None:
    monkeypatch.setattr(os, "environ", dict(os.environ))
    path = tmp_path / "broken.mcap"
    if content is not None:
        path.write_bytes(content)
    assert player_node.main([str(path)]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert str(path) in line


def test_a_truncated_recording_is_played_as_far_as_it_goes(bag, tmp_path, signals, monkeypatch, capfd) -> None:
    monkeypatch.setattr(os, "environ", dict(os.environ))
    path = tmp_path / "truncated.mcap"
    path.write_bytes(bag.read_bytes()[: bag.stat().st_size * 3 // 4])
    assert player_node.play(path, rate=0, wait_for_subscribers_s=0) == 1
    assert str(path) in capfd.readouterr().err


@pytest.mark.parametrize("configured", [{}, {"FASTDDS_BUILTIN_TRANSPORTS": "UDPv4"}, {"FASTDDS_DEFAULT_PROFILES_FILE": "x"}])
def test_shared_memory_is_enlarged_unless_the_environment_decides(monkeypatch, configured) -> None:
    environment = dict(configured)
    monkeypatch.setattr(os, "environ", environment)
    enlarge_shared_memory()
    if configured:
        assert environment == configured
    else:
        assert "segment_size" in Path(environment["FASTRTPS_DEFAULT_PROFILES_FILE"]).read_text()
