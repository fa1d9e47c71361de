"""Timers whose period is a parameter."""

from __future__ import annotations

from rclpy.node import Node
from rclpy.timer import Timer


def change_period(node: Node, timer: Timer, period_s: float) -> None:
    """Give a timer another period, which begins now; do nothing if it has that period already.

    Args:
        node: Owner of the timer.
        timer: The timer.
        period_s: The period, seconds.
    """
    period_ns = round(period_s * 1e9)
    if timer.timer_period_ns == period_ns:
        return
    timer.timer_period_ns = period_ns
    timer.reset()  # Otherwise the new period would apply only after the old one has passed once more.
    if node.executor is not None:
        node.executor.wake()  # It sleeps until the old time.
