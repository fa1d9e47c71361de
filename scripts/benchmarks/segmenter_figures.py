"""A segmenter at the size that it has: load it, time it, count it."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from benchmarks.flops import DETECTOR_INPUT, count_detector, count_flops, count_onnx
from benchmarks.model_figures import (
    Job,
    ModelFigures,
    Seconds,
    device_bytes,
    parameters_of,
    precision_of,
    resident_bytes,
    sample,
    seconds,
)
from fus3dmaps_core.segmenters.fastsam.contract import input_shape
from fus3dmaps_core.segmenters.fastsam.published import find_network
from fus3dmaps_core.segmenters.registry import load_segmenter


@dataclass(frozen=True)
class _Size:
    """What a segmenter's network is.

    Attributes:
        parameters: Its weights.
        frame_gflop: 10^9 operations of a frame.
        frame_input: Shape of its input.
        precision: Precision of its weights.
    """

    parameters: int
    frame_gflop: float
    frame_input: tuple[int, ...]
    precision: str


def measure_segmenter(job: Job, rgb: NDArray[np.uint8], depth_m: NDArray[np.float32]) -> ModelFigures:
    """Load a segmenter and measure it.

    Args:
        job: What is measured.
        rgb: (height, width, 3) uint8, a frame.
        depth_m: (height, width) float32 metres.

    Raises:
        EncoderError: It cannot be loaded, or not run as the job says.
    """
    started = time.perf_counter()
    segmenter: Any = load_segmenter(job.name, job.encoder, job.weights)
    load_s = time.perf_counter() - started
    loaded_bytes = resident_bytes("VmRSS")
    frames = [np.roll(rgb, 8 * index, axis=1) for index in range(1 + job.repeats)]  # lite remembers what it has seen
    first_s = seconds(lambda: segmenter.segment(frames[0], depth_m), job.device)
    frame_s = sample(lambda index: segmenter.segment(frames[index], depth_m), first_s, job)
    peak_bytes, on_device = resident_bytes("VmHWM"), device_bytes(job.device)
    name, runtime, size = job.name, job.runtime, _size(job, segmenter)
    if job.name == "fastsam":
        name, runtime = find_network(job.weights).stem, "tensorrt" if job.runtime == "tensorrt" else "onnxruntime"
    elif job.name in ("lite", "sam2"):
        runtime = "torch"  # Which these two are run by whatever the encoders are.
    return ModelFigures(
        kind="segmenter",
        name=name,
        device=job.device,
        runtime=runtime,
        precision=size.precision,
        threads=job.threads,
        weights="random" if job.random and job.weights else job.weights or "installed",
        code=job.code,
        image_size=(job.height, job.width),
        image_parameters=size.parameters,
        text_parameters=None,
        dimension=None,
        frame_input=size.frame_input,
        crop_input=None,
        patch_grid=None,
        frame_gflop=size.frame_gflop,
        crop_gflop=None,
        load_s=load_s,
        prepare_s=0.0,
        first_frame_s=first_s,
        frame=Seconds.of(frame_s),
        crop=None,
        crop_batch=None,
        prompt=None,
        prompt_sentences=None,
        prompt_measured_sentences=None,
        loaded_resident_bytes=loaded_bytes,
        peak_resident_bytes=peak_bytes,
        peak_device_bytes=on_device[0],
        device_in_use_bytes=on_device[1],
    )


def _size(job: Job, segmenter: Any) -> _Size:
    if job.name == "fastsam":
        path = find_network(job.weights)
        parameters, flops = count_onnx(path)
        return _Size(parameters, flops / 1e9, (1, 3, *input_shape(path)), "float32")
    if job.name == "sam2":
        network, side = segmenter._network, segmenter._side
        image = torch.zeros((1, 3, side, side), device=job.device)
        flops = sam2_flops(network, image, segmenter._points, segmenter._settings.per_pass)
        return _Size(sum(parameters_of([network]).values()), flops / 1e9, tuple(image.shape), precision_of(network))
    parameters, flops = count_detector()
    return _Size(parameters, flops / 1e9, DETECTOR_INPUT, "float32")


def sam2_flops(network: Any, image: torch.Tensor, points: torch.Tensor, per_pass: int) -> int:
    """Count the operations of SAM 2 on a frame: of the image encoder, and of the decoder, which are equal for all points.

    Args:
        network: ``Sam2Model``.
        image: (1, 3, side, side) as it takes it.
        points: (n, 2) x, y in its pixels.
        per_pass: Points that the decoder takes at once.
    """
    found: list[Sequence[torch.Tensor]] = []
    encoding = count_flops(lambda image: found.append(network.get_image_embeddings(image)), image)

    def decode(batch: torch.Tensor) -> object:
        labels = torch.ones((1, len(batch), 1), dtype=torch.int32, device=batch.device)
        embeddings = list(found[0])
        return network(
            image_embeddings=embeddings, input_points=batch[None, :, None], input_labels=labels, multimask_output=True
        )

    return encoding + len(points) * count_flops(decode, points[:per_pass]) // len(points[:per_pass])
