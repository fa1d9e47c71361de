"""What the first signal does, and what the next ones do."""

from __future__ import annotations

import contextlib
import signal
from concurrent.futures import Future
from threading import Timer
from types import SimpleNamespace

import pytest

from fus3dmaps_ros.node import signals as module
from fus3dmaps_ros.node.signals import ECHO_S, STOP_SIGNALS, StopSignals


@pytest.fixture
def clock(monkeypatch) -> list[float]:
    """The time that it is, to be set."""
    now_s = [100.0]
    monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=lambda: now_s[0]))
    return now_s


@pytest.mark.parametrize("number", STOP_SIGNALS)
def test_the_first_signal_interrupts_and_only_a_later_one_hurries(signals, clock, number) -> None:
    stop = StopSignals()
    with pytest.raises(KeyboardInterrupt):
        signal.raise_signal(number)
    assert not stop.hurried
    for other in STOP_SIGNALS:
        signal.raise_signal(other)
    clock[0] += ECHO_S
    signal.raise_signal(number)
    assert not stop.hurried
    clock[0] += 0.1
    signal.raise_signal(number)
    assert stop.hurried


def test_after_an_end_for_another_reason_no_signal_interrupts(signals, clock) -> None:
    stop = StopSignals()
    stop.hold()
    signal.raise_signal(signal.SIGTERM)
    assert not stop.hurried
    clock[0] += ECHO_S + 0.1
    stop.hold()
    signal.raise_signal(signal.SIGINT)
    assert stop.hurried


def test_work_that_ends_is_waited_for_and_its_error_is_raised(signals) -> None:
    stop, work, failing = StopSignals(), Future(), Future()
    Timer(0.05, work.set_result, [None]).start()
    stop.wait_for(work)
    failing.set_exception(OSError("gone"))
    with pytest.raises(OSError, match="gone"):
        stop.wait_for(failing)


@pytest.mark.parametrize("number", STOP_SIGNALS)
def test_a_signal_ends_the_wait_even_if_what_it_raised_was_lost(signals, number) -> None:
    stop = StopSignals()
    Timer(0.05, signal.raise_signal, [number]).start()  # From a thread, as a process gets it from outside.
    with pytest.raises(KeyboardInterrupt):
        stop.wait_for(Future())
    stop = StopSignals()
    with contextlib.suppress(KeyboardInterrupt):
        signal.raise_signal(number)
    with pytest.raises(KeyboardInterrupt):
        stop.wait_for(Future())
