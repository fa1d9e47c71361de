"""Timers whose period is a parameter."""

from __future__ import annotations

from rclpy.node import Node
from rclpy.timer import Timer


def change_period(node: Node, timer: Timer, period_s: float) -> None:
    """Give a timer another period, which begins now; does nothing if it has that period.

    Args:
        node: Owner of the timer.
        timer: The timer.
        period_s: Seconds.
    """
    period_ns = round(period_s * 1e9)
    if timer.timer_period_ns == period_ns:
        return
    timer.timer_period_ns = period_ns
    timer.reset()  # The period alone would only count from the next time that the old one has passed.
    if node.executor is not None:
        node.executor.wake()  # It sleeps until the time that it knew of.
