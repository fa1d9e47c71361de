"""Datasets by name, and their conversion into recordings. A new format is a new module and a line here."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Protocol, cast

from fus3dmaps_core.config import InputConfig
from fus3dmaps_core.errors import RecordingError
from fus3dmaps_core.frame import PosedFrame
from fus3dmaps_core.recordings.writer import RecordingWriter

_FORMATS = {
    "sevenscenes": ("fus3dmaps_core.sources.sevenscenes", "SevenScenes"),
}


class Dataset(Protocol):
    """A posed RGB-D sequence in a directory."""

    def __len__(self) -> int:
        """Number of frames."""
        ...

    def __iter__(self) -> Iterator[PosedFrame]:
        """The frames in order of their stamps."""
        ...


@dataclass(frozen=True)
class ConversionSummary:
    """What a conversion wrote.

    Attributes:
        frames: Number of frames.
        duration_s: Time from the first to the last frame, seconds.
        size_bytes: Size of the recording.
    """

    frames: int
    duration_s: float
    size_bytes: int


def names() -> list[str]:
    """Names of the known dataset formats."""
    return sorted(_FORMATS)


def open_dataset(format_name: str, directory: Path) -> Dataset:
    """Open a dataset of a named format.

    Raises:
        RecordingError: The format is unknown, or the directory is not of this format.
    """
    if format_name not in _FORMATS:
        raise RecordingError(f"unknown dataset format '{format_name}', known are {', '.join(names())}")
    module, name = _FORMATS[format_name]
    return cast(Callable[[Path], Dataset], getattr(import_module(module), name))(directory)


def convert(
    format_name: str,
    directory: Path,
    out: Path,
    config: InputConfig | None = None,
    *,
    overwrite: bool = False,
    on_progress: Callable[[int, int], None] | None = None,
) -> ConversionSummary:
    """Write a dataset as a rosbag2 recording.

    Args:
        format_name: One of :func:`names`.
        directory: Where the dataset is.
        out: Recording to write, must end in ``.mcap``; appears only if the conversion succeeds.
        config: Topics and frames of the recording.
        overwrite: Whether an existing file is replaced.
        on_progress: Called after each frame with the number done and the number of all.

    Raises:
        RecordingError: The dataset cannot be read or the recording not be written; the message names the file.
    """
    dataset = open_dataset(format_name, directory)
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
