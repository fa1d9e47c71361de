"""Cosine similarities of text embeddings with each layer, block by block so that memory stays bounded."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import normalize

from fus3dmaps_core.layers.dense import DenseLayer
from fus3dmaps_core.layers.fusion import fuse_voxels
from fus3dmaps_core.layers.instances import InstanceLayer


def dense_similarity(dense: DenseLayer, texts: Tensor) -> tuple[Tensor, Tensor]:
    """Similarities of the dense layer: slots (n,) int64 and cosines (n, p) float32 with texts (p, d) of unit length."""
    parts = [(slots, normalize(means, dim=1) @ texts.T) for slots, _, means in dense.live_blocks()]
    return _ordered(parts, texts)


def instance_similarity(instances: InstanceLayer, embeddings: Tensor, slots: int, texts: Tensor) -> tuple[Tensor, Tensor]:
    """Similarities of an instance layer, per voxel those of its top hypothesis.

    Args:
        instances: The layer.
        embeddings: (i, d) float32, one per instance alive in the order of ``instances.ids()``: raw or fused.
        slots: Number of slots of the map.
        texts: (p, d) unit vectors.

    Returns:
        As :func:`dense_similarity`.
    """
    cosines = normalize(embeddings, dim=1) @ texts.T
    top, _ = instances.top(slice(0, slots))
    held = torch.nonzero(top >= 0).squeeze(1)
    return held, cosines[_place(instances)[top[held]]]


def fused_dense_similarity(
    dense: DenseLayer, instances: InstanceLayer, slots: int, variance_ratio: float, texts: Tensor
) -> tuple[Tensor, Tensor]:
    """Similarities of the fused dense layer, which covers every voxel that has either layer.

    Returns:
        As :func:`dense_similarity`.
    """
    own = instances.embeddings(instances.ids())
    place = _place(instances)
    parts = []
    for held, weights, means in dense.live_blocks():
        top, counts = instances.top(held)
        with_instance = top >= 0
        embeddings = torch.zeros_like(means)
        embeddings[with_instance] = own[place[top[with_instance]]]
        fused = fuse_voxels(weights, means, counts, embeddings, variance_ratio)
        parts.append((held, normalize(fused, dim=1) @ texts.T))
    without_dense = torch.nonzero(dense.rows(slice(0, slots)) < 0).squeeze(1)
    top, _ = instances.top(without_dense)
    held = top >= 0
    parts.append((without_dense[held], (normalize(own, dim=1) @ texts.T)[place[top[held]]]))
    return _ordered(parts, texts)


def _place(instances: InstanceLayer) -> Tensor:
    """Row of each id among the instances alive, -1 elsewhere."""
    ids = instances.ids()
    place = torch.full((instances.next_id,), -1, dtype=torch.int64, device=ids.device)
    place[ids] = torch.arange(len(ids), device=ids.device)
    return place


def _ordered(parts: list[tuple[Tensor, Tensor]], texts: Tensor) -> tuple[Tensor, Tensor]:
    if not parts:
        return torch.zeros(0, dtype=torch.int64, device=texts.device), texts.new_zeros((0, len(texts)))
    slots, order = torch.sort(torch.cat([part[0] for part in parts]))
    return slots, torch.cat([part[1] for part in parts])[order]
