"""Cross-layer fusion, stateless [sec: 3D Cross-Layer Semantic Fusion].

With lambda = R^D / R^I and rho_i = w_i^D + lambda count[i, id]:

- instances [eq. sparse_fusion]: f_fused,id = sum_i (w_i^D f_i^D + lambda count[i, id] f_id) / sum_i rho_i over V_id, and the
  evidence e_id = sum_i rho_i. The counts of an instance are summed as they come, so only voxels with a dense embedding
  have to be visited.
- dense: f_fused,i = (w_i^D f_i^D + lambda c_i f_top(i)) / (w_i^D + lambda c_i).
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import embedding_bag

from fus3dmaps_core.layers.dense import DenseLayer
from fus3dmaps_core.layers.instances import InstanceLayer


def fuse_instances(dense: DenseLayer, instances: InstanceLayer, variance_ratio: float) -> tuple[Tensor, Tensor, Tensor]:
    """Fused embeddings and evidence of every instance alive, in one pass over the dense rows.

    Returns:
        ids (n,) int64 ascending, fused (n, d) float32, evidence (n,) float64.
    """
    ids = instances.ids()
    place = torch.full((instances.next_id,), -1, dtype=torch.int64, device=ids.device)
    place[ids] = torch.arange(len(ids), device=ids.device)
    own = instances.embeddings(ids).to(torch.float64)
    scaled_counts = variance_ratio * instances.observations(ids).to(torch.float64)
    sums = own * scaled_counts[:, None]
    evidence = scaled_counts.clone()
    for slots, weights, means in dense.live_blocks():
        held, _ = instances.hypotheses(slots)
        voxel, column = torch.nonzero(held >= 0, as_tuple=True)
        owners, order = torch.sort(place[held[voxel, column]], stable=True)
        touched, lengths = torch.unique_consecutive(owners, return_counts=True)
        if not len(touched):
            continue
        voxel = voxel[order]
        offsets = torch.cumsum(lengths, 0) - lengths
        sums[touched] += embedding_bag(voxel, means, offsets, mode="sum", per_sample_weights=weights[voxel]).to(
            torch.float64
        )
        evidence[touched] += torch.segment_reduce(weights[voxel].to(torch.float64), "sum", lengths=lengths)
    # Without lambda and dense evidence an instance has nothing to be fused from and keeps its own embedding.
    fused = torch.where(evidence[:, None] > 0, sums / evidence.clamp(min=torch.finfo(torch.float64).tiny)[:, None], own)
    return ids, fused.to(torch.float32), evidence


def fuse_voxels(weights: Tensor, means: Tensor, top_counts: Tensor, top_embeddings: Tensor, variance_ratio: float) -> Tensor:
    """Fused dense embeddings; a voxel with one layer only takes that layer's.

    Args:
        weights: (n,) float32, w^D, 0 without a dense embedding.
        means: (n, d) float32, f^D; ignored where the weight is 0.
        top_counts: (n,) int64, c, 0 without a hypothesis.
        top_embeddings: (n, d) float32, f_top; ignored where the count is 0.
        variance_ratio: lambda.

    Returns:
        (n, d) float32.
    """
    scaled = variance_ratio * top_counts.to(torch.float32)
    total = (weights + scaled)[:, None]
    return means * (weights[:, None] / total) + top_embeddings * (scaled[:, None] / total)
