"""An encoder trio at the size that it has: load it, time it, count it."""

from __future__ import annotations

import copy
import time
from collections.abc import Sequence
from typing import Any, cast

import numpy as np
import torch
from numpy.typing import NDArray

from benchmarks.flops import count_detector, count_flops
from benchmarks.model_figures import (
    Job,
    ModelFigures,
    Seconds,
    device_bytes,
    modules_in,
    parameters_of,
    precision_of,
    resident_bytes,
    sample,
    seconds,
)
from fus3dmaps_core.config.schema import ImageConfig
from fus3dmaps_core.encoders.network_graphs import Graph, GraphEncoder
from fus3dmaps_core.encoders.protocols import EncoderTrio, TextEncoder
from fus3dmaps_core.encoders.registry import load_trio
from fus3dmaps_core.masks import Masks
from fus3dmaps_core.runtimes.acceleration import accelerate

_PADDING = 0.05
_PROMPT = "a red cup"
_FEW_SENTENCES = 8
_LEAST_CROPS = 2
_CROP_SIDES_PX = (40, 240)
_SEED = 3


def open_trio(job: Job) -> tuple[EncoderTrio, float, float]:
    """Load a trio and have its networks run as the job says.

    Returns:
        It; seconds of loading; seconds of opening the runtime.

    Raises:
        EncoderError: It cannot be loaded, or not run so.
    """
    started = time.perf_counter()
    trio = load_trio(job.name, job.device, _PADDING, job.weights)
    loaded = time.perf_counter()
    accelerate(trio, job.encoder, ImageConfig(height=job.height, width=job.width))
    return trio, loaded - started, time.perf_counter() - loaded


def measure_trio(job: Job, rgb: NDArray[np.uint8]) -> ModelFigures:
    """Load a trio and measure it.

    Args:
        job: What is measured.
        rgb: (height, width, 3) uint8, a frame.

    Raises:
        EncoderError: It cannot be loaded, or not run as the job says.
    """
    return figures_of(job, rgb, *open_trio(job))


def figures_of(job: Job, rgb: NDArray[np.uint8], trio: EncoderTrio, load_s: float, prepare_s: float) -> ModelFigures:
    """Measure a trio that is loaded; see :func:`measure_trio`."""
    loaded_bytes = resident_bytes("VmRSS")
    patch, crop = (cast(GraphEncoder, encoder).graph(*rgb.shape[:2]) for encoder in (trio.patch, trio.crop))
    frames = [np.roll(rgb, 8 * index, axis=1) for index in range(1 + job.repeats)]  # lite remembers what it has seen
    first_s = seconds(lambda: trio.patch.encode_patches(frames[0]), job.device)
    frame_s = sample(lambda index: trio.patch.encode_patches(frames[index]), first_s, job)
    crop_s, batch = _time_crops(job, trio, frames[len(frame_s) % len(frames)], crop.shape[0])
    prompt_s, sentences, measured = _time_prompt(job, trio.text)
    peak_bytes, on_device = resident_bytes("VmHWM"), device_bytes(job.device)
    # Last: attention that is computed step by step takes memory of its own.
    frame_gflop, crop_gflop = (_gflop(graph, job.device) for graph in (patch, crop))
    images, texts = parameters_of([patch.network, crop.network]), parameters_of(modules_in(trio.text))
    detector_parameters, detector_flops = count_detector() if trio.name == "lite" else (0, 0)
    return ModelFigures(
        kind="trio",
        name=job.name,
        device=job.device,
        runtime=job.runtime,
        precision=job.precision if job.runtime == "tensorrt" else precision_of(patch.network),
        threads=job.threads,
        weights="random" if job.random and job.weights else job.weights or "installed",
        code=job.code,
        image_size=(job.height, job.width),
        image_parameters=sum(images.values()) + detector_parameters,
        text_parameters=sum(count for weight, count in texts.items() if weight not in images),
        dimension=trio.dimension,
        frame_input=patch.shape,
        crop_input=crop.shape,
        patch_grid=trio.patch.grid(*rgb.shape[:2]),
        frame_gflop=frame_gflop + detector_flops / 1e9,
        crop_gflop=crop_gflop,
        load_s=load_s,
        prepare_s=prepare_s,
        first_frame_s=first_s,
        frame=Seconds.of(frame_s),
        crop=Seconds.of(crop_s, 1.0 / batch),
        crop_batch=batch,
        prompt=Seconds.of(prompt_s),
        prompt_sentences=sentences,
        prompt_measured_sentences=measured,
        loaded_resident_bytes=loaded_bytes,
        peak_resident_bytes=peak_bytes,
        peak_device_bytes=on_device[0],
        device_in_use_bytes=on_device[1],
    )


def _time_crops(job: Job, trio: EncoderTrio, rgb: NDArray[np.uint8], batch: int) -> tuple[list[float], int]:
    """Time batches of crops of a frame whose patches were embedded before; return seconds, and the crops of a batch.

    A full batch of the encoder, or fewer where the budget would not do for two of them, unless the runtime pads them.
    """
    single = _boxes(1, *rgb.shape[:2])
    first_s = seconds(lambda: trio.crop.encode_crops(rgb, single), job.device)
    count = batch
    if job.runtime == "torch" and torch.device(job.device).type == "cpu":
        count = min(batch, max(_LEAST_CROPS, int(job.budget_s / 2 / max(first_s, 1e-6))))
    masks = _boxes(count, *rgb.shape[:2])
    expected_s = first_s if job.runtime != "torch" else count * first_s
    samples = sample(lambda index: trio.crop.encode_crops(rgb, masks), min(expected_s, job.budget_s), job)
    return samples, count


def _boxes(count: int, height: int, width: int) -> Masks:
    rng = np.random.default_rng(_SEED)
    masks = np.zeros((count, height, width), bool)
    for mask in masks:
        rows, columns = (min(int(rng.integers(*_CROP_SIDES_PX)), side) for side in (height, width))
        y, x = int(rng.integers(height - rows + 1)), int(rng.integers(width - columns + 1))
        mask[y : y + rows, x : x + columns] = True
    return Masks.from_masks(masks)


def _time_prompt(job: Job, text: TextEncoder) -> tuple[list[float], int, int]:
    """Time a prompt; return seconds, the sentences it is put into, and how many of them were timed.

    Where all of them would take longer than the budget a few are timed and the rest is taken to cost as much.
    """
    templates = cast(Sequence[Any], getattr(text, "_templates", ()))
    if len(templates) <= _FEW_SENTENCES:
        first_s = seconds(lambda: text.encode_text([_PROMPT]), job.device)
        return sample(lambda index: text.encode_text([_PROMPT]), first_s, job), 1, 1
    few: Any = copy.copy(text)
    few._templates = templates[:_FEW_SENTENCES]
    few.encode_text([_PROMPT])  # Warms up.
    few_s = seconds(lambda: few.encode_text([_PROMPT]), job.device)
    ratio = len(templates) / _FEW_SENTENCES
    if ratio * few_s <= job.budget_s:
        samples = sample(lambda index: text.encode_text([_PROMPT]), ratio * few_s, job)
        return samples, len(templates), len(templates)
    samples = [few_s, *sample(lambda index: few.encode_text([_PROMPT]), few_s, job)][: job.repeats]
    return [ratio * took_s for took_s in samples], len(templates), _FEW_SENTENCES


def _gflop(graph: Graph, device: str) -> float:
    return count_flops(graph.network, torch.zeros((1, *graph.shape[1:]), device=device)) / 1e9
