"""The layers that can be queried, in the form in which kernels compare them with texts."""

from __future__ import annotations

import torch
from torch import Tensor

from fus3dmaps_core.voxel_map.kernels.protocols import EmbeddedLayer, InheritedLayer, Texts
from fus3dmaps_core.voxel_map.kernels.scores import scores_of
from fus3dmaps_core.voxel_map.layers.fused_instances import FusedInstances
from fus3dmaps_core.voxel_map.layers.fusion import FusionInputs

LAYERS = ("dense", "fused_dense", "instances", "fused_instances")
"""Names of the layers that can be queried."""

_BLOCK_COSINES = 2**18  # Cosines of instances that are computed together: a megabyte.


def layer_named(name: str, inputs: FusionInputs, fused: FusedInstances, texts: Texts) -> EmbeddedLayer | InheritedLayer:
    """Put together a layer and the texts that it is compared with.

    Dense: the voxels that have an embedding. Fused dense: those that have either layer,
    f_fused,i = (w_i^D f_i^D + lambda c_i f_top(i)) / (w_i^D + lambda c_i), where c_i is the count of the top hypothesis.
    Instances: per voxel the embedding of its top hypothesis, raw or fused.

    Args:
        name: One of LAYERS.
        inputs: The layers of the map.
        fused: Fused embeddings of the instances, which are brought up to date where the layer needs them.
        texts: What the layer is compared with.
    """
    if name in ("dense", "fused_dense"):
        own = inputs.instances.pool if name == "fused_dense" else None
        return EmbeddedLayer(inputs.dense.pool, inputs.dense.weight_of_row(), own, inputs.variance_ratio, texts)
    return InheritedLayer(_instance_scores(inputs, fused if name == "fused_instances" else None, texts))


def _instance_scores(inputs: FusionInputs, fused: FusedInstances | None, texts: Texts) -> Tensor:
    """Score all instances alive, by row: (rows, p) float32; by their own embeddings without ``fused``."""
    instances, kernels = inputs.instances, inputs.kernels
    scores = texts.vectors.new_zeros((instances.pool.high_water, texts.prompts))
    fused_pool = None if fused is None else fused.refreshed(inputs)
    for rows in torch.split(instances.live()[1], max(1, _BLOCK_COSINES // len(texts.vectors))):
        if fused is None or fused_pool is None:
            cosines = kernels.cosines(instances.pool, rows, texts.vectors)
        else:
            cosines = kernels.cosines(fused_pool, rows, texts.vectors)
            raw = ~fused.are_fused(rows)
            if bool(raw.any()):
                cosines[raw] = kernels.cosines(instances.pool, rows[raw], texts.vectors)
        scores.index_copy_(0, rows, scores_of(cosines, texts))
    return scores
