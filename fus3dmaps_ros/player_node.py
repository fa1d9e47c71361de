"""The player node: publishes a recording on its topics, with ``/clock``."""

from __future__ import annotations

import argparse
import signal
import sys
import time
from collections.abc import Iterator, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

import rclpy
from builtin_interfaces.msg import Time
from rclpy.context import Context
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args
from rosgraph_msgs.msg import Clock

from fus3dmaps_core.errors import RecordingError
from fus3dmaps_core.recordings.reader import RecordingReader
from fus3dmaps_core.recordings.recorded_files import RawMessage
from fus3dmaps_ros.node.refusals import REFUSALS
from fus3dmaps_ros.topics.qos import named_qos
from fus3dmaps_ros.topics.transport import enlarge_shared_memory

NODE_NAME = "fus3dmaps_player"
_CLOCK_PERIOD_S = 0.01
_SETTLE_S = 1.0
_PROGRESS_PERIOD_S = 5.0
_DRAIN_TIMEOUT_S = 10.0
_ACKNOWLEDGEMENT_TIMEOUT = Duration(seconds=1)
# Best-effort readers acknowledge nothing; they get this long to fetch the last images from shared memory.
_LINGER_S = 0.3


class Player(Node):
    """Publishes the raw messages of a recording at the pace at which they were recorded."""

    def __init__(self, recording: RecordingReader, **options: Any) -> None:
        """Advertise the recording's topics; leave out those of unknown message types with a warning.

        Args:
            recording: The recording to play.
            options: Options of ``rclpy.node.Node``, e.g. ``context``.

        Raises:
            RecordingError: No topic has a known type.
        """
        super().__init__(NODE_NAME, **options)
        self._recording = recording
        self._clock_outlet = self.create_publisher(Clock, "/clock", named_qos("reliable", 10))
        self._outlets: dict[str, Publisher] = {}
        for topic, summary in recording.topics.items():
            message_type = _message_type(summary.msgtype)
            if message_type is None:
                self.get_logger().warning(f"{topic} is not played: message type {summary.msgtype} is not installed")
            elif topic != "/clock":
                self._outlets[topic] = self.create_publisher(message_type, topic, named_qos("reliable", 20))
        if not self._outlets:
            raise RecordingError(f"recording '{recording.path}' has no topic of an installed message type")

    def wait_for_subscribers(self, timeout_s: float) -> None:
        """Wait until every topic has a subscriber, or until some have one and no more appear for a second.

        Raises:
            RecordingError: Nobody subscribed to anything within the time.
        """
        deadline = time.monotonic() + timeout_s
        matched, settled = 0, 0.0
        while matched < len(self._outlets):
            now = time.monotonic()
            count = sum(outlet.get_subscription_count() > 0 for outlet in self._outlets.values())
            if count != matched:
                matched, settled = count, now + _SETTLE_S
            if matched and now >= settled:
                break
            if not matched and now >= deadline:
                raise RecordingError(f"nobody subscribed to {', '.join(self._outlets)} within {timeout_s:.0f} s")
            time.sleep(0.02)
        unheard = [topic for topic, outlet in self._outlets.items() if not outlet.get_subscription_count()]
        if unheard:
            self.get_logger().info(f"nobody listens on {', '.join(unheard)}")

    def play(self, rate: float) -> None:
        """Publish everything; the clock ticks at every message, and at 100 Hz of wall time between messages.

        Args:
            rate: Speed; 0 plays as fast as messages are read and reliable subscribers acknowledge them.

        Raises:
            RecordingError: The recording is damaged; what is readable has been published.
        """
        recording = self._recording
        started = report_due = time.monotonic()
        published = 0
        for message in self._paced(rate, started):
            outlet = self._outlets[message.topic]
            outlet.publish(message.data)
            published += 1
            if rate == 0:
                outlet.wait_for_all_acked(_ACKNOWLEDGEMENT_TIMEOUT)
            now = time.monotonic()
            if now >= report_due:
                report_due = now + _PROGRESS_PERIOD_S
                position_s = (message.stamp_ns - recording.start_ns) / 1e9
                self.get_logger().info(f"{position_s:.1f} of {recording.duration_s:.1f} s, {published} messages")
        wall_s = time.monotonic() - started
        achieved = recording.duration_s / wall_s if wall_s > 0 else 0.0
        self.get_logger().info(f"played {published} messages in {wall_s:.1f} s (rate {achieved:.2f})")

    def drain(self) -> None:
        """Wait until reliable subscribers have received everything."""
        deadline = time.monotonic() + _DRAIN_TIMEOUT_S
        for topic, outlet in self._outlets.items():
            left_s = max(deadline - time.monotonic(), 0.0)
            if not outlet.wait_for_all_acked(Duration(nanoseconds=round(left_s * 1e9))):
                self.get_logger().warning(f"{topic}: a subscriber has not acknowledged the last messages")
        time.sleep(_LINGER_S)

    def _paced(self, rate: float, started: float) -> Iterator[RawMessage]:
        """Yield each message at its time."""
        start_ns = self._recording.start_ns
        for message in self._recording.messages(self._outlets.keys()):
            if rate > 0:
                due = started + (message.stamp_ns - start_ns) / 1e9 / rate
                while (left_s := due - time.monotonic()) > _CLOCK_PERIOD_S:
                    time.sleep(_CLOCK_PERIOD_S)
                    self._tick(message.stamp_ns - round(max(due - time.monotonic(), 0.0) * rate * 1e9))
                time.sleep(max(left_s, 0.0))
            self._tick(message.stamp_ns)
            yield message

    def _tick(self, stamp_ns: int) -> None:
        seconds, nanoseconds = divmod(stamp_ns, 1_000_000_000)
        self._clock_outlet.publish(Clock(clock=Time(sec=seconds, nanosec=nanoseconds)))


def play(bag: Path, *, rate: float = 1.0, wait_for_subscribers_s: float = 60.0, ros_arguments: Sequence[str] = ()) -> int:
    """Play a recording through DDS; meant for a process of its own.

    Args:
        bag: rosbag2 directory or .mcap or .db3 file.
        rate: Speed; 0 plays as fast as messages are read and taken.
        wait_for_subscribers_s: Longest wait for a first subscriber, seconds; 0 starts at once.
        ros_arguments: ``--ros-args ...``, e.g. to remap topics.

    Returns:
        Exit code: 0 when everything was played, 1 after a refusal, which is one line on stderr, 130 after a signal.
    """
    enlarge_shared_memory()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.default_int_handler)
    context = Context()
    try:
        with RecordingReader(bag) as recording:
            rclpy.init(args=list(ros_arguments), context=context, signal_handler_options=SignalHandlerOptions.NO)
            player = Player(recording, context=context)
            if wait_for_subscribers_s > 0:
                player.wait_for_subscribers(wait_for_subscribers_s)
            try:
                player.play(rate)
            except RecordingError:
                player.drain()
                raise
            player.drain()
    except REFUSALS as error:
        print(f"{NODE_NAME}: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 130
    finally:
        rclpy.try_shutdown(context=context)
    return 0


def main(args: Sequence[str] | None = None) -> int:
    """Run the ``player`` executable; see :func:`play`."""
    parser = argparse.ArgumentParser(prog="player", description="Publish a recording on its topics, with /clock.")
    parser.add_argument("bag", type=Path, help="rosbag2 directory or .mcap or .db3 file")
    parser.add_argument("--rate", type=float, default=1.0, help="speed; 0 plays as fast as it is taken")
    parser.add_argument("--wait", type=float, default=60.0, help="longest wait for a first subscriber, seconds; 0: none")
    arguments = list(sys.argv[1:] if args is None else args)
    options = parser.parse_args(remove_ros_args(arguments))
    return play(options.bag, rate=options.rate, wait_for_subscribers_s=options.wait, ros_arguments=arguments)


def _message_type(name: str) -> Any:
    """Return the class of ``package/msg/Name``, or None if its package is not installed."""
    package, _, kind = name.partition("/msg/")
    try:
        return getattr(import_module(f"{package}.msg"), kind, None)
    except ImportError:
        return None


if __name__ == "__main__":
    sys.exit(main())
