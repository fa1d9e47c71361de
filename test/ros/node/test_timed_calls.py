"""Who waits is told in time; what was given up leaves nothing behind."""

from __future__ import annotations

import threading
from concurrent.futures import Future

import pytest
from robot import wait_until

from fus3dmaps_core.errors import MapError
from fus3dmaps_ros.node.timed_calls import CallTimeoutError, Deadline, TimedCalls, between_frames


def test_results_and_exceptions_come_through() -> None:
    calls = TimedCalls("ask")
    assert calls.run(lambda: 7, Deadline(60)) == 7
    for error in (ValueError("odd"), TimeoutError("of the disk")):

        def fail(error: Exception = error) -> None:
            raise error

        with pytest.raises(type(error), match=str(error)):
            calls.run(fail, Deadline(60))
    assert calls.run(lambda: 8, Deadline(60)) == 8


def test_work_beyond_its_time_is_given_up_and_the_next_waits_for_it() -> None:
    calls, gate = TimedCalls("ask"), threading.Event()
    with pytest.raises(CallTimeoutError, match=r"ask was not done within 0.01 s; it goes on"):
        calls.run(lambda: gate.wait(60), Deadline(0.01), "it goes on")
    with pytest.raises(CallTimeoutError, match="earlier ask"):
        calls.run(lambda: None, Deadline(0.01))
    gate.set()
    assert calls.run(lambda: 9, Deadline(60)) == 9
    wait_until(lambda: not any(thread.name == "ask" for thread in threading.enumerate()), "threads ended")


def test_what_has_not_begun_is_cancelled_and_what_has_is_waited_for() -> None:
    waiting: Future[int] = Future()
    with pytest.raises(CallTimeoutError, match="as it was"):
        between_frames(waiting, Deadline(0.01))
    assert waiting.cancelled()

    running: Future[int] = Future()
    assert running.set_running_or_notify_cancel()
    timer = threading.Timer(0.05, running.set_result, [3])
    timer.start()
    assert between_frames(running, Deadline(0.0)) == 3
    timer.join()


def test_a_thread_that_ends_is_named() -> None:
    future: Future[int] = Future()
    future.cancel()
    with pytest.raises(MapError, match="shutting down"):
        between_frames(future, Deadline(60))
