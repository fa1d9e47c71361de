"""Cosines of texts with one layer, for some voxels at a time, so that memory stays bounded at any map size."""

from __future__ import annotations

from typing import Protocol

import torch
from torch import Tensor

from fus3dmaps_core.kernels.protocols import Kernels, VoxelBlock
from fus3dmaps_core.layers.dense import DenseLayer
from fus3dmaps_core.layers.fused_instances import FusedInstances
from fus3dmaps_core.layers.fusion import FusionInputs


class LayerCosines(Protocol):
    """Cosines of one layer with the texts that it was made for.

    Attributes:
        with_dense: Whether voxels that have a dense embedding have this layer.
        with_instance: Whether voxels that have a hypothesis have this layer.
    """

    with_dense: bool
    with_instance: bool

    def __call__(self, voxels: VoxelBlock) -> Tensor:
        """Cosines of n voxels that have the layer: (n, p) float32."""
        ...


class DenseCosines:
    """The dense layer."""

    with_dense, with_instance = True, False

    def __init__(self, kernels: Kernels, dense: DenseLayer, texts: Tensor) -> None:
        """For texts (p, d) of unit length."""
        self._kernels, self._dense, self._texts = kernels, dense, texts

    def __call__(self, voxels: VoxelBlock) -> Tensor:
        """As the protocol says."""
        return self._kernels.cosines(self._dense.pool, voxels.dense_rows, self._texts)


class FusedDenseCosines:
    """The fused dense layer, which covers every voxel that has either layer.

    f_fused,i = (w_i^D f_i^D + lambda c_i f_top(i)) / (w_i^D + lambda c_i), where c_i is the count of the top hypothesis; a
    voxel with one layer only takes that layer's embedding.
    """

    with_dense, with_instance = True, True

    def __init__(self, inputs: FusionInputs, texts: Tensor) -> None:
        """For texts (p, d) of unit length."""
        self._inputs, self._texts = inputs, texts

    def __call__(self, voxels: VoxelBlock) -> Tensor:
        """As the protocol says."""
        dense, rows = self._inputs.dense, voxels.dense_rows
        own_weights = self._inputs.variance_ratio * voxels.top_counts.to(torch.float32)
        own = (self._inputs.instances.pool, voxels.top_rows, own_weights)
        return self._inputs.kernels.fused_cosines(dense.pool, rows, dense.weights(rows), *own, self._texts)


class InstanceCosines:
    """An instance layer: per voxel the embedding of its top hypothesis, raw or fused."""

    with_dense, with_instance = False, True

    def __init__(self, inputs: FusionInputs, fused: FusedInstances | None, texts: Tensor, instance_rows: Tensor) -> None:
        """For texts (p, d) of unit length and the rows of all instances alive; raw without ``fused``."""
        if fused is None:
            cosines = inputs.kernels.cosines(inputs.instances.pool, instance_rows, texts)
        else:
            cosines = fused.cosines(inputs, instance_rows, texts)
        self._cosines = cosines
        self._place = torch.full((inputs.instances.pool.high_water,), -1, dtype=torch.int64, device=texts.device)
        self._place[instance_rows] = torch.arange(len(instance_rows), device=texts.device)

    def __call__(self, voxels: VoxelBlock) -> Tensor:
        """As the protocol says."""
        return self._cosines.index_select(0, self._place.index_select(0, voxels.top_rows))
