"""The link between the active node and the diagnosis of its health."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from rclpy.node import Node

from fus3dmaps_core.config.schema import Config
from fus3dmaps_core.frame import PosedFrame
from fus3dmaps_core.health.diagnosis import Diagnosis, MapSizes
from fus3dmaps_core.health.input_problems import Problem
from fus3dmaps_core.health.mapping_problems import MIB, MemoryState
from fus3dmaps_core.sources.paired import PairedMessages
from fus3dmaps_core.sources.streams import Stream, pose_topic
from fus3dmaps_ros.node.session import Session
from fus3dmaps_ros.reporting.diagnostics import Diagnostics, publishers_of


class HealthMonitor:
    """Follows inputs, frames and drops while the node is active, and publishes ``/diagnostics``."""

    def __init__(self, node: Node, config: Config, streams: Sequence[Stream], session: Session) -> None:
        """Start to publish.

        Args:
            node: Owner of the publisher; stamps are compared with its clock.
            config: The current configuration.
            streams: The inputs.
            session: Has the map.
        """
        self._node = node
        self._config = config
        self._session = session
        self._topics = [stream.topic for stream in streams]
        self._cameras: dict[str, object] = {}
        self.diagnosis = Diagnosis(
            streams,
            sync_tolerance_s=config.input.sync_tolerance_s,
            max_wait_s=config.input.max_wait_s,
            use_sim_time=bool(node.get_parameter("use_sim_time").value),
        )
        self._published = Diagnostics(
            node,
            self.diagnosis,
            self._topics,
            self._sizes,
            self.memory,
            hardware_id=config.encoder.device,
            period_s=config.node.status_period_s,
        )

    def arrived(self, topic: str, stamp_ns: int) -> None:
        """Note that a message with this stamp came on one of the streams."""
        self.diagnosis.arrived(topic, stamp_ns, self._node.get_clock().now().nanoseconds)

    def offered(self, waiting: int) -> None:
        """Note that a frame was queued; ``waiting`` frames wait now."""
        self.diagnosis.offered(waiting)

    def decoded(self, paired: PairedMessages, frame: PosedFrame) -> None:
        """Note that a keyframe was decoded."""
        if self._cameras.get(paired.rgb_topic) != paired.intrinsics:
            self._cameras[paired.rgb_topic] = paired.intrinsics
            self.diagnosis.camera(paired.rgb_topic, paired.intrinsics)
        self.diagnosis.frame(
            frame.T_world_camera,
            frame.depth_m,
            depth_topic=paired.depth_topic,
            encoding=str(getattr(paired.depth, "encoding", None) or paired.depth.format),
            pose_topic=pose_topic(self._config.input),
        )

    def finished(self, durations_s: Mapping[str, float], waiting: int) -> None:
        """Note that a frame is done."""
        self.diagnosis.finished(durations_s, waiting)

    def dropped(self, reason: str, sentence: str, number: int) -> None:
        """Note that messages or frames were dropped."""
        self.diagnosis.dropped(reason, sentence, number)

    def problems(self) -> list[Problem]:
        """Return the current problems."""
        offers = {topic: publishers_of(self._node, topic) for topic in self._topics}
        return self.diagnosis.problems(offers, self.memory())

    def memory(self) -> list[MemoryState]:
        """Return how full the map's memory is, and that of the GPU if the encoders use one."""
        config = self._config
        used = sum(self._session.pipeline.semantic_map.nbytes().values())
        states = [MemoryState(f"map on {config.map.device}", used, round(config.map.memory_budget_mib * MIB))]
        device = torch.device(config.encoder.device)
        if device.type == "cuda" and torch.cuda.is_initialized():
            free, total = torch.cuda.mem_get_info(device)
            states.append(MemoryState(config.encoder.device, total - free, total))
        return states

    def close(self) -> None:
        """Remove the topic."""
        self._published.close()

    def _sizes(self) -> MapSizes:
        semantic_map = self._session.pipeline.semantic_map
        return MapSizes(semantic_map.voxel_count, semantic_map.instance_count, semantic_map.nbytes())
