"""The services ``~/query_text``, ``~/fuse`` and ``~/reset``. Whatever goes wrong is a reply, never an exception."""

from __future__ import annotations

import traceback
from collections.abc import Callable
from concurrent.futures import CancelledError
from typing import Any

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.node import Node
from std_srvs.srv import Trigger

from fus3dmaps_core.config import Config
from fus3dmaps_core.errors import Fus3dmapsError, MapError
from fus3dmaps_core.pipeline import Pipeline
from fus3dmaps_core.query import DEFAULT_LAYER, TextQuery, answer_query
from fus3dmaps_msgs.srv import Fuse, QueryText
from fus3dmaps_ros import conversions
from fus3dmaps_ros.inputs import Inputs
from fus3dmaps_ros.outputs import Outputs
from fus3dmaps_ros.worker import FrameWorker

_RESET_TIMEOUT_S = 30.0


class Services:
    """Answers queries and commands while mapping goes on."""

    def __init__(
        self,
        node: Node,
        pipeline: Pipeline,
        worker: FrameWorker,
        inputs: Inputs,
        outputs: Outputs,
        read: Callable[[], Config],
    ) -> None:
        """Offer the services.

        Args:
            node: Owner of the services.
            pipeline: Its map and text encoder answer.
            worker: The thread that feeds the pipeline.
            inputs: Forgets what waits on a reset.
            outputs: Publishes answers.
            read: Gives the configuration in force.
        """
        self._log_error = node.get_logger().error
        self._pipeline = pipeline
        self._worker = worker
        self._inputs = inputs
        self._outputs = outputs
        self._read = read
        # Two groups: a reset that waits for the frame in work does not hold up queries. Within one, calls take turns,
        # since text encoders need not be thread-safe.
        queries, commands = MutuallyExclusiveCallbackGroup(), MutuallyExclusiveCallbackGroup()
        self._services = [
            node.create_service(QueryText, "~/query_text", self.query_text, callback_group=queries),
            node.create_service(Fuse, "~/fuse", self.fuse, callback_group=commands),
            node.create_service(Trigger, "~/reset", self.reset, callback_group=commands),
        ]

    def query_text(self, request: Any, response: Any) -> Any:
        """Answer a text query; a threshold of 0 leaves nothing out, a top_k of 0 takes ``query.top_k``."""

        def answer() -> str:
            settings = self._read().query
            query = TextQuery(
                list(request.prompts),
                tuple(request.negative_prompts),
                request.layer or DEFAULT_LAYER,
                None if request.threshold == 0.0 else request.threshold,
                request.top_k or settings.top_k,
                settings.min_voxels,
            )
            query.check()
            trio = self._pipeline.trio
            # Before the map is read: what it holds may be newer than the stamp, never older.
            header = self._outputs.header()
            found = answer_query(self._pipeline.semantic_map, trio.text, query, trio.logit_scale)
            response.instances = [conversions.to_instance(header, instance) for instance in found.instances]
            response.similarity = conversions.to_similarity_cloud(header, found)
            if request.publish:
                self._outputs.publish_similarity(response.similarity)
            return f"{len(found.instances)} instances and {len(found.points_m)} voxels of layer '{found.layer}'"

        return self._reply("query_text", response, answer)

    def fuse(self, _: Any, response: Any) -> Any:
        """Fuse the layers."""

        def fuse() -> str:
            if self._pipeline.semantic_map.voxel_count == 0:
                raise MapError("the map is empty: nothing has been mapped yet")
            report = self._pipeline.semantic_map.fuse()
            response.instances, response.updated, response.voxels = report.instances, report.updated, report.voxels
            response.duration = conversions.to_duration(report.duration_s)
            return f"{report.updated} of {report.instances} instances fused anew in {report.duration_s:.3f} s"

        return self._reply("fuse", response, fuse)

    def reset(self, _: Any, response: Any) -> Any:
        """Empty the map, once the frame in work is done."""

        def reset() -> str:
            self._inputs.reset()
            done = self._worker.reset()
            try:
                done.result(_RESET_TIMEOUT_S)
            except TimeoutError:
                done.cancel()
                raise MapError(
                    f"the frame in work was not done within {_RESET_TIMEOUT_S:.0f} s; the map is as it was"
                ) from None
            except CancelledError:
                raise MapError("the node is shutting down") from None
            self._outputs.clear_similarity()
            return "the map is empty"

        return self._reply("reset", response, reset)

    def _reply(self, service: str, response: Any, work: Callable[[], str]) -> Any:
        try:
            response.message = work()
            response.success = True
        except Fus3dmapsError as error:
            response.success, response.message = False, str(error)
        except Exception as error:
            # A defect, or a device that failed: the caller is told, the log has the details, the node lives on.
            response.success, response.message = False, f"internal error: {type(error).__name__}: {error}"
            self._log_error(f"{service} failed\n{traceback.format_exc()}")
        return response
