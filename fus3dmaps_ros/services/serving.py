"""The base of all services: each call has a time limit, and every failure becomes a reply."""

from __future__ import annotations

import traceback
from collections.abc import Callable
from typing import Any, TypeVar

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.node import Node

from fus3dmaps_core.config.schema import Config
from fus3dmaps_core.errors import Fus3dmapsError
from fus3dmaps_ros.node.timed_calls import Deadline, TimedCalls
from fus3dmaps_ros.topics.qos import SERVICE_QOS

T = TypeVar("T")


class Call:
    """One call of a service, with its time limit."""

    def __init__(self, calls: TimedCalls, timeout_s: float) -> None:
        """Start the time."""
        self._calls = calls
        self.deadline = Deadline(timeout_s)

    def in_time(self, work: Callable[[], T], afterwards: str = "") -> T:
        """Run work that may take long and return its result, see :meth:`TimedCalls.run`."""
        return self._calls.run(work, self.deadline, afterwards)


class ServiceGroup:
    """Services that wait neither for each other nor for mapping. Calls of one service take turns."""

    def __init__(self, node: Node, read: Callable[[], Config]) -> None:
        """Start without services.

        Args:
            node: Owner of the services.
            read: Returns the current configuration; ``node.service_timeout_s`` is the time limit of each call.
        """
        self._node = node
        self._read = read
        self._services: list[Any] = []

    def _offer(self, service_type: Any, name: str, answer: Callable[[Any, Any, Call], str]) -> None:
        """Offer a service.

        Args:
            service_type: The service's type; its response has ``success`` and ``message``.
            name: The service's name below the node's own name.
            answer: Takes request, response and call, fills in the response and returns the message of success.
        """
        calls = TimedCalls(name)

        def reply(request: Any, response: Any) -> Any:
            try:
                response.message = answer(request, response, Call(calls, self._read().node.service_timeout_s))
                response.success = True
            except Fus3dmapsError as error:
                response = self._refusal(service_type, str(error))
            except Exception as error:
                # A bug, or a device that failed: the caller gets a message, the log gets the details, and the node goes on.
                response = self._refusal(service_type, f"internal error: {type(error).__name__}: {error}")
                self._node.get_logger().error(f"{name} failed\n{traceback.format_exc()}")
            return response

        self._services.append(
            self._node.create_service(
                service_type,
                f"~/{name}",
                reply,
                qos_profile=SERVICE_QOS,
                callback_group=MutuallyExclusiveCallbackGroup(),
            )
        )

    @staticmethod
    def _refusal(service_type: Any, message: str) -> Any:
        # A new response, because a failed call may have filled in half of one. Odd text could break the middleware.
        return service_type.Response(success=False, message=message.encode("utf-8", "replace").decode())
