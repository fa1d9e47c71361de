"""The status of the node, as a message on ``~/status`` and as a line in the log."""

from __future__ import annotations

import traceback
from collections.abc import Callable, Mapping, Sequence

import torch
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from std_msgs.msg import Header

from fus3dmaps_core.config.schema import Config
from fus3dmaps_core.ledger import FrameCounts
from fus3dmaps_msgs.msg import MapperStatus
from fus3dmaps_ros.node.autosave import Autosave
from fus3dmaps_ros.node.session import Session
from fus3dmaps_ros.node.timers import change_period
from fus3dmaps_ros.topics.qos import LATCHED

_LOG_PERIOD_S = 5.0


def status_message(
    header: Header,
    state: str,
    config: Config,
    session: Session | None,
    autosave: Autosave | None,
    drops: Mapping[str, int],
    rates_hz: Mapping[str, float],
    problems: Sequence[str],
) -> MapperStatus:
    """Make the status message of this moment.

    Args:
        header: Time of the node's clock, and the map frame.
        state: Label of the lifecycle state.
        config: The current configuration.
        session: Models, map and mapping thread; None while unconfigured.
        autosave: Automatic saves of the session; None while unconfigured.
        drops: Messages and frames dropped, by reason.
        rates_hz: Messages a second, by topic.
        problems: Sentences that say what is wrong.
    """
    message = MapperStatus(
        header=header,
        state=state,
        encoder=config.encoder.name,
        segmenter=config.segmenter.name,
        topics=list(rates_hz),
        rates_hz=[float(rate_hz) for rate_hz in rates_hz.values()],
        drop_reasons=sorted(drops),
        drop_counts=[drops[reason] for reason in sorted(drops)],
        queue_size=config.node.queue_size,
        memory_budget_bytes=round(config.map.memory_budget_mib * 2**20),
        gpu_bytes=gpu_bytes(),
        problems=list(problems),
    )
    if session is not None:
        message.encoder = session.pipeline.trio.name
        counts, times = session.worker.ledger.counts(), session.worker.ledger.stage_times()
        message.frames, message.not_keyframes = counts.frames, counts.not_keyframes
        message.dense_keyframes, message.instance_keyframes = counts.dense_keyframes, counts.instance_keyframes
        message.queue_depth = session.worker.waiting
        message.stages = list(times)
        message.stage_mean_ms = [1e3 * time.mean_s for time in times.values()]
        message.stage_max_ms = [1e3 * time.max_s for time in times.values()]
        semantic_map = session.pipeline.semantic_map
        sizes = semantic_map.nbytes()
        message.voxels, message.dense_voxels = semantic_map.voxel_count, semantic_map.dense_voxel_count
        message.instances = semantic_map.instance_count
        message.parts, message.part_bytes = list(sizes), list(sizes.values())
    if autosave is not None:
        message.autosaves, message.failed_autosaves = autosave.counts
    return message


def status_line(session: Session | None, drops: Mapping[str, int]) -> str:
    """Describe in one line what came in, what was mapped, what was dropped and how large the map is."""
    counts = session.worker.ledger.counts() if session else FrameCounts()
    waiting = session.worker.waiting if session else 0
    voxels = session.pipeline.semantic_map.voxel_count if session else 0
    instances = session.pipeline.semantic_map.instance_count if session else 0
    lost = ", ".join(f"{reason} {count}" for reason, count in sorted(drops.items()))
    return (
        f"{counts.frames} frames, {counts.not_keyframes} not keyframes, {counts.dense_keyframes} dense and "
        f"{counts.instance_keyframes} instance keyframes, {waiting} waiting; dropped: {lost or 'none'}; "
        f"{voxels} voxels, {instances} instances"
    )


def gpu_bytes() -> int:
    """Return the bytes of GPU memory that this process has allocated on all devices; 0 if it uses none."""
    if not (torch.cuda.is_available() and torch.cuda.is_initialized()):
        return 0
    return sum(torch.cuda.memory_reserved(device) for device in range(torch.cuda.device_count()))


class StatusPublisher:
    """Publishes ``~/status`` periodically in every state, and logs a line every few seconds if it has changed."""

    def __init__(
        self,
        node: Node,
        read: Callable[[], Config],
        report: Callable[[], MapperStatus],
        line: Callable[[], tuple[str, Mapping[str, str]]],
    ) -> None:
        """Advertise the topic and start the timers.

        Args:
            node: Owner of the publisher.
            read: Returns the current configuration.
            report: Makes the message.
            line: Makes the line for the log, and returns the problems by kind; a new problem is added to the line.
        """
        self._node = node
        self._log = node.get_logger()
        self._report = report
        self._line = line
        self._told, self._known = "", frozenset[str]()
        self._publisher = node.create_publisher(MapperStatus, "~/status", LATCHED)
        group, clock = MutuallyExclusiveCallbackGroup(), Clock(clock_type=ClockType.STEADY_TIME)
        self._timer = node.create_timer(read().node.status_period_s, self._publish, callback_group=group, clock=clock)
        self._line_timer = node.create_timer(_LOG_PERIOD_S, self._say, callback_group=group, clock=clock)

    def follow(self, config: Config) -> None:
        """Apply ``node.status_period_s``."""
        change_period(self._node, self._timer, config.node.status_period_s)

    def _publish(self) -> None:
        try:
            self._publisher.publish(self._report())
        except Exception:
            self._log.error(f"reporting the status failed\n{traceback.format_exc()}", throttle_duration_sec=_LOG_PERIOD_S)

    def _say(self) -> None:
        try:
            line, problems = self._line()
        except Exception:
            self._log.error(f"reporting the status failed\n{traceback.format_exc()}")
            return
        fresh = [sentence for kind, sentence in problems.items() if kind not in self._known]
        if fresh or line != self._told:
            self._log.info("; ".join([line, *fresh]))
        self._told, self._known = line, frozenset(problems)
