"""Conversion of datasets into recordings."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from fus3dmaps_core.config.input import InputConfig
from fus3dmaps_core.recordings.writer import RecordingWriter
from fus3dmaps_lab.datasets.registry import open_dataset


@dataclass(frozen=True)
class ConversionSummary:
    """Summary of a conversion.

    Attributes:
        frames: Number of frames.
        duration_s: Time from the first to the last frame, seconds.
        size_bytes: Size of the recording.
    """

    frames: int
    duration_s: float
    size_bytes: int


def convert(
    layout: str,
    directory: Path,
    out: Path,
    config: InputConfig | None = None,
    *,
    overwrite: bool = False,
    on_progress: Callable[[int, int], None] | None = None,
    options: Mapping[str, object] | None = None,
) -> ConversionSummary:
    """Write a dataset as a rosbag2 recording.

    Args:
        layout: One of :func:`fus3dmaps_lab.datasets.registry.names`.
        directory: Folder of the dataset.
        out: Recording to write, must end in ``.mcap``. It is created only if the conversion succeeds.
        config: Topics and frames of the recording.
        overwrite: Whether an existing file is replaced.
        on_progress: Called after each frame with the number of frames done and of all frames.
        options: Options of the dataset, e.g. ``scene`` or ``stride``.

    Raises:
        RecordingError: The dataset cannot be read or the recording cannot be written; the message names the file.
        ConfigError: An option is unknown or of the wrong type.
    """
    dataset = open_dataset(layout, directory, **(options or {}))
    total = len(dataset)
    first_ns = last_ns = 0
    with RecordingWriter(out, config, overwrite=overwrite) as writer:
        for done, frame in enumerate(dataset, start=1):
            writer.write(frame)
            first_ns = frame.stamp_ns if done == 1 else first_ns
            last_ns = frame.stamp_ns
            if on_progress is not None:
                on_progress(done, total)
    return ConversionSummary(total, (last_ns - first_ns) / 1e9, out.stat().st_size)
