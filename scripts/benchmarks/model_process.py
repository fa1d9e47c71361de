"""One vision model measured in a process of its own, so that its memory is its own.

``python -m benchmarks.model_process TASK JOB RESULT`` prepares or measures what the file JOB says and writes RESULT; both
are JSON. Weights are made, and graphs and engines built, in another process before: they take more memory than the model.
"""

from __future__ import annotations

import json
import os
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from benchmarks.model_figures import EXPORTING, Job
from benchmarks.random_weights import accept_random_weights, radio_code, write_sam2, write_trio
from benchmarks.segmenter_figures import measure_segmenter
from benchmarks.trio_figures import measure_trio, open_trio
from fus3dmaps_core.encoders.catalogue import catalogue
from fus3dmaps_core.errors import EncoderError
from fus3dmaps_lab.simulation.room.furnished_room import FurnishedRoom

_VIEW = 7  # Of the room's path: two photographs and furniture, near and far.
REFUSED = 2
"""Exit code of a model that cannot be measured; what stands in RESULT says why."""


def main(task: str, job_file: Path, result: Path) -> int:
    """Prepare or measure a model, and return the exit code."""
    job = Job(**json.loads(job_file.read_text()))
    torch.set_num_threads(job.threads)
    cv2.setNumThreads(job.threads)
    if job.random:
        accept_random_weights()
    try:
        figures = _prepare(job) if task == "prepare" else _measure(job)
    except (EncoderError, ValueError, torch.OutOfMemoryError) as error:
        result.write_text(json.dumps({"problem": " ".join(str(error).split())}))
        return REFUSED
    result.write_text(json.dumps(figures))
    return 0


def _prepare(job: Job) -> dict[str, Any]:
    """Make random weights where they are asked for, and graphs and engines where the runtime reads them from files."""
    weights, code = job.weights, "installed"
    if job.random:
        folder = Path(job.folder) / "weights"
        folder.mkdir()
        if job.kind == "trio":
            weights = write_trio(job.name, folder)
            code = radio_code() if (folder / "RADIO").exists() else "installed"
        elif job.name == "sam2":
            weights = write_sam2(folder)
    elif job.kind == "trio":
        _check_installed(job)
    if job.kind == "trio" and job.runtime in EXPORTING:
        open_trio(Job(**{**asdict(job), "weights": weights}))
    return {"weights": weights, "code": code}


def _check_installed(job: Job) -> None:
    """Refuse what is not on this machine: a benchmark downloads nothing."""
    entry = next(entry for entry in catalogue(job.weights, job.name) if entry.name == job.name)
    if entry.missing:
        raise EncoderError(f"encoder '{job.name}' is not installed: {'; '.join(entry.missing)}")


def _measure(job: Job) -> dict[str, Any]:
    rgb, depth_m = view(job.height, job.width)
    before = cpu_seconds()
    figures = measure_trio(job, rgb) if job.kind == "trio" else measure_segmenter(job, rgb, depth_m)
    all_s, busy_s, own_s = (now - then for now, then in zip(cpu_seconds(), before, strict=True))
    return asdict(figures) | {"busy_with_others": max(0.0, busy_s - own_s) / all_s}


def cpu_seconds() -> tuple[float, float, float]:
    """Read the time of all cores since boot, their busy time, and this process's with its children, seconds."""
    ticks = [int(word) for word in Path("/proc/stat").read_text().split("\n", 1)[0].split()[1:9]]
    idle = ticks[3] + ticks[4]
    per_second = os.sysconf("SC_CLK_TCK")
    return sum(ticks) / per_second, (sum(ticks) - idle) / per_second, sum(os.times()[:4])


def view(height: int, width: int) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Make a frame of the furnished room at a size in pixels: (H, W, 3) uint8, and (H, W) float32 metres."""
    frame = FurnishedRoom().frame(_VIEW)
    rgb = cv2.resize(frame.rgb, (width, height), interpolation=cv2.INTER_AREA)
    depth_m = cv2.resize(frame.depth_m, (width, height), interpolation=cv2.INTER_NEAREST)
    return np.asarray(rgb, np.uint8), np.asarray(depth_m, np.float32)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1], Path(sys.argv[2]), Path(sys.argv[3])))
