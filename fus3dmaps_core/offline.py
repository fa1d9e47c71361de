"""Mapping a whole recording in process: the live node's pipeline, fed from a file and never dropping for lack of time."""

from __future__ import annotations

import os
import time
from collections import Counter, defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from fus3dmaps_core.errors import FrameError, RecordingError
from fus3dmaps_core.pipeline import Pipeline
from fus3dmaps_core.sources.bag import BagSource
from fus3dmaps_core.sources.pairing import PairedMessages


@dataclass
class RunSummary:
    """What a run did.

    Attributes:
        frames: Colour images that became posed frames.
        dense_keyframes: Frames integrated into the dense layer.
        instance_keyframes: Frames integrated into the instance layer.
        proposals: Proposals integrated.
        duration_s: Wall time, seconds, without loading models.
        stages_s: Wall time by stage, seconds.
        drops: Dropped messages and frames by reason.
        last_drop: Newest message of each reason.
    """

    frames: int = 0
    dense_keyframes: int = 0
    instance_keyframes: int = 0
    proposals: int = 0
    duration_s: float = 0.0
    stages_s: dict[str, float] = field(default_factory=lambda: defaultdict(float))
    drops: Counter[str] = field(default_factory=Counter)
    last_drop: dict[str, str] = field(default_factory=dict)

    @property
    def keyframes_per_s(self) -> float:
        """Dense keyframes per second of wall time."""
        return self.dense_keyframes / self.duration_s if self.duration_s else 0.0


def map_recording(
    path: str | os.PathLike[str], pipeline: Pipeline, on_progress: Callable[[int, int], None] | None = None
) -> RunSummary:
    """Map a recording and fuse the layers at its end.

    Args:
        path: rosbag2 directory or MCAP file.
        pipeline: Where the frames go.
        on_progress: Called with the number of frames done and expected.

    Raises:
        RecordingError: The recording cannot be read to its end, lacks a topic or gave no frame. What was mapped before
            the fault stays in the pipeline's map.
    """
    summary = RunSummary()
    started = time.perf_counter()
    with BagSource(Path(path), pipeline.config.input) as source:
        try:
            for paired in source:
                summary.frames += 1
                if pipeline.wants(paired.T_world_camera):
                    _process(paired, pipeline, summary)
                if on_progress is not None:
                    on_progress(summary.frames, len(source))
        finally:
            summary.drops.update(source.pairer.drops)
            summary.last_drop.update(source.pairer.last_drop)
            summary.duration_s = time.perf_counter() - started
    if not summary.dense_keyframes:
        causes = "; ".join(
            f"{reason} ({count}): {summary.last_drop.get(reason, '')}" for reason, count in summary.drops.items()
        )
        raise RecordingError(f"'{path}' gave no frame that could be mapped: {causes or 'it has no colour images'}")
    pipeline.semantic_map.fuse()
    summary.duration_s = time.perf_counter() - started
    return summary


def _process(paired: PairedMessages, pipeline: Pipeline, summary: RunSummary) -> None:
    started = time.perf_counter()
    try:
        frame = paired.decode(pipeline.config.image)
    except FrameError as error:
        summary.drops[error.reason] += 1
        summary.last_drop[error.reason] = str(error)
        return
    summary.stages_s["decode"] += time.perf_counter() - started
    report = pipeline.process(frame)
    summary.dense_keyframes += report.dense
    summary.instance_keyframes += report.instances
    summary.proposals += report.proposals
    for stage, seconds in report.durations_s.items():
        summary.stages_s[stage] += seconds
