"""The figures of a vision model, and helpers to measure them."""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from benchmarks.timing import time_call
from fus3dmaps_core.config.schema import EncoderConfig, Precision, Runtime

EXPORTING = ("onnxruntime", "tensorrt")
"""Runtimes that read graphs from files."""


@dataclass(frozen=True)
class Job:
    """What is to be measured.

    Attributes:
        kind: ``trio`` or ``segmenter``.
        name: Registry name.
        device: Torch device.
        runtime: ``encoder.runtime``.
        precision: ``encoder.precision``, of TensorRT engines.
        threads: Threads of torch.
        height: Height of a frame, pixels.
        width: Its width, pixels.
        repeats: Samples of a figure, at most.
        budget_s: What the samples of a figure may take together, about, seconds.
        weights: ``encoder.weights`` or ``segmenter.weights``.
        random: Whether random weights are to be made; ``weights`` is ignored until they are.
        folder: Scratch directory of this model alone.
        code: Whose code builds the network: ``installed``, or for RADIO's beside random weights ``RADIO's own`` or
            ``stand-in``.
    """

    kind: str
    name: str
    device: str
    runtime: Runtime
    precision: Precision
    threads: int
    height: int
    width: int
    repeats: int
    budget_s: float
    weights: str
    random: bool
    folder: str
    code: str = "installed"

    @property
    def encoder(self) -> EncoderConfig:
        """The settings that encoders and segmenters are run with; graphs and engines lie in the scratch directory."""
        return EncoderConfig(
            name=self.name if self.kind == "trio" else "lite",
            device=self.device,
            runtime=self.runtime,
            precision=self.precision,
            graph_directory=str(Path(self.folder) / "graphs"),
        )


@dataclass(frozen=True)
class Seconds:
    """What a call takes.

    Attributes:
        best: Shortest of the samples, seconds.
        median: Median of the samples, seconds.
        samples: Number of samples.
    """

    best: float
    median: float
    samples: int

    @classmethod
    def of(cls, samples_s: Iterable[float], share: float = 1.0) -> Seconds:
        """Summarise samples, each times a share, e.g. one over the size of a batch."""
        values = [share * sample for sample in samples_s]
        return cls(min(values), float(np.median(values)), len(values))


@dataclass(frozen=True)
class ModelFigures:
    """The figures of one model.

    Attributes:
        kind: ``trio`` or ``segmenter``.
        name: Registry name, of a segmenter from a file with the file's.
        device: Torch device.
        runtime: What ran the image networks.
        precision: Precision of their weights.
        threads: Threads of torch.
        weights: ``random``, or where they came from.
        code: Whose code built the network, as in :class:`Job`.
        image_size: Height and width of a frame, pixels.
        image_parameters: Weights of all networks that see images, each counted once; None where it has none.
        text_parameters: Weights of the text tower.
        dimension: Embedding width d.
        frame_input: Shape of what the frame's network takes, (n, 3, H, W).
        crop_input: Shape of what the crops' network takes at once.
        patch_grid: Rows and columns.
        frame_gflop: 10^9 floating-point operations of a frame, 2 for a product and its sum.
        crop_gflop: The same of a crop.
        load_s: Loading from files that the page cache holds, seconds.
        prepare_s: Opening the runtime after that, compilation included, seconds; 0 for torch.
        first_frame_s: Time of the first frame, which warms up, seconds.
        frame: Time of a frame.
        crop: Time of a crop, in a batch of ``crop_batch``.
        crop_batch: How many crops were embedded at once.
        prompt: Time of a prompt, in all of its sentences.
        prompt_sentences: Sentences that a prompt is embedded in.
        prompt_measured_sentences: How many of them were timed; the time of a prompt is worked out from theirs.
        loaded_resident_bytes: Resident memory of the process after loading, interpreter and libraries included.
        peak_resident_bytes: The most that it was.
        peak_device_bytes: The most that torch held on a CUDA device; None elsewhere.
        device_in_use_bytes: What the whole CUDA device had in use at the end, by whichever runtime; None elsewhere.
    """

    kind: str
    name: str
    device: str
    runtime: str
    precision: str
    threads: int
    weights: str
    code: str
    image_size: tuple[int, int]
    image_parameters: int | None
    text_parameters: int | None
    dimension: int | None
    frame_input: tuple[int, ...] | None
    crop_input: tuple[int, ...] | None
    patch_grid: tuple[int, int] | None
    frame_gflop: float | None
    crop_gflop: float | None
    load_s: float
    prepare_s: float
    first_frame_s: float
    frame: Seconds
    crop: Seconds | None
    crop_batch: int | None
    prompt: Seconds | None
    prompt_sentences: int | None
    prompt_measured_sentences: int | None
    loaded_resident_bytes: int
    peak_resident_bytes: int
    peak_device_bytes: int | None
    device_in_use_bytes: int | None


def seconds(call: Callable[[], object], device: str) -> float:
    """Time one call with the device's work in it, seconds."""
    gc.collect()
    return time_call(call, device) / 1000.0


def sample(call: Callable[[int], object], first_s: float, job: Job) -> list[float]:
    """Time call(1), call(2), ... as far as repeats and budget of the job go, seconds.

    Args:
        call: What is timed.
        first_s: What call(0) took; it is the only sample if it used the budget up.
        job: Device, repeats and budget.
    """
    count = min(job.repeats, int(job.budget_s / max(first_s, 1e-6)))
    return [seconds(lambda index=index: call(index), job.device) for index in range(1, 1 + count)] or [  # type: ignore[misc]
        first_s
    ]


def parameters_of(modules: Iterable[nn.Module]) -> dict[int, int]:
    """Count the elements of each weight by its identity, so that what modules share counts once."""
    return {id(weight): weight.numel() for module in modules for weight in module.parameters()}


def modules_in(value: Any, depth: int = 2) -> list[nn.Module]:
    """Find the modules in an object's attributes, and in theirs in turn."""
    if isinstance(value, nn.Module):
        return [value]
    if depth == 0 or not hasattr(value, "__dict__"):
        return []
    return [module for held in vars(value).values() for module in modules_in(held, depth - 1)]


def resident_bytes(field: str) -> int:
    """Read the resident memory of this process by its field in /proc/self/status: ``VmRSS``, or its peak ``VmHWM``.

    The peak that getrusage tells is inherited from the parent.
    """
    for line in Path("/proc/self/status").read_text().splitlines():
        name, _, rest = line.partition(":")
        if name == field:
            return 1024 * int(rest.split()[0])
    raise ValueError(f"this system's /proc/self/status has no {field}")


def device_bytes(device: str) -> tuple[int | None, int | None]:
    """Return the most that torch held on a CUDA device, and what is in use on it now; None and None elsewhere."""
    if torch.device(device).type != "cuda":
        return None, None
    free, total = torch.cuda.mem_get_info(device)
    return int(torch.cuda.max_memory_allocated(device)), int(total - free)


def precision_of(module: nn.Module) -> str:
    """Return the precision of a network's weights, e.g. ``float32``."""
    dtype = next(value.dtype for value in module.state_dict().values() if value.is_floating_point())
    return str(dtype).removeprefix("torch.")
