"""Threads for compiled loops.

On a machine whose cores are busy, a thread may wait for a core longer than the whole work takes. So work is cut into a few
parts for each thread. Whoever is free takes the next part, and the caller waits only for parts that somebody has begun.
There are few parts, because between two of them a thread has to wait for its turn in the interpreter.
"""

from __future__ import annotations

import itertools
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import torch

_PARTS_PER_THREAD = 4
_STEPS_PER_LANE = 6


class Workers:
    """The calling thread and its helpers, together as many threads as torch uses."""

    def __init__(self) -> None:
        """Start no thread yet."""
        self._executor: ThreadPoolExecutor | None = None

    def run(self, tasks: list[Callable[[], Any]]) -> list[Any]:
        """Run independent tasks on this thread and the helpers; returns their results in order."""
        results: list[Any] = [None] * len(tasks)
        waiting = iter(range(len(tasks)))  # Taking the next number is atomic.

        def work() -> None:
            for index in waiting:
                results[index] = tasks[index]()

        helpers = min(torch.get_num_threads(), len(tasks)) - 1
        if helpers > 0 and self._executor is None:
            self._executor = ThreadPoolExecutor(torch.get_num_threads() - 1, thread_name_prefix="map_kernels")
        futures = [self._executor.submit(work) for _ in range(helpers)] if self._executor and helpers > 0 else []
        work()
        for future in futures:
            if not future.cancel():
                future.result()
        return results


def cuts(count: int, least: int) -> list[tuple[int, int]]:
    """Cut [0, count) into a few parts for each thread, none much smaller than ``least``."""
    parts = min(1 + count // max(least, 1), _PARTS_PER_THREAD * torch.get_num_threads())
    return list(itertools.pairwise(count * part // parts for part in range(parts + 1)))


class Lanes:
    """Work that is dealt out to a fixed number of lanes; one thread at a time goes on with a lane, in order.

    Where every lane has a sum of its own, sums depend neither on the number of threads nor on which thread was late.
    """

    def __init__(self, count: int, lanes: int) -> None:
        """Give lane i every ``lanes``-th of ``count`` things, from the i-th on."""
        self._count, self._lanes = count, lanes
        self._span = lanes * max(1, -(-count // (lanes * _STEPS_PER_LANE)))
        self._next = list(range(lanes))
        self._free = set(range(lanes))
        self._lock = threading.Lock()

    def __iter__(self) -> Iterator[tuple[int, int, int]]:
        """Yield the free lane that is furthest behind, its first thing and the step's end, until no lane is free."""
        while True:
            with self._lock:
                lane = min(self._free, key=lambda lane: (self._next[lane], lane), default=None)
                if lane is None or self._next[lane] >= self._count:
                    return
                first = self._next[lane]
                self._next[lane] = first + self._span
                self._free.remove(lane)
            yield lane, first, min(first + self._span, self._count)
            with self._lock:
                self._free.add(lane)
