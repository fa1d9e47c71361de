"""A drive of kilometres along a corridor with a sliding window: does the dense layer's memory stay where it is?"""

from __future__ import annotations

import resource
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.boxes import VOXEL_SIZE_M, Box
from benchmarks.embeddings import ObservedObjects
from benchmarks.engine import Run
from benchmarks.keyframes import (
    HEIGHT,
    PATCH_COLUMNS,
    PATCH_ROWS,
    WIDTH,
    View,
    look_ahead,
    object_colors,
)
from benchmarks.measurements import Measurement
from fus3dmaps_core.geometry.projection import sample_pixels
from fus3dmaps_core.voxel_map.semantic_map import SemanticMap

WINDOW_RADIUS_M = 6.0
DIMENSION = 384
_SAMPLES_PER_PATCH = 5
_FUSE_PERIOD = 5
_SAMPLE_PERIOD = 100
_SETTLED_SHARE = 0.1
_DEPTH_MAX_M = 5.0
_SIDE_VOXELS = 50  # 2.5 m wide and high
_BOX_SPACING_VOXELS = 40
_BOX_VOXELS = 8
_CAMERA_M = (1.27, 1.3)
_MIN_POINTS = 30
_MAX_PROPOSALS = 5
_PANEL_M = 1.0


@dataclass(frozen=True)
class Sample:
    """The state of the run at one keyframe.

    Attributes:
        keyframe: Number of the keyframe.
        resident_bytes: Resident memory of the process.
        whole_map_bytes: What the map says that keys, colours, hypotheses and instances take: all that may grow.
        dense_bytes: What it says that the dense layer takes.
        keyframe_ms: Mean time of a keyframe since the sample before, milliseconds.
    """

    keyframe: int
    resident_bytes: int
    whole_map_bytes: int
    dense_bytes: int
    keyframe_ms: float


def corridor_boxes(position_m: float) -> list[Box]:
    """Make the corridor along x, from 1 m behind a position to past the depth limit, and the boxes on its floor."""
    first = int(position_m / VOXEL_SIZE_M) - 20
    last = first + 20 + int((_DEPTH_MAX_M + 2.0) / VOXEL_SIZE_M)
    boxes = [Box((first, 0, 0), (last, _SIDE_VOXELS, _SIDE_VOXELS), 0, is_room=True)]
    for place in range(-(-first // _BOX_SPACING_VOXELS), last // _BOX_SPACING_VOXELS + 1):
        x, y = place * _BOX_SPACING_VOXELS, 1 if place % 2 else _SIDE_VOXELS - 1 - _BOX_VOXELS
        boxes.append(Box((x, y, 1), (x + _BOX_VOXELS, y + _BOX_VOXELS, 1 + _BOX_VOXELS), 16 + place % 1000))
    return boxes


def proposals_of(view: View) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Propose the largest things in view: boxes, and panels of walls, floor and ceiling of 1 m.

    Returns:
        (n,) positions of the points, (n,) proposal of each, and (m,) label of each proposal.
    """
    is_box = view.labels >= 16
    panels = np.floor(view.points_m[:, 0] / _PANEL_M).astype(np.int64) * 16 + view.labels
    things = np.where(is_box, -view.labels, panels)
    _, index, sizes = np.unique(things, return_inverse=True, return_counts=True)
    chosen = [place for place in np.argsort(-sizes, kind="stable")[:_MAX_PROPOSALS] if sizes[place] >= _MIN_POINTS]
    members = [np.flatnonzero(index == place) for place in chosen]
    if not members:
        return np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0, np.int64)
    labels = np.array([view.labels[part[0]] for part in members], np.int64)
    return np.concatenate(members), np.repeat(np.arange(len(members)), [len(part) for part in members]), labels


def drive(run: Run, dimension: int, dtype: str, keyframes: int, length_m: float) -> list[Sample]:
    """Map a corridor of the given length in so many keyframes, fusing after every fifth, and sample the memory."""
    semantic_map = run.new_map(dimension, dtype, WINDOW_RADIUS_M)
    observed = ObservedObjects(dimension, run.world.seed)
    pixels = sample_pixels(HEIGHT, WIDTH, PATCH_ROWS, PATCH_COLUMNS, _SAMPLES_PER_PATCH)
    rng = np.random.default_rng(run.world.seed)
    samples: list[Sample] = []
    taken_s = 0.0
    for keyframe in range(1, keyframes + 1):
        camera_m = np.array([keyframe * length_m / keyframes, *_CAMERA_M])
        view = look_ahead(corridor_boxes(float(camera_m[0])), camera_m, pixels, rng, _DEPTH_MAX_M)
        taken_s += _process(semantic_map, observed, view, camera_m, keyframe % _FUSE_PERIOD == 0)
        if keyframe % _SAMPLE_PERIOD == 0:
            held = semantic_map.nbytes()
            growing = held["hash"] + held["colors"] + held["instances"]
            keyframe_ms = 1000 * taken_s / _SAMPLE_PERIOD
            samples.append(Sample(keyframe, resident_bytes(), growing, held["dense"], keyframe_ms))
            taken_s = 0.0
            if keyframe % (10 * _SAMPLE_PERIOD) == 0:
                run.say(f"corridor: keyframe {keyframe:,}, {semantic_map.voxel_count:,} voxels, {keyframe_ms:.1f} ms each")
    return samples


def measure_corridor(run: Run, dimension: int, dtype: str, keyframes: int, length_m: float) -> list[Measurement]:
    """Measure the corridor_* figures: slopes over the run but for its first tenth, in which the window fills."""
    samples = drive(run, dimension, dtype, keyframes, length_m)
    settled = [sample for sample in samples if sample.keyframe > _SETTLED_SHARE * keyframes]
    at = [sample.keyframe for sample in settled]
    resident = [sample.resident_bytes for sample in settled]
    growing = [sample.whole_map_bytes for sample in settled]
    unaccounted = [all_of_it - told for all_of_it, told in zip(resident, growing, strict=True)]
    times = [sample.keyframe_ms for sample in settled]
    keyframes_per_km = 1000 * keyframes / length_m
    slope = fitted_slope(at, unaccounted)
    params = run.params(0, dimension, dtype, keyframes=keyframes, length_m=length_m, window_radius_m=WINDOW_RADIUS_M)
    del params["map_voxels"]
    figures = (
        ("corridor_resident_slope", fitted_slope(at, resident), "B/keyframe"),
        ("corridor_whole_map_slope", fitted_slope(at, growing), "B/keyframe"),
        ("corridor_dense_slope", fitted_slope(at, [sample.dense_bytes for sample in settled]), "B/keyframe"),
        ("corridor_unaccounted_slope", slope, "B/keyframe"),
        ("corridor_unaccounted_per_km", slope * keyframes_per_km / 1e6, "MB/km"),
        ("corridor_resident_end", resident[-1] / 1e6, "MB"),
        ("corridor_keyframe", float(np.median(times)), "ms"),
        ("corridor_keyframe_slope", 1e6 * fitted_slope(at, times), "ns/keyframe"),
    )
    return [Measurement(name, params, value, unit) for name, value, unit in figures]


def fitted_slope(at: Sequence[float], values: Sequence[float]) -> float:
    """Fit a least-squares line through the values and return its slope."""
    return float(np.polyfit(np.asarray(at, np.float64), np.asarray(values, np.float64), 1)[0])


def resident_bytes() -> int:
    """Read the resident memory of this process from Linux."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize()


def _process(
    semantic_map: SemanticMap, observed: ObservedObjects, view: View, camera_m: NDArray[np.float64], fuses: bool
) -> float:
    """Process a keyframe and return how long the map took, seconds."""
    patches = PATCH_ROWS * PATCH_COLUMNS
    patch_objects = np.zeros(patches, np.int64)
    patch_objects[view.patches] = view.labels
    dense, weights, colors = observed.observe(patch_objects), np.ones(patches, np.float32), object_colors(view.labels)
    members, proposals, labels = proposals_of(view)
    crops = observed.observe(labels)
    started = time.perf_counter()
    semantic_map.integrate_dense(view.points_m, view.patches, dense, weights, colors)
    semantic_map.integrate_proposals(view.points_m[members], proposals, crops)
    semantic_map.prune_window(camera_m)
    if fuses:
        semantic_map.fuse()
    return time.perf_counter() - started
