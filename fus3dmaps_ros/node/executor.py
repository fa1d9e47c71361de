"""An executor that runs callbacks in threads, survives their exceptions and lets them finish when it ends."""

from __future__ import annotations

import threading
import time
import traceback
from collections.abc import Callable
from typing import Any

from rclpy.executors import MultiThreadedExecutor

EXECUTOR_THREADS = 16
"""Enough for inputs, outputs, status, parameters, the lifecycle and each service, which run one callback at a time."""

_PAUSE_S = 0.1


class CallbackExecutor(MultiThreadedExecutor):
    """A multi-threaded executor whose shutdown waits for the callbacks that are running."""

    def __init__(self, num_threads: int = EXECUTOR_THREADS, **options: Any) -> None:
        """Take the options of the base class."""
        super().__init__(num_threads, **options)
        self._not_spinning = threading.Event()
        self._not_spinning.set()

    def spin(self) -> None:
        """Execute callbacks until shutdown; only one thread may spin at a time."""
        self._not_spinning.clear()
        try:
            while self._context.ok() and not self._is_shutdown:
                self.spin_once()
        finally:
            self._not_spinning.set()

    def spin_on(self, report: Callable[[str], object]) -> None:
        """Execute callbacks until shutdown and go on when one raises an exception.

        Args:
            report: Called with the traceback of a callback that failed.
        """
        while self._context.ok() and not self._is_shutdown:
            try:
                self.spin()
            except Exception:
                report(f"a callback failed\n{traceback.format_exc()}")
                time.sleep(_PAUSE_S)  # A callback that fails again and again must not use up the processor.

    def shutdown(self, timeout_sec: float | None = None) -> bool:
        """Start no more callbacks, let the spinning thread return and wait for the callbacks that are running.

        Args:
            timeout_sec: How long to wait, in seconds; forever if None or negative.

        Returns:
            Whether all callbacks finished in time.
        """
        endless = timeout_sec is None or timeout_sec < 0
        end_s = time.monotonic() + (0.0 if timeout_sec is None else timeout_sec)
        self._is_shutdown = True
        # The base class wakes the spinning thread once and then destroys the means to wake it. In between that thread could
        # begin another wait and never return, so it is woken here until it has returned.
        while not self._not_spinning.wait(0.0):
            if not endless and time.monotonic() >= end_s:
                break
            self.wake()
            self._not_spinning.wait(_PAUSE_S)
        super().shutdown(0.0)
        if self._not_spinning.is_set():
            self._executor.shutdown(wait=False)
        return bool(self._work_tracker.wait(None if endless else max(0.0, end_s - time.monotonic())))
