"""Mapping of a whole recording in process, with the live node's steps; no frame is dropped for lack of time."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from fus3dmaps_core.errors import RecordingError
from fus3dmaps_core.frame_step import FrameStep
from fus3dmaps_core.ledger import Ledger
from fus3dmaps_core.pipeline import Pipeline
from fus3dmaps_core.sources.bag import BagSource


@dataclass(frozen=True)
class RunSummary:
    """Figures of a finished run.

    Attributes:
        ledger: Frames, drops and the time of each stage.
        duration_s: Wall time, seconds, without loading models.
    """

    ledger: Ledger
    duration_s: float

    @property
    def keyframes_per_s(self) -> float:
        """Dense keyframes per second of wall time."""
        return self.ledger.counts().dense_keyframes / self.duration_s if self.duration_s else 0.0


def map_recording(
    path: str | os.PathLike[str], pipeline: Pipeline, on_progress: Callable[[int, int], None] | None = None
) -> RunSummary:
    """Map a recording and fuse the layers at its end.

    Args:
        path: rosbag2 directory or MCAP file.
        pipeline: Maps the frames.
        on_progress: Called with the number of frames done and expected.

    Raises:
        RecordingError: The recording cannot be read to its end, lacks a topic or gave no frame. What was mapped before
            the fault stays in the pipeline's map.
    """
    ledger = Ledger()
    step = FrameStep(pipeline, ledger)
    started = time.perf_counter()
    with BagSource(Path(path), pipeline.config.input) as source:
        for done, paired in enumerate(source, start=1):
            ledger.add_frame()
            step.run(paired)
            if on_progress is not None:
                on_progress(done, len(source))
        source.pairer.drops.pour_into(ledger.drops)
    if not ledger.counts().dense_keyframes:
        latest = ledger.drops.latest()
        causes = "; ".join(f"{reason} ({count}): {latest[reason]}" for reason, count in ledger.drops.counts().items())
        raise RecordingError(f"'{path}' gave no frame that could be mapped: {causes or 'it has no colour images'}")
    pipeline.semantic_map.fuse()
    return RunSummary(ledger, time.perf_counter() - started)
