"""Counting what is dropped and saying so, without flooding the log."""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Callable

_PERIOD_S = 5.0


class DropLog:
    """Counts drops by reason and logs each reason at once, then at most once a period. Thread-safe."""

    def __init__(self, warn: Callable[[str], object], clock: Callable[[], float] = time.monotonic) -> None:
        """Start at zero.

        Args:
            warn: Takes a line for the log.
            clock: Seconds of a clock that never goes back.
        """
        self._warn = warn
        self._clock = clock
        self._lock = threading.Lock()
        self._counts: Counter[str] = Counter()
        self._unreported: Counter[str] = Counter()
        self._due_s: dict[str, float] = {}
        self.observe: Callable[[str, str, int], None] | None = None
        """Is told every reason, sentence and number at once."""

    def count(self, reason: str, sentence: str, number: int = 1) -> None:
        """Count drops.

        Args:
            reason: Machine-readable cause, snake_case.
            sentence: What happened to the latest of them; names the topic.
            number: How many.
        """
        observe = self.observe
        if observe is not None:
            observe(reason, sentence, number)
        with self._lock:
            self._counts[reason] += number
            self._unreported[reason] += number
            now_s = self._clock()
            if now_s < self._due_s.get(reason, now_s):
                return
            self._due_s[reason] = now_s + _PERIOD_S
            unreported = self._unreported.pop(reason)
        self._warn(f"dropped {unreported} ({reason}): {sentence}")

    def counts(self) -> Counter[str]:
        """Drops by reason since the start."""
        with self._lock:
            return Counter(self._counts)
