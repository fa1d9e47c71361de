"""The benchmark's world: one robot's keyframes, and the surfaces of which maps of any size are filled around them.

Every map holds what the keyframes see; a larger one holds more of the building besides. Between two sizes, then, it is the
map that changes, not the work.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from benchmarks.boxes import surface_points, voxels_of
from benchmarks.building import make_room
from benchmarks.embeddings import ObservedObjects
from benchmarks.keyframes import (
    PART_M,
    DenseKeyframe,
    ProposalKeyframe,
    dense_keyframe,
    detection_keyframe,
    mask_keyframe,
    object_colors,
    part_labels,
    robot_path,
)
from fus3dmaps_core.voxel_map.semantic_map import SemanticMap

KEYFRAMES = 12
MIN_VOXELS = 10_000
"""Smaller maps cannot hold what the keyframes see."""

_DETECTION_KEYFRAMES = 4
_CHUNK_VOXELS = 16_384
_VIEWS_PER_OBJECT = 16
_OBSERVATIONS = 10.0
_PARTS_PER_GROUP = 12


@dataclass(frozen=True)
class Surface:
    """Points on surfaces, one for each voxel of a map.

    Attributes:
        points_m: (n, 3) metres, each in a voxel of its own.
        objects: (n,) label of the surface that each lies on.
        seen: The first so many are what the keyframes see.
    """

    points_m: NDArray[np.float64]
    objects: NDArray[np.int64]
    seen: int


class World:
    """The same for every map of a run."""

    def __init__(self, max_voxels: int, seed: int) -> None:
        """Build the world.

        Args:
            max_voxels: Size of the largest map.
            seed: Same seed, same world.
        """
        self.seed = seed
        self._max_voxels = max_voxels
        self._boxes = make_room(0, seed).boxes
        self._path = robot_path(KEYFRAMES)

    @cached_property
    def dense(self) -> list[DenseKeyframe]:
        """5 samples for each of 1,200 patches: 6,000 points a keyframe."""
        return self._dense(6000)

    @cached_property
    def dense_8k(self) -> list[DenseKeyframe]:
        """The same views with 8,000 points."""
        return self._dense(8000)

    @cached_property
    def masks(self) -> list[ProposalKeyframe]:
        """40 masks a keyframe, 9 samples for each patch."""
        rng = np.random.default_rng([self.seed, 40])
        return [mask_keyframe(self._boxes, camera, rng) for camera in self._path]

    @cached_property
    def detections(self) -> list[ProposalKeyframe]:
        """20 proposals of 3,800 points a keyframe."""
        rng = np.random.default_rng([self.seed, 20])
        return [detection_keyframe(self._boxes, camera, rng) for camera in self._path[:_DETECTION_KEYFRAMES]]

    @cached_property
    def surface(self) -> Surface:
        """Return surfaces of exactly max_voxels voxels: what is seen, in the order in which it is, then the rest by room."""
        dense, proposals = [*self.dense, *self.dense_8k], [*self.masks, *self.detections]
        seen = voxels_of(np.concatenate([view.points_m for view in dense] + [view.points_m for view in proposals]))
        voxels, labels = make_room(0, self.seed).voxels()
        keys, room_keys = _keys(seen), _keys(voxels)
        found, first = np.unique(keys, return_index=True)
        order = np.argsort(room_keys)
        place = order[np.searchsorted(room_keys, found[np.argsort(first)], sorter=order)]
        rest = np.setdiff1d(np.arange(len(voxels)), place)
        parts = [(voxels[place], labels[place]), (voxels[rest], labels[rest])]
        count, number = len(voxels), 1
        while count < self._max_voxels:
            parts.append(make_room(number, self.seed).voxels())
            count += len(parts[-1][0])
            number += 1
        kept = slice(0, self._max_voxels)
        points_m = surface_points(np.concatenate([part[0] for part in parts])[kept])
        return Surface(points_m, np.concatenate([part[1] for part in parts])[kept], len(place))

    def _dense(self, points: int) -> list[DenseKeyframe]:
        rng = np.random.default_rng([self.seed, points])
        return [dense_keyframe(self._boxes, camera, points, rng) for camera in self._path]


def instance_labels(surface: Surface, voxels: int, instances: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Make instances that together cover a map of the surface's first voxels, two deep for half of them.

    What the keyframes see is cut into parts of things, the rest evenly into as many pieces as are wanted. Groups of twelve
    neighbours share a half of each with an instance of their own, which overlaps each too little to be taken for it.

    Args:
        surface: The world's surface.
        voxels: Size of the map.
        instances: Instances in all.

    Returns:
        (m,) int64 positions in the surface and (m,) int64 instance of each, ascending.
    """
    seen = slice(0, surface.seen)
    parts = part_labels(surface.points_m[seen], surface.objects[seen], PART_M)
    _, index, sizes = np.unique(parts, return_inverse=True, return_counts=True)
    rank = np.empty(len(sizes), np.int64)
    rank[np.argsort(sizes, kind="stable")] = np.arange(len(sizes))  # Neighbours are of like size.
    singles = max(-(-instances * _PARTS_PER_GROUP // (_PARTS_PER_GROUP + 1)), len(sizes) + 1)
    groups = min(max(instances - singles, 0), singles // _PARTS_PER_GROUP)
    others = voxels - surface.seen
    pieces = len(sizes) + np.arange(others) * (singles - len(sizes)) // max(others, 1)
    single = np.concatenate([rank[index], pieces])
    half = _first_halves(single, singles) & (single // _PARTS_PER_GROUP < groups)
    positions = np.concatenate([np.arange(voxels), np.flatnonzero(half)])
    labels = np.concatenate([single, singles + single[half] // _PARTS_PER_GROUP])
    order = np.argsort(labels, kind="stable")
    return positions[order], labels[order]


def fill(semantic_map: SemanticMap, world: World, voxels: int, instances: int, observed: ObservedObjects) -> None:
    """Give an empty map exactly so many voxels, each with a dense embedding, and instances over them."""
    surface = world.surface
    for start in range(0, voxels, _CHUNK_VOXELS):
        chunk = slice(start, min(start + _CHUNK_VOXELS, voxels))
        objects = surface.objects[chunk]
        views = objects * _VIEWS_PER_OBJECT + np.arange(len(objects)) // 8 % _VIEWS_PER_OBJECT
        distinct, patches = np.unique(views, return_inverse=True)
        semantic_map.integrate_dense(
            surface.points_m[chunk],
            patches.astype(np.int64),
            observed.observe(distinct // _VIEWS_PER_OBJECT),
            np.full(len(distinct), _OBSERVATIONS, np.float32),
            object_colors(objects),
        )
    positions, labels = instance_labels(surface, voxels, instances)
    starts = np.flatnonzero(np.diff(labels, prepend=-1))
    ends = np.append(starts[1:], len(labels))
    for first in range(0, len(starts), 64):
        last = min(first + 64, len(starts))
        members = slice(starts[first], ends[last - 1])
        objects = surface.objects[positions[starts[first:last]]]
        proposals = np.unique(labels[members], return_inverse=True)[1]
        semantic_map.integrate_proposals(surface.points_m[positions[members]], proposals, observed.observe(objects))
    if semantic_map.voxel_count != voxels:
        raise RuntimeError(f"the map should have {voxels} voxels, has {semantic_map.voxel_count}")


def _first_halves(labels: NDArray[np.int64], count: int) -> NDArray[np.bool_]:
    """Tell for each member whether it is in the first half of its label's members."""
    order = np.argsort(labels, kind="stable")
    sizes = np.bincount(labels, minlength=count)
    rank = np.empty(len(labels), np.int64)
    rank[order] = np.arange(len(labels)) - np.repeat(np.cumsum(sizes) - sizes, sizes)
    return rank < sizes[labels] // 2


def _keys(voxels: NDArray[np.int64]) -> NDArray[np.int64]:
    """Make one integer for each voxel of the building, in the order of the indices."""
    shifted = voxels + 2**20
    return (shifted[:, 0] << 42) | (shifted[:, 1] << 21) | shifted[:, 2]
