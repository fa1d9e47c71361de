"""Work with a time limit: callers are answered in time, and work that cannot be interrupted ends on its own."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable
from concurrent.futures import CancelledError, Future, wait
from typing import TypeVar

from fus3dmaps_core.errors import Fus3dmapsError, MapError

T = TypeVar("T")


class CallTimeoutError(Fus3dmapsError):
    """A call was not done in time."""


class Deadline:
    """A time by which a call must be answered."""

    def __init__(self, timeout_s: float) -> None:
        """Set it ``timeout_s`` seconds from now, on a steady clock."""
        self.timeout_s = timeout_s
        self._end_s = time.monotonic() + timeout_s

    def remaining_s(self) -> float:
        """Return the seconds left; 0 after the deadline."""
        return max(0.0, self._end_s - time.monotonic())


class TimedCalls:
    """Runs one piece of work at a time in a thread of its own."""

    def __init__(self, name: str) -> None:
        """Start without any work.

        Args:
            name: The service's name, for messages and the thread.
        """
        self._name = name
        self._free = threading.Semaphore()

    def run(self, work: Callable[[], T], deadline: Deadline, afterwards: str = "") -> T:
        """Run work and wait for its result until a deadline; a result that comes later is discarded.

        Args:
            work: The function to call; its effects must be complete even if nobody takes its result.
            deadline: The latest time to wait for.
            afterwards: What happens to the work after the deadline, for the message.

        Raises:
            CallTimeoutError: The work is not done in time, or an earlier one is still in progress.
            Exception: Any exception of the work.
        """
        if not self._free.acquire(timeout=deadline.remaining_s()):
            raise CallTimeoutError(
                f"an earlier {self._name} is still in work after {deadline.timeout_s:g} s; try again later"
            )
        future: Future[T] = Future()

        def target() -> None:
            try:
                result = work()
            except BaseException as error:
                self._free.release()
                future.set_exception(error)
            else:
                self._free.release()
                future.set_result(result)

        # Daemon: native code that hangs must not keep the process from ending.
        threading.Thread(target=target, name=self._name, daemon=True).start()
        wait([future], deadline.remaining_s())
        if not future.done():
            raise CallTimeoutError(
                f"{self._name} was not done within {deadline.timeout_s:g} s" + (f"; {afterwards}" if afterwards else "")
            )
        return future.result()


def between_frames(future: Future[T], deadline: Deadline) -> T:
    """Wait for a short call that the mapping thread makes; if it has not begun by the deadline, cancel it.

    Args:
        future: Result of :meth:`FrameWorker.between_frames`.
        deadline: The time by which the call must have begun.

    Raises:
        CallTimeoutError: The mapping thread was busy with a frame until the deadline.
        MapError: The mapping thread ends.
        Exception: Any exception of the call.
    """
    with contextlib.suppress(TimeoutError, CancelledError):
        future.exception(deadline.remaining_s())
    if not future.done() and future.cancel():
        raise CallTimeoutError(f"the frame in work was not done within {deadline.timeout_s:g} s; the map is as it was")
    if future.cancelled():
        raise MapError("the node is shutting down or being cleaned up; the map is as it was")
    return future.result()
