"""The numbers of the last few seconds, from which rates, means and shares are computed."""

from __future__ import annotations

from collections import deque


class RecentNumbers:
    """The numbers that came within the last ``length_s`` seconds. Not thread-safe: callers hold a lock."""

    def __init__(self, length_s: float) -> None:
        """Start empty.

        Args:
            length_s: How long a number is kept, seconds.
        """
        self._length_s = length_s
        self._numbers: deque[tuple[float, float]] = deque()

    def add(self, now_s: float, number: float = 1.0) -> None:
        """Add a number; ``now_s`` must not go back."""
        self._numbers.append((now_s, number))
        self._forget(now_s)

    def numbers(self, now_s: float) -> list[float]:
        """List the numbers that came less than ``length_s`` ago, oldest first."""
        self._forget(now_s)
        return [number for _, number in self._numbers]

    def _forget(self, now_s: float) -> None:
        while self._numbers and self._numbers[0][0] <= now_s - self._length_s:
            self._numbers.popleft()
