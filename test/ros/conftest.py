"""A DDS domain of this session's own, and robots that are taken down after their tests."""

from __future__ import annotations

import fcntl
import os
import signal
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import rclpy
from rclpy.context import Context
from rclpy.node import Node


def _claim_domain() -> Any:
    """Lock a free DDS domain for as long as this process lives; several sessions may share the machine."""
    start = os.getpid()
    for attempt in range(90):
        domain = 10 + (start + attempt) % 90
        lock = (Path(tempfile.gettempdir()) / f"fus3dmaps_test_domain_{domain}.lock").open("w")
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            lock.close()
            continue
        os.environ["ROS_DOMAIN_ID"] = str(domain)
        os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
        return lock
    raise RuntimeError("every DDS domain is taken by another test session")


_domain_lock = _claim_domain()

from node_process import start_process  # noqa: E402  (the domain must be chosen first)
from robot import CallbackThreads, Robot  # noqa: E402
from stand_ins import wall_frame  # noqa: E402

STAMP_NS = 1_700_000_000_123_456_789


@pytest.fixture
def make_robot() -> Iterator[Callable[..., Robot]]:
    """Builds robots that are taken down after the test."""
    robots: list[Robot] = []

    def make(*args: Any, **parameters: Any) -> Robot:
        robots.append(Robot(*args, **parameters))
        return robots[-1]

    yield make
    for robot in robots:
        robot.close()


@pytest.fixture
def robot(make_robot: Callable[..., Robot]) -> Robot:
    return make_robot()


@pytest.fixture(scope="module")
def mapped_robot() -> Iterator[Robot]:
    """A robot that has mapped one frame, of STAMP_NS; for tests that change nothing."""
    robot = Robot()
    robot.map(wall_frame(STAMP_NS))
    yield robot
    robot.close()


@pytest.fixture
def stamp_ns() -> int:
    """Stamp of the frame that ``mapped_robot`` has mapped."""
    return STAMP_NS


@pytest.fixture
def start() -> Iterator[Callable[..., subprocess.Popen[str]]]:
    """Starts processes that do not outlive the test; keywords are further environment variables."""
    processes: list[subprocess.Popen[str]] = []

    def begin(command: list[str], **environment: str) -> subprocess.Popen[str]:
        processes.append(start_process(command, **environment))
        return processes[-1]

    yield begin
    for process in processes:
        if process.poll() is None:
            process.kill()
        process.communicate()


@pytest.fixture
def user() -> Iterator[Node]:
    """A node beside those processes."""
    context = Context()
    rclpy.init(args=[], context=context)
    node = Node("user", context=context)
    with CallbackThreads(context, node):
        yield node
    node.destroy_node()
    rclpy.shutdown(context=context)


@pytest.fixture
def signals() -> Iterator[None]:
    """Restores the signal handlers, which ``main`` functions take for themselves."""
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    yield
    for number, handler in handlers.items():
        signal.signal(number, handler)
