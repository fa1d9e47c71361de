"""Work that is done one step ahead of whoever uses it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

T = TypeVar("T")


def computed_ahead(tasks: Iterable[Callable[[], T]]) -> Iterator[T]:
    """Results of tasks, in order; each task but the first runs on another thread while the result before it is used.

    No two tasks run at once. One that the other thread has not begun by the time it is needed, because the machine is busy,
    runs on the caller's.
    """
    waiting = iter(tasks)
    first = next(waiting, None)
    if first is None:
        return
    result = first()
    with ThreadPoolExecutor(1, thread_name_prefix="ahead") as helper:
        for task in waiting:
            future = helper.submit(task)
            yield result
            result = task() if future.cancel() else future.result()
    yield result
