"""Runs callbacks in threads, survives what they raise and ends without cutting them off."""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable
from typing import Any

from rclpy.executors import MultiThreadedExecutor

EXECUTOR_THREADS = 16
"""Inputs, outputs, status, parameters, the lifecycle and each service have a group that runs one callback at a time."""

_PAUSE_S = 0.1


class CallbackExecutor(MultiThreadedExecutor):
    """A multi-threaded executor that can be ended without cutting callbacks off."""

    def __init__(self, num_threads: int = EXECUTOR_THREADS, **options: Any) -> None:
        """As the base class."""
        super().__init__(num_threads, **options)

    def spin(self) -> None:
        """Execute callbacks until shutdown."""
        try:
            super().spin()
        except AttributeError:
            # A shutdown from another thread takes guards away that this one may be about to wait for.
            if not self._is_shutdown:
                raise

    def spin_on(self, report: Callable[[str], object]) -> None:
        """Execute callbacks until shutdown, whatever they raise.

        Args:
            report: Takes the traceback of a callback that failed.
        """
        while self._context.ok() and not self._is_shutdown:
            try:
                self.spin()
            except Exception:
                report(f"a callback failed\n{traceback.format_exc()}")
                time.sleep(_PAUSE_S)  # What fails at once, again and again, must not take the processor.

    def finish(self, timeout_s: float) -> bool:
        """Start no more callbacks; whether those in work were done within the time."""
        self.shutdown()
        return bool(self._work_tracker.wait(timeout_s))
