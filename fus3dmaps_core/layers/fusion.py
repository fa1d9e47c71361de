"""Cross-layer fusion of instances, stateless [sec: 3D Cross-Layer Semantic Fusion].

With lambda = R^D / R^I and rho_i = w_i^D + lambda count[i, id]:

    f_fused,id = sum_i (w_i^D f_i^D + lambda count[i, id] f_id) / sum_i rho_i over V_id [eq. sparse_fusion]
    e_id = sum_i rho_i

The counts of an instance are summed as they come, so only voxels with a dense embedding have to be visited.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from fus3dmaps_core.kernels.protocols import Kernels
from fus3dmaps_core.layers.dense import DenseLayer
from fus3dmaps_core.layers.instances import InstanceLayer


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


def fuse_instances(inputs: FusionInputs, rows: Tensor, sum_bytes: int) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """Fuse instances; what comes out for one does not depend on which others are asked for.

    Args:
        inputs: What is fused.
        rows: (n,) rows of the instances.
        sum_bytes: Bytes of one set of float64 sums, of which kernels hold a few. As many instances as fit into one are
            fused in one pass over the dense rows.

    Yields:
        Rows (m,), their fused embeddings (m, d) float32 and evidence (m,) float64.
    """
    if not len(rows):
        return
    dense, instances = inputs.dense, inputs.instances
    for part in torch.split(rows, max(1, sum_bytes // (8 * instances.pool.dimension))):
        place = torch.full((instances.pool.high_water,), -1, dtype=torch.int32, device=rows.device)
        place.index_copy_(0, part, torch.arange(len(part), dtype=torch.int32, device=rows.device))
        sums, evidence = inputs.kernels.weighted_sums(
            dense.pool, dense.slot_of_row(), dense.weight_of_row(), instances.held(), place, len(part)
        )
        own = instances.pool.read(part)
        scaled = inputs.variance_ratio * instances.observations(part).to(torch.float64)
        evidence += scaled
        sums.addcmul_(own.to(torch.float64), scaled[:, None]).div_(evidence[:, None])
        # Without lambda and dense evidence an instance has nothing to be fused from and keeps its own embedding.
        yield part, torch.where(evidence[:, None] > 0, sums.to(torch.float32), own), evidence
