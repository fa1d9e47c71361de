"""Rules that find problems of the mapping itself, like those of :mod:`fus3dmaps_core.health.input_problems`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from fus3dmaps_core.health.input_problems import Level, Problem

MIB = float(2**20)
_BUSY_SHARE = 0.9
_STALLED_S = 30.0
_NEAR_BUDGET = 0.9


@dataclass(frozen=True)
class Latency:
    """Times that a stage took.

    Attributes:
        count: How often it ran.
        mean_s: Mean, seconds.
        max_s: Maximum, seconds.
    """

    count: int
    mean_s: float
    max_s: float


@dataclass(frozen=True)
class MemoryState:
    """Use of one memory.

    Attributes:
        name: ``host`` or a torch device.
        used_bytes: Bytes in use.
        budget_bytes: Bytes that may be used; 0 without a budget.
    """

    name: str
    used_bytes: int
    budget_bytes: int


@dataclass(frozen=True)
class Pace:
    """How well mapping keeps up with the frames.

    Attributes:
        offered_hz: Complete frames per second.
        mapped_hz: Keyframes mapped per second.
        unmapped: Share of the frames that were dropped because the queue was full, 0 to 1.
        busy: Share of the time in which mapping works, 0 to 1.
        waiting: Frames in the queue.
        waiting_s: Time since the last frame was finished while frames wait, seconds.
    """

    offered_hz: float
    mapped_hz: float
    unmapped: float
    busy: float
    waiting: int
    waiting_s: float


def too_slow(pace: Pace, latencies: Mapping[str, Latency]) -> Problem | None:
    """Report that mapping stands still, drops frames from its full queue, or is about to.

    Args:
        pace: How well mapping keeps up.
        latencies: Times of each stage, by its name.
    """
    if pace.waiting and pace.waiting_s >= _STALLED_S:
        sentence = (
            f"mapping has finished no frame for {pace.waiting_s:.0f} s while {pace.waiting} wait: is its device stuck?"
        )
        return Problem("mapping", Level.ERROR, "stalled", sentence)
    remedy = "raise 'keyframes.*', lower 'segmenter.max_masks' or move 'encoder.device' to a GPU"
    if latencies:
        slowest, latency = max(latencies.items(), key=lambda item: item[1].mean_s)
        remedy = f"the slowest stage is '{slowest}' with {1e3 * latency.mean_s:.0f} ms; {remedy}"
    if pace.unmapped:
        sentence = (
            f"mapping is slower than keyframes come: {pace.unmapped:.0%} of the frames are dropped from the full queue"
            f" ({pace.offered_hz:.1f} frames/s come, {pace.mapped_hz:.1f} keyframes/s are mapped); {remedy}"
        )
        return Problem("mapping", Level.WARN, "queue_full", sentence)
    if pace.busy > _BUSY_SHARE:
        sentence = f"mapping is busy {pace.busy:.0%} of the time, near the most that it can follow; {remedy}"
        return Problem("mapping", Level.WARN, "busy", sentence)
    return None


def near_budget(states: Sequence[MemoryState]) -> list[Problem]:
    """Report the memories that use nine tenths of their budget or more."""
    return [
        Problem(
            "memory",
            Level.WARN,
            "near_budget",
            f"memory of {state.name} is at {state.used_bytes / state.budget_bytes:.0%} of its budget of"
            f" {state.budget_bytes / MIB:.0f} MiB: the dense layer gives way. Lower 'fusion.window_radius_m', raise"
            " 'map.voxel_size_m' or raise the budget",
        )
        for state in states
        if state.budget_bytes and state.used_bytes >= _NEAR_BUDGET * state.budget_bytes
    ]
