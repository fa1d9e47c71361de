"""True class and instance of every voxel, from labelled points or from label images with depth and poses."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Literal

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from fus3dmaps_core.config.schema import ImageConfig
from fus3dmaps_core.errors import FrameError, MapError
from fus3dmaps_core.frame import Intrinsics, PosedFrame
from fus3dmaps_core.geometry.projection import resize_frame, unproject
from fus3dmaps_core.voxel_map.kernels.keys import MAX_COORDINATE, pack, unpack

Rounding = Literal["floor", "round"]
"""Voxel of a point: floor(p / size), as in the map, or round(p / size), as in the published protocol."""

NOTHING = 0
"""Class of a voxel that is not evaluated, instance of one that belongs to no object, class of a missing prediction."""

_ROWS_KEPT = 2**22  # Number of votes that are stored before equal ones are summed.


@dataclass(frozen=True)
class VoxelTruth:
    """True class and instance of all known voxels.

    Attributes:
        keys: (n, 3) int64 voxel indices, all different.
        classes: (n,) int32, NOTHING if the voxel is not evaluated.
        instances: (n,) int32, NOTHING if it belongs to none.
        voxel_size_m: Edge of a voxel, metres.
        rounding: Place of the voxels: index i spans [i, i + 1) sizes for ``floor``, [i - 0.5, i + 0.5) for ``round``.
    """

    keys: NDArray[np.int64]
    classes: NDArray[np.int32]
    instances: NDArray[np.int32]
    voxel_size_m: float = 0.05
    rounding: Rounding = "floor"

    def __post_init__(self) -> None:
        """Raise MapError unless the arrays fit together."""
        count = len(self.keys)
        if self.keys.shape != (count, 3) or self.classes.shape != (count,) or self.instances.shape != (count,):
            shapes = f"{self.keys.shape}, {self.classes.shape}, {self.instances.shape}"
            raise MapError(f"truth: keys, classes and instances must be (n, 3), (n,) and (n,), got {shapes}")
        if count and min(self.classes.min(), self.instances.min()) < NOTHING:
            raise MapError("truth: classes and instances must not be negative")

    @property
    def positions(self) -> NDArray[np.float64]:
        """Places on the map's grid, (n, 3) float64, in voxels; whole numbers are voxels of the grid itself."""
        return self.keys.astype(np.float64) - (0.5 if self.rounding == "round" else 0.0)

    @property
    def centers_m(self) -> NDArray[np.float64]:
        """Centres of the voxels, (n, 3) float64, metres, map frame."""
        return np.asarray((self.positions + 0.5) * self.voxel_size_m)

    def without(self, ignored: Iterable[int]) -> VoxelTruth:
        """Copy the truth; voxels of the given classes are not evaluated and belong to no instance."""
        gone = np.isin(self.classes, list(ignored))
        classes, instances = np.where(gone, NOTHING, self.classes), np.where(gone, NOTHING, self.instances)
        return replace(self, classes=classes.astype(np.int32), instances=instances.astype(np.int32))


@dataclass(frozen=True)
class LabelledDepth:
    """A depth image with the class and instance of each pixel.

    Attributes:
        depth_m: (H, W) float32 metres along the optical axis, 0 where there is no valid reading.
        intrinsics: Camera model of the depth image.
        T_world_camera: (4, 4) float64 pose of the optical frame in the map frame.
        classes: (H, W) integers, NOTHING where unknown.
        instances: (H, W) integers, NOTHING where there is none; None if instances are not known at all.
    """

    depth_m: NDArray[np.float32]
    intrinsics: Intrinsics
    T_world_camera: NDArray[np.float64]
    classes: NDArray[np.integer]
    instances: NDArray[np.integer] | None = None

    def __post_init__(self) -> None:
        """Raise FrameError (reason ``size_mismatch``) unless the images have the same size."""
        for name, image in (("classes", self.classes), ("instances", self.instances)):
            if image is not None and image.shape != self.depth_m.shape:
                raise FrameError(f"{name}: image is {image.shape}, depth {self.depth_m.shape}", reason="size_mismatch")


def labelled_depth(
    frame: PosedFrame, classes: NDArray[np.integer], instances: NDArray[np.integer] | None, image: ImageConfig
) -> LabelledDepth:
    """Bring a labelled frame to the map's working resolution and depth range; labels are resized by nearest neighbour.

    Args:
        frame: The frame that the map gets.
        classes: (H, W) integers, of the same field of view.
        instances: (H, W) integers, or None.
        image: Working resolution and range of depth.
    """
    working = resize_frame(frame, image)
    size = (image.width, image.height)
    small_instances = None if instances is None else _resized(instances, size)
    return LabelledDepth(working.depth_m, working.intrinsics, frame.T_world_camera, _resized(classes, size), small_instances)


def voxel_keys(points_m: NDArray[np.floating], voxel_size_m: float, rounding: Rounding = "floor") -> NDArray[np.int64]:
    """Compute the voxel of each point.

    Args:
        points_m: (n, 3) metres, map frame.
        voxel_size_m: Edge of a voxel, metres.
        rounding: Voxel of a point; halves are rounded to even.

    Returns:
        (n, 3) int64.

    Raises:
        MapError: The points are not (n, 3), not finite, or too far out for a voxel index.
    """
    points = np.asarray(points_m, np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise MapError(f"points_m: must be (n, 3), got {points.shape}")
    scaled = points / voxel_size_m
    if not np.all(np.abs(scaled) < MAX_COORDINATE):  # Also true of NaN.
        raise MapError(f"points_m: must be finite and within {MAX_COORDINATE} voxels of the origin")
    return np.asarray(np.floor(scaled) if rounding == "floor" else np.rint(scaled)).astype(np.int64)


def voxel_truth(
    points_m: NDArray[np.floating],
    classes: NDArray[np.integer],
    instances: NDArray[np.integer],
    voxel_size_m: float,
    rounding: Rounding = "floor",
) -> VoxelTruth:
    """Make the truth from labelled points. A voxel gets the class of most of its points, which may be NOTHING.

    Its instance is that of most points of this class. Ties go to the lowest number.

    Args:
        points_m: (n, 3) metres, map frame.
        classes: (n,) integers, NOTHING if a point is not evaluated.
        instances: (n,) integers, NOTHING if it belongs to none.
        voxel_size_m: Edge of a voxel, metres.
        rounding: Voxel of a point.

    Returns:
        Voxels in ascending order of their keys.

    Raises:
        MapError: A shape or value is wrong.
    """
    votes = _Votes(voxel_size_m, rounding)
    votes.add(points_m, classes, instances)
    return votes.truth(frozenset())


def voxel_truth_from_frames(
    frames: Iterable[LabelledDepth],
    voxel_size_m: float,
    ignored: frozenset[int] = frozenset(),
    rounding: Rounding = "floor",
) -> VoxelTruth:
    """Make the truth from label images, with the depth and poses that the map gets.

    A voxel gets the kept class of most of its pixels in all frames. A voxel that shows any kept class gets one of them,
    however many of its pixels are ignored. (That is the largest component of the mean one-hot vector.) Its instance is that
    of most pixels of this class. Ties go to the lowest number.

    Args:
        frames: Label images with depth and poses.
        voxel_size_m: Edge of a voxel, metres.
        ignored: Classes that are not kept, besides NOTHING.
        rounding: Voxel of a point.

    Returns:
        Voxels in ascending order of their keys.

    Raises:
        MapError: A value is wrong.
    """
    votes = _Votes(voxel_size_m, rounding)
    for frame in frames:
        ys, xs = np.nonzero(np.isfinite(frame.depth_m) & (frame.depth_m > 0))
        points_m = unproject(frame.depth_m, ys, xs, frame.intrinsics, frame.T_world_camera)
        instances = np.zeros(len(ys), np.int32) if frame.instances is None else frame.instances[ys, xs]
        votes.add(points_m, frame.classes[ys, xs], instances)
    return votes.truth(ignored | {NOTHING})


class _Votes:
    """Counts of how often each voxel was seen with each pair of class and instance."""

    def __init__(self, voxel_size_m: float, rounding: Rounding) -> None:
        self._voxel_size_m, self._rounding = voxel_size_m, rounding
        self._parts: list[tuple[NDArray[np.int64], ...]] = []
        self._rows = 0

    def add(self, points_m: NDArray[np.floating], classes: NDArray[np.integer], instances: NDArray[np.integer]) -> None:
        count = len(points_m)
        if classes.shape != (count,) or instances.shape != (count,):
            raise MapError(f"classes, instances: must be ({count},), got {classes.shape} and {instances.shape}")
        if not count:
            return
        if min(classes.min(), instances.min()) < NOTHING:
            raise MapError("classes, instances: must not be negative")
        voxels = pack(torch.from_numpy(voxel_keys(points_m, self._voxel_size_m, self._rounding))).numpy()
        self._parts.append(_summed(voxels, classes.astype(np.int64), instances.astype(np.int64), np.ones(count, np.int64)))
        self._rows += len(self._parts[-1][0])
        if self._rows > _ROWS_KEPT:
            self._parts = [self._all()]
            self._rows = len(self._parts[0][0])

    def truth(self, last_choice: frozenset[int]) -> VoxelTruth:
        """Give each voxel the class of most votes; classes of ``last_choice`` lose to all others and become NOTHING."""
        voxels, classes, instances, counts = self._all()
        classes = np.where(np.isin(classes, list(last_choice)), NOTHING, classes)
        voxels, classes, instances, counts = _summed(voxels, classes, instances, counts)
        groups = _summed(voxels, classes, np.zeros_like(voxels), counts)
        rank = groups[3] if not last_choice else np.where(groups[1] == NOTHING, 0, groups[3])
        chosen = _first_of_each(groups[0], groups[1], rank)
        best_class = groups[1][chosen]
        place = np.searchsorted(groups[0][chosen], voxels)
        of_class = classes == best_class[place]
        voxels, instances, counts = voxels[of_class], instances[of_class], counts[of_class]
        best_instance = instances[_first_of_each(voxels, instances, counts)]
        if last_choice:
            best_instance = np.where(best_class == NOTHING, NOTHING, best_instance)
        keys = unpack(torch.from_numpy(groups[0][chosen])).numpy()
        return VoxelTruth(
            keys, best_class.astype(np.int32), best_instance.astype(np.int32), self._voxel_size_m, self._rounding
        )

    def _all(self) -> tuple[NDArray[np.int64], ...]:
        if not self._parts:
            return tuple(np.empty(0, np.int64) for _ in range(4))
        return _summed(*(np.concatenate(column) for column in zip(*self._parts, strict=True)))


def _summed(
    voxels: NDArray[np.int64], classes: NDArray[np.int64], instances: NDArray[np.int64], counts: NDArray[np.int64]
) -> tuple[NDArray[np.int64], ...]:
    """Merge equal rows, in ascending order, and sum their counts."""
    if not len(voxels):
        return voxels, classes, instances, counts
    order = np.lexsort((instances, classes, voxels))
    rows = np.stack([voxels[order], classes[order], instances[order]])
    starts = np.flatnonzero(np.concatenate([[True], np.any(rows[:, 1:] != rows[:, :-1], axis=0)]))
    return (*rows[:, starts], np.add.reduceat(counts[order], starts))


def _first_of_each(voxels: NDArray[np.int64], labels: NDArray[np.int64], counts: NDArray[np.int64]) -> NDArray[np.int64]:
    """Find for each voxel, in ascending order, the place of its highest count; ties go to the lowest label."""
    order = np.lexsort((labels, -counts, voxels))
    return order[np.flatnonzero(np.diff(voxels[order], prepend=-1))]


def _resized(labels: NDArray[np.integer], size: tuple[int, int]) -> NDArray[np.int32]:
    return np.asarray(cv2.resize(labels.astype(np.int32), size, interpolation=cv2.INTER_NEAREST_EXACT), np.int32)
