"""Work with a time limit: who waits is told in time, and what cannot be interrupted ends on its own."""

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
    """A call was not done within its time."""


class Deadline:
    """A moment by which a call must be answered."""

    def __init__(self, timeout_s: float) -> None:
        """So many seconds from now, by a steady clock."""
        self.timeout_s = timeout_s
        self._end_s = time.monotonic() + timeout_s

    def remaining_s(self) -> float:
        """Seconds left; 0 once it has passed."""
        return max(0.0, self._end_s - time.monotonic())


class TimedCalls:
    """Runs one piece of work at a time in a thread of its own."""

    def __init__(self, name: str) -> None:
        """Nothing is in work yet.

        Args:
            name: Of the service, for messages and the thread.
        """
        self._name = name
        self._free = threading.Semaphore()

    def run(self, work: Callable[[], T], deadline: Deadline, afterwards: str = "") -> T:
        """Run work and wait for its result until a deadline; then its result is thrown away when it comes.

        Args:
            work: What to do; must leave everything whole if nobody takes its result.
            deadline: Until when to wait.
            afterwards: What becomes of the work after that, for the message.

        Raises:
            CallTimeoutError: Not done in time, or the work before it still goes on.
            Exception: What the work raises.
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
    """Wait for what was given to the mapping thread; what has not begun by the deadline never will.

    Args:
        future: Of :meth:`FrameWorker.between_frames`, for work of an instant.
        deadline: Until when it must have begun.

    Raises:
        CallTimeoutError: The frame in work was not done in time.
        MapError: The mapping thread ends.
        Exception: What the work raises.
    """
    with contextlib.suppress(TimeoutError, CancelledError):
        future.exception(deadline.remaining_s())
    if not future.done() and future.cancel():
        raise CallTimeoutError(f"the frame in work was not done within {deadline.timeout_s:g} s; the map is as it was")
    if future.cancelled():
        raise MapError("the node is shutting down or being cleaned up; the map is as it was")
    return future.result()
