"""What a robot's keyframes hand to the map: sampled pixels of a 480x640 camera that drives through the first room."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchmarks.boxes import Box, cast_rays, voxels_of
from fus3dmaps_core.geometry.projection import PixelSamples, sample_pixels

HEIGHT, WIDTH = 480, 640
PATCH_ROWS, PATCH_COLUMNS = 30, 40
FOCAL_PX = 525.0
STEP_M = 0.1
"""The robot's way between two keyframes."""

PART_M = 0.45
"""Size of the things that masks and the map's instances stand for, metres."""

DEPTH_NOISE_M = 0.008
"""Readings are off by up to this along the optical axis, too little to leave the voxels of a surface; metres."""

_FRESH_SHARE = 0.05
_DETECTION_CELL_M = 0.7
_DETECTION_STRIDE = 2


@dataclass(frozen=True)
class DenseKeyframe:
    """Input of a dense update, but for the embeddings.

    Attributes:
        points_m: (n, 3) metres.
        patches: (n,) patch of each point.
        colors: (n, 3) uint8.
        patch_objects: (p,) object that each patch shows.
        voxels: Distinct voxels that the points lie in.
        fresh_points_m: (m, 3) points in the voxels that the keyframe is the first to see.
    """

    points_m: NDArray[np.float64]
    patches: NDArray[np.int64]
    colors: NDArray[np.uint8]
    patch_objects: NDArray[np.int64]
    voxels: int
    fresh_points_m: NDArray[np.float64]


@dataclass(frozen=True)
class ProposalKeyframe:
    """Input of an instance update, but for the embeddings.

    Attributes:
        points_m: (n, 3) metres.
        proposals: (n,) proposal of each point.
        objects: (m,) object of each proposal.
    """

    points_m: NDArray[np.float64]
    proposals: NDArray[np.int64]
    objects: NDArray[np.int64]


@dataclass(frozen=True)
class View:
    """Sampled pixels seen from one place, those that hit something.

    Attributes:
        points_m: (n, 3) metres.
        labels: (n,) label of the surface.
        patches: (n,) patch of the pixel.
    """

    points_m: NDArray[np.float64]
    labels: NDArray[np.int64]
    patches: NDArray[np.int64]


def look_ahead(
    boxes: list[Box],
    camera_m: NDArray[np.float64],
    pixels: PixelSamples,
    rng: np.random.Generator,
    depth_max_m: float = np.inf,
) -> View:
    """Read the depth of pixels from a level camera that looks along +x.

    Args:
        boxes: The scene.
        camera_m: (3,) metres.
        pixels: What is sampled.
        rng: Decides how far each reading is off.
        depth_max_m: Hits beyond this depth are no readings, metres.
    """
    right = (pixels.xs - (WIDTH - 1) / 2) / FOCAL_PX
    down = (pixels.ys - (HEIGHT - 1) / 2) / FOCAL_PX
    directions = np.stack([np.ones_like(right), -right, -down], axis=1)
    depth_m, labels = cast_rays(boxes, camera_m, directions)
    depth_m += rng.uniform(-DEPTH_NOISE_M, DEPTH_NOISE_M, len(depth_m))
    seen = (labels >= 0) & (depth_m <= depth_max_m)
    return View(camera_m + depth_m[seen, None] * directions[seen], labels[seen], pixels.patches[seen])


def robot_path(keyframes: int) -> NDArray[np.float64]:
    """Place the camera along a path in the first room, 0.1 m apart: (n, 3) metres."""
    ahead_m = 0.6 + STEP_M * np.arange(keyframes)
    return np.stack([ahead_m, np.full(keyframes, 1.75), np.full(keyframes, 1.3)], axis=1)


def dense_keyframe(boxes: list[Box], camera_m: NDArray[np.float64], points: int, rng: np.random.Generator) -> DenseKeyframe:
    """Make a keyframe of 1,200 patches that share the given number of points as evenly as possible.

    Args:
        boxes: The scene, closed around the camera.
        camera_m: (3,) metres.
        points: How many pixels are sampled.
        rng: Decides which pixels are left out, and which voxels are new.
    """
    patches = PATCH_ROWS * PATCH_COLUMNS
    pixels = sample_pixels(HEIGHT, WIDTH, PATCH_ROWS, PATCH_COLUMNS, -(-points // patches))
    view = look_ahead(boxes, camera_m, pixels, rng)
    kept = np.sort(rng.permutation(len(view.points_m))[:points])
    points_m, labels = view.points_m[kept], view.labels[kept]
    patch_objects = np.zeros(patches, np.int64)
    patch_objects[view.patches[kept]] = labels
    _, first = np.unique(voxels_of(points_m), axis=0, return_index=True)
    fresh = rng.permutation(first)[: int(_FRESH_SHARE * len(first))]
    return DenseKeyframe(
        points_m, view.patches[kept], object_colors(labels), patch_objects, len(first), points_m[np.sort(fresh)]
    )


def mask_keyframe(
    boxes: list[Box], camera_m: NDArray[np.float64], rng: np.random.Generator, masks: int = 40
) -> ProposalKeyframe:
    """Make the largest masks of a view, 9 pixels sampled per patch, largest first."""
    view = look_ahead(boxes, camera_m, sample_pixels(HEIGHT, WIDTH, PATCH_ROWS, PATCH_COLUMNS, 9), rng)
    members = _largest(part_labels(view.points_m, view.labels, PART_M), masks)
    return _as_proposals(view, members)


def detection_keyframe(
    boxes: list[Box], camera_m: NDArray[np.float64], rng: np.random.Generator, proposals: int = 20, points: int = 3800
) -> ProposalKeyframe:
    """Make proposals of many points each, as a detector with dense masks yields them."""
    ys, xs = np.meshgrid(np.arange(HEIGHT), np.arange(0, WIDTH, _DETECTION_STRIDE), indexing="ij")
    pixels = PixelSamples(ys.ravel(), xs.ravel(), np.zeros(ys.size, np.int64))
    view = look_ahead(boxes, camera_m, pixels, rng)
    members = _largest(part_labels(view.points_m, view.labels, _DETECTION_CELL_M), proposals)
    # A part with fewer pixels than are asked for gives some of them twice.
    drawn = [np.sort(np.resize(rng.permutation(part), points)) for part in members]
    return _as_proposals(view, drawn)


def part_labels(points_m: NDArray[np.float64], labels: NDArray[np.int64], cell_m: float) -> NDArray[np.int64]:
    """Label the parts of surfaces near the origin, one number for each surface and cell of a grid: (n,) int64."""
    cells = np.floor(points_m / cell_m).astype(np.int64) + 64
    return ((labels * 128 + cells[:, 0]) * 128 + cells[:, 1]) * 128 + cells[:, 2]


def object_colors(labels: NDArray[np.int64]) -> NDArray[np.uint8]:
    """Choose a colour for each object: (n, 3) uint8."""
    return np.stack([(labels * step + 40) % 256 for step in (37, 101, 173)], axis=1).astype(np.uint8)


def _largest(parts: NDArray[np.int64], count: int) -> list[NDArray[np.int64]]:
    _, index, sizes = np.unique(parts, return_inverse=True, return_counts=True)
    return [np.flatnonzero(index == part) for part in np.argsort(-sizes, kind="stable")[:count]]


def _as_proposals(view: View, members: list[NDArray[np.int64]]) -> ProposalKeyframe:
    index = np.concatenate(members)
    proposals = np.repeat(np.arange(len(members)), [len(part) for part in members])
    return ProposalKeyframe(view.points_m[index], proposals, np.array([view.labels[part[0]] for part in members], np.int64))
