"""SIGINT and SIGTERM: the first one stops the program, a later one stops it without waiting."""

from __future__ import annotations

import signal
import time
from concurrent.futures import Future, wait
from typing import Any

STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM)
ECHO_S = 1.0
"""Signals within this time of the first are the same request: service managers signal a launch, and it signals nodes."""

_LOOK_S = 0.5


class StopSignals:
    """Handler of both signals in this process. Only the first raises KeyboardInterrupt, in the main thread.

    Attributes:
        hurried: Whether a signal came more than ``ECHO_S`` after the first.
    """

    def __init__(self) -> None:
        """Install the handler; must be called by the main thread."""
        self.hurried = False
        self._first_s: float | None = None
        for number in STOP_SIGNALS:
            signal.signal(number, self._take)

    def hold(self) -> None:
        """Let no signal interrupt any more: the next one counts as if there had been a first one now."""
        if self._first_s is None:
            self._first_s = time.monotonic()

    def wait_for(self, work: Future[Any]) -> None:
        """Wait until work is done, and raise what it raised.

        Raises:
            KeyboardInterrupt: A signal came first.
        """
        # In steps: a signal that another thread receives does not wake this one, and what the handler raises may be lost in
        # foreign code that it interrupts.
        while not wait([work], _LOOK_S).done:
            if self._first_s is not None:
                raise KeyboardInterrupt
        work.result()

    def _take(self, number: int, frame: object) -> None:
        now_s = time.monotonic()
        if self._first_s is None:
            self._first_s = now_s
            raise KeyboardInterrupt
        self.hurried |= now_s - self._first_s > ECHO_S
