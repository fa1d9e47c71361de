"""Callbacks in threads: what ends, and what survives."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import pytest
import rclpy
from rclpy.context import Context
from rclpy.node import Node
from robot import wait_until

from fus3dmaps_ros.node.executor import CallbackExecutor

TIMEOUT_S = 60.0


@pytest.fixture
def context() -> Iterator[Context]:
    context = Context()
    rclpy.init(args=[], context=context)
    yield context
    rclpy.shutdown(context=context)


@pytest.fixture
def node(context) -> Iterator[Node]:
    node = Node("quiet", context=context, start_parameter_services=False, enable_rosout=False)
    yield node
    node.destroy_node()


def spinning(executor: CallbackExecutor) -> threading.Thread:
    thread = threading.Thread(target=executor.spin, daemon=True)
    thread.start()
    return thread


def test_a_thread_that_waits_returns_however_the_shutdown_meets_it(context, node) -> None:
    for _ in range(100):
        executor = CallbackExecutor(2, context=context)
        executor.add_node(node)
        thread = spinning(executor)
        assert executor.shutdown(TIMEOUT_S)
        thread.join(TIMEOUT_S)
        assert not thread.is_alive()
        executor.remove_node(node)


def test_a_wake_up_that_is_missed_is_repeated(context, node, monkeypatch) -> None:
    executor = CallbackExecutor(2, context=context)
    executor.add_node(node)
    waiting, awake, calls = threading.Event(), threading.Event(), []

    def wait_in_the_middleware() -> None:
        waiting.set()
        assert awake.wait(TIMEOUT_S)

    def deaf_at_first() -> None:
        calls.append(1)
        if len(calls) > 3:
            awake.set()

    monkeypatch.setattr(executor, "spin_once", wait_in_the_middleware)
    monkeypatch.setattr(executor, "wake", deaf_at_first)
    thread = spinning(executor)
    assert waiting.wait(TIMEOUT_S)
    assert executor.shutdown(TIMEOUT_S)
    thread.join(TIMEOUT_S)
    assert not thread.is_alive()
    assert len(calls) > 3


def test_a_callback_in_work_is_waited_for_and_named_when_it_is_too_long(context, node) -> None:
    begun, gate, done = threading.Event(), threading.Event(), threading.Event()

    def callback() -> None:
        if begun.is_set():
            return
        begun.set()
        assert gate.wait(TIMEOUT_S)
        done.set()

    node.create_timer(0.01, callback)
    executor = CallbackExecutor(2, context=context)
    executor.add_node(node)
    thread = spinning(executor)
    assert begun.wait(TIMEOUT_S)
    assert not executor.shutdown(0.1)
    thread.join(TIMEOUT_S)
    assert not thread.is_alive()
    assert not done.is_set()
    gate.set()
    assert executor.shutdown(TIMEOUT_S)
    assert done.is_set()


def test_a_callback_that_fails_is_reported_and_the_next_one_runs(context, node) -> None:
    reports: list[str] = []
    calls = []

    def callback() -> None:
        calls.append(1)
        if len(calls) == 1:
            raise RuntimeError("one that fails")

    node.create_timer(0.01, callback)
    executor = CallbackExecutor(2, context=context)
    executor.add_node(node)
    thread = threading.Thread(target=executor.spin_on, args=(reports.append,), daemon=True)
    thread.start()
    wait_until(lambda: len(calls) > 3, "more calls")
    assert executor.shutdown(TIMEOUT_S)
    thread.join(TIMEOUT_S)
    assert not thread.is_alive()
    assert len(reports) == 1
    assert "one that fails" in reports[0]


def test_a_spin_after_the_shutdown_returns_at_once(context, node) -> None:
    executor = CallbackExecutor(2, context=context)
    executor.add_node(node)
    assert executor.shutdown(TIMEOUT_S)
    executor.spin()
    executor.spin_on(pytest.fail)
