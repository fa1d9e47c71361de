"""Copies of the map of one moment, which nobody changes: what publishers, queries and pictures work from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class FusionReport:
    """What one fusion did.

    Attributes:
        instances: Instances alive.
        updated: Instances whose fused embedding was replaced.
        voxels: Voxels of the map.
        duration_s: Wall time, seconds.
    """

    instances: int
    updated: int
    voxels: int
    duration_s: float


@dataclass(frozen=True)
class VoxelSnapshot:
    """A copy of the map's voxels, by slot.

    Attributes:
        centers_m: (n, 3) float32 voxel centres in the map frame, metres.
        colors: (n, 3) uint8, mean colour in the newest dense keyframe that hit the voxel; grey if none did.
        top_instance: (n,) int64 id of the hypothesis with the highest count, -1 without one.
        top_count: (n,) int64 count of that hypothesis, 0 without one.
        dense_weight: (n,) float32 w^D, 0 without a dense embedding.
    """

    centers_m: NDArray[np.float32]
    colors: NDArray[np.uint8]
    top_instance: NDArray[np.int64]
    top_count: NDArray[np.int64]
    dense_weight: NDArray[np.float32]


@dataclass(frozen=True)
class InstanceSnapshot:
    """A copy of the instances alive, by ascending id. An instance occupies the voxels whose top hypothesis it is.

    Attributes:
        ids: (n,) int64.
        weights: (n,) float64 w_id, observations behind the embedding.
        hypothesis_voxels: (n,) int64 |V_id|, voxels that hold it as any of their hypotheses.
        voxel_counts: (n,) int64, voxels that it occupies.
        centroids_m: (n, 3) float32, mean of the centres of these, weighted by count; NaN if there is none.
        boxes_min_m: (n, 3) float32, smallest corner of these voxels; NaN if there is none.
        boxes_max_m: (n, 3) float32, largest corner; NaN if there is none.
    """

    ids: NDArray[np.int64]
    weights: NDArray[np.float64]
    hypothesis_voxels: NDArray[np.int64]
    voxel_counts: NDArray[np.int64]
    centroids_m: NDArray[np.float32]
    boxes_min_m: NDArray[np.float32]
    boxes_max_m: NDArray[np.float32]


@dataclass(frozen=True)
class LayerSimilarity:
    """Similarities of one layer with some texts, and the map they belong to, all of one moment.

    Attributes:
        slots: (n,) int64 slots that have the layer, ascending.
        cosines: (n, p) float32.
        voxels: The map's voxels.
        instances: The map's instances.
    """

    slots: NDArray[np.int64]
    cosines: NDArray[np.float32]
    voxels: VoxelSnapshot
    instances: InstanceSnapshot


def snapshot_instances(
    ids: NDArray[np.int64],
    weights: NDArray[np.float64],
    hypothesis_voxels: NDArray[np.int64],
    voxels: VoxelSnapshot,
    voxel_size_m: float,
) -> InstanceSnapshot:
    """Instances with the place that each occupies.

    Args:
        ids: (n,) ascending ids of the instances alive.
        weights: (n,) their weights.
        hypothesis_voxels: (n,) their |V_id|.
        voxels: All voxels of the map.
        voxel_size_m: Edge of a voxel, metres.
    """
    held = voxels.top_instance >= 0
    place = np.searchsorted(ids, voxels.top_instance[held])
    centers, counts = voxels.centers_m[held].astype(np.float64), voxels.top_count[held].astype(np.float64)
    n = len(ids)
    totals = np.bincount(place, counts, minlength=n)
    sums = np.stack([np.bincount(place, counts * centers[:, axis], minlength=n) for axis in range(3)], axis=1)
    with np.errstate(invalid="ignore"):
        centroids = sums / totals[:, None]
    low, high = np.full((n, 3), np.inf), np.full((n, 3), -np.inf)
    np.minimum.at(low, place, centers)
    np.maximum.at(high, place, centers)
    low[totals == 0] = high[totals == 0] = np.nan
    return InstanceSnapshot(
        ids,
        weights,
        hypothesis_voxels,
        np.bincount(place, minlength=n),
        centroids.astype(np.float32),
        (low - 0.5 * voxel_size_m).astype(np.float32),
        (high + 0.5 * voxel_size_m).astype(np.float32),
    )
