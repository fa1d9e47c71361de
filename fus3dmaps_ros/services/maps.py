"""The services that change, save or load the map: ``~/fuse``, ``~/reset``, ``~/save_map`` and ``~/load_map``."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.node import Node
from std_srvs.srv import Trigger

from fus3dmaps_core.config.schema import Config
from fus3dmaps_core.errors import MapError
from fus3dmaps_msgs.srv import Fuse, LoadMap, SaveMap
from fus3dmaps_ros.node.map_store import named_map, read_map, save_session
from fus3dmaps_ros.node.session import SessionHolder
from fus3dmaps_ros.node.timed_calls import between_frames
from fus3dmaps_ros.services.serving import Call, ServiceGroup
from fus3dmaps_ros.topics import conversions
from fus3dmaps_ros.topics.outputs import Outputs


class MapServices(ServiceGroup):
    """Changes, saves and loads the map while mapping goes on."""

    def __init__(
        self,
        node: Node,
        sessions: SessionHolder,
        outputs: Outputs,
        read: Callable[[], Config],
        forget_inputs: Callable[[], None],
    ) -> None:
        """Offer the services.

        Args:
            node: Owner of the services.
            sessions: Has the map.
            outputs: Its latched answers are cleared when their map is replaced.
            read: Returns the current configuration.
            forget_inputs: Makes the inputs forget the messages that wait; called by a reset.
        """
        super().__init__(node, read)
        self._sessions = sessions
        self._outputs = outputs
        self._forget_inputs = forget_inputs
        self._offer(Fuse, "fuse", self._fuse)
        self._offer(Trigger, "reset", self._reset)
        self._offer(SaveMap, "save_map", self._save_map)
        self._offer(LoadMap, "load_map", self._load_map)

    def _fuse(self, _: Any, response: Any, call: Call) -> str:
        semantic_map = self._sessions.require().pipeline.semantic_map
        if semantic_map.voxel_count == 0:
            raise MapError("the map is empty: nothing has been mapped yet")
        report = call.in_time(semantic_map.fuse, afterwards="it goes on")
        response.instances, response.updated, response.voxels = report.instances, report.updated, report.voxels
        response.duration = conversions.to_duration(report.duration_s)
        return f"{report.updated} of {report.instances} instances fused anew in {report.duration_s:.3f} s"

    def _reset(self, _: Any, response: Any, call: Call) -> str:
        session = self._sessions.require()
        self._forget_inputs()
        between_frames(session.worker.reset(), call.deadline)
        self._outputs.clear_answers()
        return "the map is empty"

    def _save_map(self, request: Any, response: Any, call: Call) -> str:
        session = self._sessions.require()
        root, name = self._read().node.map_directory, request.name
        path, size_bytes = call.in_time(
            lambda: save_session(session, root, name),
            afterwards="it goes on, and replaces an earlier map when it is complete",
        )
        response.path, response.bytes = str(path), size_bytes
        return f"saved '{path}', {size_bytes} bytes"

    def _load_map(self, request: Any, response: Any, call: Call) -> str:
        session = self._sessions.require()
        path = named_map(self._read().node.map_directory, request.name)
        semantic_map, info = call.in_time(lambda: read_map(session, path), afterwards="the map is as it was")
        response.voxels, response.instances = semantic_map.voxel_count, semantic_map.instance_count
        between_frames(session.worker.restore(semantic_map, info.stamp_ns, info.camera_poses), call.deadline)
        self._outputs.clear_answers()
        return f"loaded '{path}': {response.voxels} voxels, {response.instances} instances"
