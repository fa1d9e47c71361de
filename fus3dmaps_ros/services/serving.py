"""What all services have in common: a time limit, and that whatever goes wrong is a reply, never an exception."""

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
    """One call of a service, with the time that it has."""

    def __init__(self, calls: TimedCalls, timeout_s: float) -> None:
        """The time begins."""
        self._calls = calls
        self.deadline = Deadline(timeout_s)

    def in_time(self, work: Callable[[], T], afterwards: str = "") -> T:
        """The result of work that may take long, see :meth:`TimedCalls.run`."""
        return self._calls.run(work, self.deadline, afterwards)


class ServiceGroup:
    """Offers services that wait neither for each other nor for mapping. Calls of one service take turns."""

    def __init__(self, node: Node, read: Callable[[], Config]) -> None:
        """Offer nothing yet.

        Args:
            node: Owner of the services.
            read: Gives the configuration in force; ``node.service_timeout_s`` is the time that each call has.
        """
        self._node = node
        self._read = read
        self._services: list[Any] = []

    def _offer(self, service_type: Any, name: str, answer: Callable[[Any, Any, Call], str]) -> None:
        """Offer a service.

        Args:
            service_type: Its type; the response has ``success`` and ``message``.
            name: Under the node's own name.
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
                # A defect, or a device that failed: the caller is told, the log has the details, the node lives on.
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
        # A fresh one: what a failed call had filled in is no answer. Replacement keeps odd text out of the middleware.
        return service_type.Response(success=False, message=message.encode("utf-8", "replace").decode())
