"""Timing calls one by one, as they follow each other on a robot."""

from __future__ import annotations

import gc
import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch

_BUFFERS = 3
_SWEEP_BYTES = 64 * 2**20
_sweep = np.zeros(_SWEEP_BYTES // 8)


@dataclass(frozen=True)
class Times:
    """What a call took, milliseconds.

    Attributes:
        samples_ms: One for each timed call.
    """

    samples_ms: Sequence[float]

    @property
    def median_ms(self) -> float:
        """Median of the samples."""
        return float(np.median(self.samples_ms))


def spread(samples: Sequence[float]) -> dict[str, float]:
    """Return the smallest sample, quartiles, the largest sample and the number of samples."""
    low, first, third, high = np.percentile(samples, (0, 25, 75, 100))
    return {"min": float(low), "q1": float(first), "q3": float(third), "max": float(high), "samples": len(samples)}


def time_call(call: Callable[[], object], device: str = "cpu") -> float:
    """Time one call, milliseconds.

    The processor's caches are swept first: between two keyframes an encoder's weights have gone through them, so that a map
    small enough to live there would otherwise show a speed that no robot sees.
    """
    np.add(_sweep, 1.0, out=_sweep)
    _wait(device)
    started = time.perf_counter()
    call()
    _wait(device)
    return 1000.0 * (time.perf_counter() - started)


def time_calls(
    call: Callable[[int], object],
    calls: int,
    warm_up: int,
    before: Callable[[int], object] = lambda index: None,
    device: str = "cpu",
) -> Times:
    """Time call(0), call(1), ..., each after an untimed before(i).

    Args:
        call: What is timed; its result is dropped outside the clock.
        calls: How many calls count.
        warm_up: How many calls precede them, from call(0) on too: the first ones compile and load kernels.
        before: Brings about what the call needs.
        device: Torch device that the call works on.
    """
    with collected_garbage():
        for index in range(warm_up):
            before(index)
            call(index)
        samples = []
        for index in range(calls):
            before(index)
            samples.append(time_call(lambda index=index: call(index), device))  # type: ignore[misc]
    return Times(samples)


@contextmanager
def collected_garbage() -> Iterator[None]:
    """Collect garbage now and not again inside."""
    gc.collect()
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


def set_threads(threads: int) -> None:
    """Let torch, and compiled code where there is any, use so many threads."""
    torch.set_num_threads(threads)
    try:
        import numba
    except ImportError:
        return
    numba.set_num_threads(min(threads, int(getattr(numba.config, "NUMBA_NUM_THREADS", threads))))


def usable_cores() -> int:
    """Count the cores that this process may run on."""
    return len(os.sched_getaffinity(0))


def copy_bandwidth(repeats: int, device: str = "cpu", size_bytes: int = 2**28) -> tuple[float, dict[str, float]]:
    """Measure the bandwidth of the memory: a plain copy of a large buffer by torch's threads.

    Memory of a virtual machine may lie near its processors or behind another one, at half the speed, and what the maps get
    is mixed. So several buffers are held side by side and the fastest counts, or shares of it would depend on luck.

    Returns:
        GB/s, counting the bytes read and the bytes written; and its spread.
    """
    pairs = [
        (torch.ones(size_bytes // 4, device=device), torch.zeros(size_bytes // 4, device=device)) for _ in range(_BUFFERS)
    ]
    speeds = []
    for source, target in pairs:
        copy = partial(torch.Tensor.copy_, target, source)
        times = time_calls(lambda index, copy=copy: copy(), max(repeats, 5), 2, device=device)  # type: ignore[misc]
        speeds.append([2 * size_bytes / took_ms / 1e6 for took_ms in times.samples_ms])
    fastest = max(speeds, key=np.median)
    return float(np.median(fastest)), spread(fastest)


def _wait(device: str) -> None:
    if device.startswith("cuda"):
        torch.cuda.synchronize(device)
