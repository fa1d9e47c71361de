"""Log lines about drops, at a limited rate."""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Callable

_PERIOD_S = 5.0


class DropLog:
    """Logs drops of each reason at once, then at most once a period. Thread-safe."""

    def __init__(self, warn: Callable[[str], object], clock: Callable[[], float] = time.monotonic) -> None:
        """Start with nothing to report.

        Args:
            warn: Takes a line for the log.
            clock: Seconds of a clock that never goes back.
        """
        self._warn = warn
        self._clock = clock
        self._lock = threading.Lock()
        self._unreported: Counter[str] = Counter()
        self._due_s: dict[str, float] = {}

    def report(self, reason: str, sentence: str, number: int) -> None:
        """Log drops, or keep their number for the next line of their reason; an observer of :class:`Drops`."""
        with self._lock:
            self._unreported[reason] += number
            now_s = self._clock()
            if now_s < self._due_s.get(reason, now_s):
                return
            self._due_s[reason] = now_s + _PERIOD_S
            unreported = self._unreported.pop(reason)
        self._warn(f"dropped {unreported} ({reason}): {sentence}")
