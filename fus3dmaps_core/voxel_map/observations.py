"""From checked arrays to what the layers take: voxel keys, unit embeddings and observations grouped by voxel or proposal."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from fus3dmaps_core.errors import MapError
from fus3dmaps_core.voxel_map.checks import (
    check_colors,
    check_finite,
    check_floats,
    check_indices,
    check_rows,
    check_weights,
)
from fus3dmaps_core.voxel_map.kernels.keys import MAX_COORDINATE
from fus3dmaps_core.voxel_map.kernels.protocols import GroupedCounts, Kernels


@dataclass(frozen=True)
class DenseObservations:
    """A keyframe as the dense layer takes it.

    Attributes:
        keys: (v,) int64 distinct keys of the voxels that have a point.
        colors: (v, 3) uint8 mean colour of their points.
        patches: v groups of patches: how many points of each patch lie in the voxel.
        embeddings: (p, d) float32 unit vectors, one per patch.
        weights: (p,) float32 weight of one observation of each patch.
    """

    keys: Tensor
    colors: Tensor
    patches: GroupedCounts
    embeddings: Tensor
    weights: Tensor


@dataclass(frozen=True)
class ProposalObservations:
    """A keyframe as the instance layer takes it.

    Attributes:
        keys: (v,) int64 distinct keys of the voxels that have a point of a proposal.
        voxels: m groups of places among the keys: how many points of each proposal lie in the voxel.
        embeddings: (m, d) float32 unit vectors, one per proposal.
        visible_keys: Distinct keys of everything that the keyframe saw, the proposals included; None where association does
            not ask for it.
    """

    keys: Tensor
    voxels: GroupedCounts
    embeddings: Tensor
    visible_keys: Tensor | None


class ObservationReader:
    """Checks arrays and converts them to tensors on the map's device. Nothing of the map is touched."""

    def __init__(self, dimension: int, voxel_size_m: float, kernels: Kernels, device: torch.device) -> None:
        """Read for a map of the given embedding width d and voxel size."""
        self._dimension, self._voxel_size_m = dimension, voxel_size_m
        self._kernels, self._device = kernels, device

    def dense(
        self,
        points_m: NDArray[np.floating],
        patches: NDArray[np.integer],
        embeddings: NDArray[np.floating],
        weights: NDArray[np.floating],
        colors: NDArray[np.uint8],
    ) -> DenseObservations:
        """Group a keyframe's points by voxel and patch; arguments as of :meth:`SemanticMap.integrate_dense`."""
        check_rows("points_m", points_m, 3)
        check_rows("embeddings", embeddings, self._dimension)
        check_indices("patches", patches, len(points_m), len(embeddings))
        check_floats("weights", weights, (len(embeddings),))
        weights = _as_float32(weights)
        check_weights(weights)
        check_colors(colors, len(points_m))
        unit = self.unit_rows("embeddings", embeddings)
        keys, voxels, counts = self._kernels.distinct(self.voxel_keys("points_m", points_m))
        sums = torch.zeros((len(keys), 3), dtype=torch.int64, device=self._device)
        sums.index_add_(0, voxels, torch.from_numpy(colors.astype(np.int64)).to(self._device))
        mean_colors = ((2 * sums + counts[:, None]) // (2 * counts[:, None])).to(torch.uint8)
        useful, of_points = weights > 0, torch.from_numpy(patches.astype(np.int64)).to(self._device)
        if not useful.all():
            of_useful = torch.from_numpy(useful[patches]).to(self._device)
            voxels, of_points = voxels.masked_select(of_useful), of_points.masked_select(of_useful)
        groups = self._kernels.count_pairs(voxels, of_points, len(keys), len(unit))
        return DenseObservations(keys, mean_colors, groups, unit, torch.from_numpy(weights).to(self._device))

    def proposals(
        self,
        points_m: NDArray[np.floating],
        proposals: NDArray[np.integer],
        embeddings: NDArray[np.floating],
        visible_points_m: NDArray[np.floating] | None,
        needs_visible: bool,
    ) -> ProposalObservations:
        """Group a keyframe's points by proposal and voxel; arguments as of :meth:`SemanticMap.integrate_proposals`."""
        check_rows("points_m", points_m, 3)
        check_rows("embeddings", embeddings, self._dimension)
        check_indices("proposals", proposals, len(points_m), len(embeddings))
        unit, all_keys = self.unit_rows("embeddings", embeddings), self.voxel_keys("points_m", points_m)
        keys, voxels, _ = self._kernels.distinct(all_keys)
        visible = None
        if needs_visible:
            beside = [] if visible_points_m is None else [self.voxel_keys("visible_points_m", visible_points_m)]
            visible, _, _ = self._kernels.distinct(torch.cat([all_keys, *beside]))
        of_points = torch.from_numpy(proposals.astype(np.int64)).to(self._device)
        return ProposalObservations(keys, self._kernels.count_pairs(of_points, voxels, len(unit), len(keys)), unit, visible)

    def unit_rows(self, name: str, embeddings: NDArray[np.floating]) -> Tensor:
        """Scale embeddings (n, d) of any length but 0 to unit length: float32.

        Raises:
            MapError: Their shape or dtype is wrong, a value is not finite, or a row has length 0.
        """
        check_rows(name, embeddings, self._dimension)
        units, failure = self._kernels.unit_rows(self._tensor(embeddings))
        if failure:
            raise MapError(f"{name}: " + ("a row has length 0" if failure == 2 else "has values that are not finite"))
        return units

    def voxel_keys(self, name: str, points_m: NDArray[np.floating]) -> Tensor:
        """Compute the packed key of the voxel of each point (n, 3): floor(p / size) per axis, (n,) int64.

        Raises:
            MapError: Their shape or dtype is wrong, or a point is not finite or beyond the map's range.
        """
        check_rows(name, points_m, 3)
        keys, largest = self._kernels.voxel_keys(self._tensor(points_m), self._voxel_size_m)
        if not math.isfinite(largest):
            raise MapError(f"{name}: has values that are not finite")
        if largest > MAX_COORDINATE:
            farthest, limit_km = largest * self._voxel_size_m, MAX_COORDINATE * self._voxel_size_m / 1000
            raise MapError(f"{name}: {farthest:.0f} m is beyond the map's range of {limit_km:.1f} km")
        return keys

    def position(self, name: str, position_m: NDArray[np.floating]) -> Tensor:
        """Convert a position to a (3,) float64 tensor.

        Raises:
            MapError: It is not three finite numbers.
        """
        check_floats(name, position_m, (3,))
        check_finite(name, position_m.astype(np.float64))
        return torch.from_numpy(position_m.astype(np.float64)).to(self._device)

    def _tensor(self, values: NDArray[np.floating]) -> Tensor:
        """Convert values to a type that torch and kernels know."""
        wide = values if values.dtype in (np.float32, np.float64) else values.astype(np.float64)
        return torch.from_numpy(np.ascontiguousarray(wide)).to(self._device)


def _as_float32(values: NDArray[np.floating]) -> NDArray[np.float32]:
    with np.errstate(over="ignore"):  # What is too large becomes infinity, which the checks refuse.
        return np.ascontiguousarray(values, dtype=np.float32)
