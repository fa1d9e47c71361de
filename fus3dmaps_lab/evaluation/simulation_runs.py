"""Studies of several seeds in parallel, each in its own process."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from dataclasses import replace
from queue import Empty
from typing import Any

from fus3dmaps_lab.evaluation.memory_study import MemoryStudy, memory_curves
from fus3dmaps_lab.evaluation.records import CurvePoint, Record
from fus3dmaps_lab.evaluation.simulation import ASSOCIATIONS, Study, study_building

MODES_ONLY = Study(rooms_per_storey=6, frames=300)
"""The study of the modes alone."""

QUICK = Study(rooms_per_storey=4, frames=160)
"""The study of the modes alone, in a smaller building."""

WHOLE = replace(
    MODES_ONLY, noise_ratios=(0.2, 1.0, 5.0), window_radii_m=(1.5, 3.0, 4.5, 6.0, 9.0), associations=ASSOCIATIONS
)
"""The study of the modes and all sweeps."""

_POLL_S = 0.2

Progress = Callable[[int, int], object]


def study_seeds(
    study: Study, seeds: Sequence[int], jobs: int = 0, on_progress: Progress | None = None
) -> tuple[list[Record], list[CurvePoint]]:
    """Study one building for each seed.

    Args:
        study: The building and the comparisons.
        seeds: Seeds of the buildings.
        jobs: Number of parallel processes; 0 takes one per processor. It does not change the results.
        on_progress: Called with the number of frames mapped and of all frames.

    Returns:
        Records and curve points, in the order of seeds.
    """
    results = _each(study_building, [(study, seed) for seed in seeds], jobs, on_progress)
    return [each for records, _ in results for each in records], [each for _, points in results for each in points]


def memory_of(
    study: MemoryStudy, seeds: Sequence[int], jobs: int = 1, on_progress: Progress | None = None
) -> list[CurvePoint]:
    """Run the memory experiment for each seed, by default one at a time, because a map may take gigabytes.

    Args:
        study: The building.
        seeds: Seeds of the buildings.
        jobs: As in :func:`study_seeds`.
        on_progress: As in :func:`study_seeds`.
    """
    return [
        point for points in _each(memory_curves, [(study, seed) for seed in seeds], jobs, on_progress) for point in points
    ]


def _each(
    work: Callable[..., Any], arguments: Sequence[tuple[Any, ...]], jobs: int, on_progress: Progress | None
) -> list[Any]:
    """Call a function in parallel processes and return the results in order."""
    context = multiprocessing.get_context("spawn")  # Threads of torch and numba do not survive a fork.
    with context.Manager() as manager:
        messages = manager.Queue()
        workers = max(1, min(jobs or os.cpu_count() or 1, len(arguments)))
        with ProcessPoolExecutor(workers, mp_context=context) as pool:
            futures = [pool.submit(_reporting, work, messages, place, each) for place, each in enumerate(arguments)]
            _follow(futures, messages, on_progress)
            return [future.result() for future in futures]


def _follow(futures: list[Future[Any]], messages: Any, on_progress: Progress | None) -> None:
    pending = set(futures)
    shares: dict[int, tuple[int, int]] = {}
    while pending:
        done, pending = wait(pending, _POLL_S, FIRST_COMPLETED)
        for future in done:
            future.result()  # The first failure ends all of them.
        try:
            while True:
                place, frames, total = messages.get_nowait()
                shares[place] = frames, total
        except Empty:
            pass
        if on_progress is not None and shares:
            longest = max(total for _, total in shares.values())
            on_progress(sum(frames for frames, _ in shares.values()), max(longest * len(futures), 1))


def _reporting(work: Callable[..., Any], messages: Any, place: int, arguments: tuple[Any, ...]) -> Any:
    return work(*arguments, lambda frames, total: messages.put((place, frames, total)))
