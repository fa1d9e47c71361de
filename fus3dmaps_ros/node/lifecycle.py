"""A managed node on which transitions that are refused or fail are logged and do not end the process."""

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
"""Labels of the primary states between which a manager moves the node. The fourth is "finalized"."""


class ManagedNode(LifecycleNodeMixin, Node):
    """A lifecycle node whose transitions are plain methods, which raise an exception if they fail.

    Subclasses implement :meth:`configure`, :meth:`activate`, :meth:`deactivate` and :meth:`cleanup`. After an exception the
    node is in the state that it was in before; the reason is logged and kept in ``failure``. The state can be asked for at
    any time, even during a long transition.

    Attributes:
        autostart: Whether the node is brought up when it starts, without a lifecycle manager.
        failure: The exception of the last transition; None if it succeeded.
    """

    def __init__(self, name: str, **options: Any) -> None:
        """Start unconfigured.

        Args:
            name: The node's name.
            options: Options of ``rclpy.node.Node``.
        """
        self.autostart = False
        self.failure: Exception | None = None
        self._transition = threading.Lock()
        Node.__init__(self, name, **options)
        LifecycleNodeMixin.__init__(self, callback_group=ReentrantCallbackGroup())
        # The exceptions of rclpy's own callback, when a transition is not possible now, would end the executor.
        self._change_state_of_rclpy = self._service_change_state.callback
        self._service_change_state.callback = self._change_state

    @property
    def state(self) -> str:
        """Label of the state, e.g. "active"."""
        return str(self._state_machine.current_state[1])

    def bring_up(self) -> None:
        """Configure and activate.

        Raises:
            Exception: One of them failed; the node stays in the state that it had reached.
        """
        for trigger in (self.trigger_configure, self.trigger_activate):
            self._attempt(trigger)

    def configure(self) -> None:
        """Go from unconfigured to inactive; after a failure :meth:`cleanup` frees what was made so far."""
        raise NotImplementedError

    def activate(self) -> None:
        """Go from inactive to active."""
        raise NotImplementedError

    def deactivate(self) -> None:
        """Go from active to inactive; also undoes an activation that failed half-way."""
        raise NotImplementedError

    def cleanup(self) -> None:
        """Free what :meth:`configure` has made, even if it made only part of it."""
        raise NotImplementedError

    def stop(self, timeout_s: float) -> bool:
        """Stop working, in any state, because the process ends; return whether that was done in time."""
        raise NotImplementedError

    def save_last(self, hurried: Callable[[], bool]) -> bool:
        """Save what is due after :meth:`stop`, until ``hurried()`` is true; return whether no save is in progress."""
        raise NotImplementedError

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Configure, for the state machine."""
        return self._run("configure", self.configure, self.cleanup)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Activate, for the state machine."""
        return self._run("activate", self.activate, self.deactivate)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Deactivate, for the state machine."""
        return self._run("deactivate", self.deactivate)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Clean up, for the state machine."""
        return self._run("cleanup", self.cleanup)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Deactivate and clean up, from any primary state, for the state machine."""
        return self._run("shutdown", self._give_back)

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Leave the node unconfigured, ready for another attempt, for the state machine."""
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
            self.failure = self.failure or error  # The first one, not those of the recovery.
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
            return self._change_state_of_rclpy(request, response)
        except rclpy_implementation.RCLError:
            self.get_logger().warning(f"transition '{asked}' refused: not possible from state '{self.state}'")
            return response
        finally:
            self._transition.release()
