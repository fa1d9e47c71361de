"""Work done ahead: in order, never two at once, one step before it is needed, and nothing is lost when a task fails."""

from __future__ import annotations

import threading
from functools import partial

import pytest

from fus3dmaps_core.ahead import computed_ahead


def test_results_come_in_order():
    for count in range(5):
        assert list(computed_ahead(partial(pow, number, 2) for number in range(count))) == [n * n for n in range(count)]


def test_the_next_task_runs_on_another_thread_while_this_result_is_used():
    begun = threading.Event()
    threads: list[threading.Thread] = []

    def second() -> str:
        threads.append(threading.current_thread())
        begun.set()
        return "second"

    results = computed_ahead([lambda: "first", second])
    assert next(results) == "first"
    assert begun.wait(10.0), "the second task did not begin before it was asked for"
    assert next(results) == "second"
    assert threads[0] is not threading.current_thread()


def test_tasks_never_overlap():
    running, most = 0, 0

    def task() -> None:
        nonlocal running, most
        running += 1
        most = max(most, running)
        running -= 1

    for _ in computed_ahead([task] * 200):
        pass
    assert most == 1


def test_a_failure_arrives_where_its_result_was_awaited():
    results = computed_ahead([lambda: 1, lambda: 1 // 0, lambda: 3])
    assert next(results) == 1
    with pytest.raises(ZeroDivisionError):
        next(results)
