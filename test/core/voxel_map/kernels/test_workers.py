"""Threads for compiled loops: every task runs once, and lanes are gone through in order by one thread at a time."""

from __future__ import annotations

import threading
import time
from functools import partial

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from fus3dmaps_core.voxel_map.kernels.workers import Lanes, Workers, cuts


@pytest.fixture(params=[1, 2, 4])
def threads(request):
    """Torch's number of threads, for this test only."""
    before = torch.get_num_threads()
    torch.set_num_threads(request.param)
    yield request.param
    torch.set_num_threads(before)


@pytest.mark.parametrize("count", [0, 1, 2, 50])
def test_every_task_runs_once_and_results_are_in_order(threads: int, count: int):
    ran = []

    def task(number: int) -> int:
        ran.append(number)
        return number * number

    assert Workers().run([partial(task, number) for number in range(count)]) == [n * n for n in range(count)]
    assert sorted(ran) == list(range(count))


def test_a_helper_that_is_late_is_not_waited_for(threads: int):
    workers, blocked = Workers(), threading.Event()
    if threads > 1:
        workers.run([lambda: None] * 8)  # Starts the helpers, which are then kept busy.
        for _ in range(threads - 1):
            assert workers._executor is not None
            workers._executor.submit(blocked.wait)
    started = time.monotonic()
    try:
        assert workers.run([lambda: 1] * 20) == [1] * 20
        assert time.monotonic() - started < 5
    finally:
        blocked.set()


def test_what_a_task_raises_comes_out(threads: int):
    with pytest.raises(ZeroDivisionError):
        Workers().run([lambda: 1 // 0] * 3)


@given(st.integers(0, 10**7), st.integers(0, 10**5))
def test_cuts_cover_everything_once(count: int, least: int):
    parts = cuts(count, least)
    assert [0, *(last for _, last in parts)] == [*(first for first, _ in parts), count]
    assert len(parts) == 1 or min(last - first for first, last in parts) >= least // 2


@given(st.integers(0, 500), st.integers(1, 4))
def test_lanes_cover_everything_once_in_order(count: int, lanes: int):
    visited: dict[int, list[int]] = {lane: [] for lane in range(lanes)}
    for lane, first, last in Lanes(count, lanes):
        visited[lane] += range(first, last, lanes)
    assert visited == {lane: list(range(lane, count, lanes)) for lane in range(lanes)}


@pytest.mark.parametrize("count", [1, 7, 400])
def test_lanes_are_shared_by_threads(count: int):
    lanes = Lanes(count, 2)
    visited: list[list[int]] = [[], []]
    inside = [threading.Lock(), threading.Lock()]
    clashes = []

    def work() -> None:
        for lane, first, last in lanes:
            if not inside[lane].acquire(blocking=False):
                clashes.append(lane)
                continue
            time.sleep(0.001)
            visited[lane] += range(first, last, 2)
            inside[lane].release()

    threads = [threading.Thread(target=work) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert clashes == []
    assert visited == [list(range(lane, count, 2)) for lane in range(2)]
