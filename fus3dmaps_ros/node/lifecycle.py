"""A managed node that survives what managers ask of it: transitions that are refused or fail are words in the log."""

from __future__ import annotations

import threading
import traceback
from collections.abc import Callable
from typing import Any

from lifecycle_msgs.srv import ChangeState
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.lifecycle import LifecycleNodeMixin, LifecycleState, TransitionCallbackReturn
from rclpy.node import Node

from fus3dmaps_ros.node.refusals import REFUSALS, one_line

UNCONFIGURED, INACTIVE, ACTIVE = "unconfigured", "inactive", "active"
"""Labels of the primary states between which a manager moves the node; the fourth is "finalized"."""


class ManagedNode(LifecycleNodeMixin, Node):
    """A lifecycle node whose transitions are written as plain methods that return, or raise why they cannot.

    Subclasses implement :meth:`configure`, :meth:`activate`, :meth:`deactivate` and :meth:`cleanup`. One that raises leaves
    the node in the state that it was in; the reason is logged, and kept in ``failure``. States are told at once, also
    while a transition takes long.

    Attributes:
        failure: What the last transition failed with; None if it succeeded.
    """

    def __init__(self, name: str, **options: Any) -> None:
        """Start unconfigured.

        Args:
            name: Of the node.
            options: For ``rclpy.node.Node``.
        """
        self.failure: Exception | None = None
        self._transition = threading.Lock()
        Node.__init__(self, name, **options)
        LifecycleNodeMixin.__init__(self, callback_group=ReentrantCallbackGroup())
        # rclpy's own callback raises out of the executor when a transition is not possible now.
        self._obey = self._service_change_state.callback
        self._service_change_state.callback = self._change_state

    @property
    def state(self) -> str:
        """Label of the state, e.g. "active"."""
        return str(self._state_machine.current_state[1])

    def bring_up(self) -> None:
        """Configure and activate.

        Raises:
            Exception: What one of them failed with; the node stays in the state that it had reached.
        """
        for trigger in (self.trigger_configure, self.trigger_activate):
            self._attempt(trigger)

    def configure(self) -> None:
        """Make ready, from unconfigured to inactive; what was made before a failure is taken back by :meth:`cleanup`."""
        raise NotImplementedError

    def activate(self) -> None:
        """Begin to work, from inactive to active."""
        raise NotImplementedError

    def deactivate(self) -> None:
        """Rest, from active to inactive; also undoes an activation that failed half-way."""
        raise NotImplementedError

    def cleanup(self) -> None:
        """Give back what :meth:`configure` has made, however much of it there is."""
        raise NotImplementedError

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Called by the state machine."""
        return self._run("configure", self.configure, self.cleanup)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Called by the state machine."""
        return self._run("activate", self.activate, self.deactivate)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Called by the state machine."""
        return self._run("deactivate", self.deactivate)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Called by the state machine."""
        return self._run("cleanup", self.cleanup)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Called by the state machine; from any primary state."""
        return self._run("shutdown", self._give_back)

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Called by the state machine; leaves the node unconfigured, ready for another attempt."""
        return self._run("recovery", self._give_back)

    def _give_back(self) -> None:
        try:
            self.deactivate()
        finally:
            self.cleanup()

    def _run(self, name: str, work: Callable[[], None], undo: Callable[[], None] | None = None) -> TransitionCallbackReturn:
        try:
            work()
        except Exception as error:
            self.failure = self.failure or error  # What came first, not what its recovery met.
            self._report(name, error)
            if undo is not None:
                try:
                    undo()
                except Exception as second:
                    self._report(f"taking back {name}", second)
                    return TransitionCallbackReturn.ERROR
            return TransitionCallbackReturn.FAILURE
        return TransitionCallbackReturn.SUCCESS

    def _report(self, name: str, error: Exception) -> None:
        details = "" if isinstance(error, REFUSALS) else f"\n{traceback.format_exc()}"
        self.get_logger().error(f"{name} failed: {one_line(error)}{details}")

    def _attempt(self, trigger: Callable[[], TransitionCallbackReturn]) -> None:
        with self._transition:
            self.failure = None
            if trigger() != TransitionCallbackReturn.SUCCESS:
                raise self.failure or RuntimeError(f"{trigger.__name__} failed in state '{self.state}'")

    def _change_state(self, request: ChangeState.Request, response: ChangeState.Response) -> ChangeState.Response:
        asked = request.transition.label or request.transition.id
        response.success = False
        if not self._transition.acquire(blocking=False):
            self.get_logger().warning(f"transition '{asked}' refused: another one is under way")
            return response
        self.failure = None
        try:
            return self._obey(request, response)
        except rclpy_implementation.RCLError:
            self.get_logger().warning(f"transition '{asked}' refused: not possible from state '{self.state}'")
            return response
        finally:
            self._transition.release()
