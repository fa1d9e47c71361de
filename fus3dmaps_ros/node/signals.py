"""SIGINT and SIGTERM: the first one stops the program, a later one says not to wait any longer."""

from __future__ import annotations

import signal
import time

STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM)
ECHO_S = 1.0
"""Signals this soon after the first are the same request: service managers signal a launch, and the launch its nodes."""


class StopSignals:
    """Takes both signals for this process; the first raises KeyboardInterrupt in the main thread, no other does.

    Attributes:
        hurried: Whether one came more than ``ECHO_S`` after the first.
    """

    def __init__(self) -> None:
        """Take them from now on; must be called by the main thread."""
        self.hurried = False
        self._first_s: float | None = None
        for number in STOP_SIGNALS:
            signal.signal(number, self._take)

    def hold(self) -> None:
        """Have no signal interrupt any more: what comes now is as after a first one."""
        if self._first_s is None:
            self._first_s = time.monotonic()

    def _take(self, number: int, frame: object) -> None:
        now_s = time.monotonic()
        if self._first_s is None:
            self._first_s = now_s
            raise KeyboardInterrupt
        self.hurried |= now_s - self._first_s > ECHO_S
