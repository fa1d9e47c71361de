"""Copies of the map at one moment, which never change. Publishers, queries and pictures work from them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from fus3dmaps_core.voxel_map.kernels.protocols import Extents


@dataclass(frozen=True)
class FusionReport:
    """Figures of one fusion.

    Attributes:
        instances: Instances alive.
        updated: Instances whose stored fused embedding is of this fusion.
        recomputed: Instances that had changed, and were computed.
        voxels: Voxels of the map.
        duration_s: Wall time, seconds.
    """

    instances: int
    updated: int
    recomputed: int
    voxels: int
    duration_s: float


@dataclass(frozen=True)
class VoxelSnapshot:
    """A copy of the map's voxels, in the order of their slots.

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


def snapshot_instances(
    ids: Tensor, weights: Tensor, hypothesis_voxels: Tensor, extents: Extents, voxel_size_m: float
) -> InstanceSnapshot:
    """Describe instances by the place that each occupies.

    Args:
        ids: (n,) ascending ids of the instances alive.
        weights: (n,) their weights.
        hypothesis_voxels: (n,) their |V_id|.
        extents: n rows: what they occupy.
        voxel_size_m: Edge of a voxel, metres.
    """
    nowhere = (extents.voxels == 0)[:, None]
    centroids = extents.sums.to(torch.float64) / extents.counts.to(torch.float64)[:, None] + 0.5
    corners = [torch.where(nowhere, torch.nan, each.to(torch.float64)) for each in (extents.low, extents.high + 1)]
    centroids_m, low_m, high_m = ((each * voxel_size_m).to(torch.float32).cpu().numpy() for each in (centroids, *corners))
    return InstanceSnapshot(
        ids=ids.cpu().numpy(),
        weights=weights.cpu().numpy(),
        hypothesis_voxels=hypothesis_voxels.cpu().numpy(),
        voxel_counts=extents.voxels.cpu().numpy(),
        centroids_m=centroids_m,
        boxes_min_m=low_m,
        boxes_max_m=high_m,
    )
