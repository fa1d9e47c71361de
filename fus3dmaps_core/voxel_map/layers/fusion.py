"""Cross-layer fusion of instances, stateless [sec: 3D Cross-Layer Semantic Fusion].

With lambda = R^D / R^I and rho_i = w_i^D + lambda count[i, id]:

    f_fused,id = sum_i (w_i^D f_i^D + lambda count[i, id] f_id) / sum_i rho_i over V_id [eq. sparse_fusion]
    e_id = sum_i rho_i

The counts of an instance are summed when they are observed, so only voxels with a dense embedding are visited.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from fus3dmaps_core.voxel_map.kernels.protocols import FusionRows, Kernels
from fus3dmaps_core.voxel_map.layers.dense import DenseLayer
from fus3dmaps_core.voxel_map.layers.instances import InstanceLayer
from fus3dmaps_core.voxel_map.rows.row_pool import RowPool


@dataclass(frozen=True)
class FusionInputs:
    """What fusion reads.

    Attributes:
        kernels: Inner loops.
        dense: The dense layer.
        instances: The instance layer.
        variance_ratio: lambda.
    """

    kernels: Kernels
    dense: DenseLayer
    instances: InstanceLayer
    variance_ratio: float


def fuse_instances(inputs: FusionInputs, rows: Tensor, bars: Tensor, target: RowPool, sum_bytes: int) -> Tensor:
    """Fuse instances. The result for one does not depend on which others are fused with it.

    Args:
        inputs: What is fused.
        rows: (n,) rows of the instances.
        bars: (n,) float64; an instance's fused embedding is written only where its evidence is greater.
        target: Written: fused embeddings, under the instances' rows.
        sum_bytes: Bytes of one set of float64 sums, of which kernels hold a few. As many instances as fit into one are
            fused in one pass over the dense rows.

    Returns:
        Evidence e_id of each instance, (n,) float64.
    """
    dense, instances = inputs.dense, inputs.instances
    voxels = FusionRows(dense.pool, dense.slot_of_row(), dense.weight_of_row(), instances.held())
    amounts = inputs.variance_ratio * instances.observations(rows).to(torch.float64)
    evidence = torch.empty_like(amounts)
    step = max(1, sum_bytes // (8 * instances.pool.dimension))
    for first in range(0, len(rows), step):
        part = slice(first, first + step)
        evidence[part] = inputs.kernels.fuse(voxels, rows[part], instances.pool, amounts[part], bars[part], target)
    return evidence
