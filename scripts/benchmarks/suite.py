"""Which cases make up a run: the sizes, widths and storage types that are measured, and in which order."""

from __future__ import annotations

import gc
from collections.abc import Sequence
from pathlib import Path
from typing import get_args

import torch

from benchmarks import rayfronts as peer
from benchmarks.engine import (
    ELEMENT_BYTES,
    FilledMap,
    Run,
    instance_levels,
    measure_dense_updates,
    measure_fusion,
    measure_instance_updates,
    measure_memory,
    measure_queries,
)
from benchmarks.measurements import Measurement
from benchmarks.ratios import ratios
from benchmarks.timing import copy_bandwidth
from fus3dmaps_core.config.schema import MapConfig

SIZES, QUICK_SIZES = (10_000, 100_000, 500_000, 2_000_000), (10_000, 200_000)
DIMENSIONS, QUICK_DIMENSIONS = (384, 512, 1152), (512, 1152)
EVERY_TYPE_DIMENSION = 1152
"""Storage types other than the default are measured at this width alone, unless they are asked for."""

_INSTANCE_MAP_VOXELS = 500_000
_INSTANCE_LEVELS = (500, 5000)
_DETECTION_LEVEL = 500
_PEER_KEYFRAME_STEP = 3  # A few keyframes will do where one takes seconds.
_SPARE_BYTES = 2**31


def known_dtypes() -> list[str]:
    """List the map's storage types."""
    return [str(name) for name in get_args(MapConfig.model_fields["dtype"].annotation)]


def default_dtype() -> str:
    """Return the storage type of a map that names none."""
    return str(MapConfig().dtype)


def measure_all(
    run: Run, sizes: Sequence[int], settings: Sequence[tuple[int, str]], rayfronts: Path | None
) -> list[Measurement]:
    """Measure every case of the map at every setting, the peer's where a checkout is given, and the ratios between them.

    Args:
        run: What the cases share.
        sizes: Voxels of the maps.
        settings: Width and storage type of each group of cases.
        rayfronts: A checkout of RayFronts, or None.
    """
    measured = []
    speed, spread = copy_bandwidth(run.repeats, run.device)
    measured.append(Measurement("copy_bandwidth", {"device": run.device, "threads": run.threads}, speed, "GB/s", spread))
    for dimension, dtype in settings:
        measured += _measure_setting(run, sizes, dimension, dtype)
    if rayfronts is not None:
        shared = run.world.dense_8k[::_PEER_KEYFRAME_STEP]
        for dimension in dict.fromkeys(dimension for dimension, _ in settings):
            measured += peer.measure_rayfronts(run, rayfronts, shared, peer.PREFILLED, dimension)
            for size in peer.PREFILLED:
                ours = FilledMap(run, size, dimension, default_dtype())
                measured += measure_dense_updates([ours], shared)
                del ours
                gc.collect()
    return measured + ratios(measured)


def _measure_setting(run: Run, sizes: Sequence[int], dimension: int, dtype: str) -> list[Measurement]:
    """Measure all cases of the map at one width and storage type."""
    fitting = _that_fit(run, sizes, dimension, dtype)
    if not fitting:
        return []
    measured = []
    maps = [FilledMap(run, size, dimension, dtype) for size in fitting]
    run.say(f"dense updates, d {dimension}, {dtype}")
    measured += measure_dense_updates(maps, run.world.dense)
    measured += measure_dense_updates(maps, run.world.dense_8k)
    while maps:
        filled = maps.pop(0)
        run.say(f"fusion and queries of {filled.voxels:,} voxels, d {dimension}, {dtype}")
        measured += measure_fusion(filled, run.world.dense, run.world.masks)
        measured += measure_queries(filled)
        measured += measure_memory(filled)
        del filled
        gc.collect()
    size = max([size for size in fitting if size <= _INSTANCE_MAP_VOXELS] or fitting[:1])
    levels = instance_levels(size, _INSTANCE_LEVELS)
    maps = [FilledMap(run, size, dimension, dtype, level) for level in levels]
    run.say(f"instance updates, d {dimension}, {dtype}")
    if maps:
        measured += measure_instance_updates(maps, run.world.masks)
    for filled in maps:
        if filled.instances == _DETECTION_LEVEL:
            measured += measure_instance_updates([filled], run.world.detections)
    return measured


def settings(widths: Sequence[int], types: Sequence[str], quick: bool) -> list[tuple[int, str]]:
    """List width and storage type of each group of cases."""
    chosen = list(widths) or list(QUICK_DIMENSIONS if quick else DIMENSIONS)
    if types:
        return [(width, dtype) for dtype in types for width in chosen]
    settings = [(width, default_dtype()) for width in chosen]
    if EVERY_TYPE_DIMENSION in chosen and not quick:
        settings += [(EVERY_TYPE_DIMENSION, dtype) for dtype in known_dtypes() if dtype != default_dtype()]
    return settings


def _that_fit(run: Run, sizes: Sequence[int], dimension: int, dtype: str) -> list[int]:
    """Return the sizes whose maps fit into memory side by side, the smallest first."""
    left = _free_bytes(run.device) - _SPARE_BYTES
    fitting = []
    for size in sorted(sizes):
        left -= int(1.15 * size * (dimension * ELEMENT_BYTES[dtype] + 128))
        if left >= 0:
            fitting.append(size)
        else:
            run.say(f"left out for want of memory: {size:,} voxels, d {dimension}, {dtype}")
    return fitting


def _free_bytes(device: str) -> int:
    if device.startswith("cuda"):
        return int(torch.cuda.mem_get_info(device)[0])
    for line in Path("/proc/meminfo").read_text().splitlines():
        if line.startswith("MemAvailable:"):
            return 1024 * int(line.split()[1])
    return 2**63  # Where nobody tells, everything is tried.
