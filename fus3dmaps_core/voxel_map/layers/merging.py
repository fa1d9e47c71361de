"""Merging of instances that have grown into one another.

Association compares a proposal with one instance at a time, so an object that was first seen in parts stays several
instances, which end up in each other's voxels. This is the rule by which they become one.

Two instances are looked at if a voxel of the keyframe's proposals holds both: only there can they have come to share more
than before. Of ids a < b, b is merged into a if

    |V_a n V_b| / min(|V_a|, |V_b|) >= overlap    and    cos(f_a, f_b) >= cosine

and then f_a = (w_a f_a + w_b f_b) / (w_a + w_b), w_a += w_b, and counts are added. It goes by passes until one finds
nothing: a pass finds all such pairs and takes them by (a, b), if a has not been merged into another in this pass and b
neither into another nor with others. So one may take in several at once, but chains take a pass for each link.

What is shared within the keyframe's voxels and the sizes of the instances bound what they can share at all. Only if there
are pairs that could share enough and are alike are the hypotheses of the whole map visited, once: all passes need no other
voxels than those of the instances that the keyframe's voxels hold.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import normalize

from fus3dmaps_core.voxel_map.kernels.protocols import Kernels
from fus3dmaps_core.voxel_map.layers.fused_instances import FusedInstances
from fus3dmaps_core.voxel_map.layers.instances import InstanceLayer


def merge_overlapping(
    kernels: Kernels, instances: InstanceLayer, fused: FusedInstances, slots: Tensor, overlap: float, cosine: float
) -> list[tuple[int, int]]:
    """Merge the instances that meet in a keyframe and have grown into one another.

    Args:
        kernels: Inner loops.
        instances: Changed: those merged into others are gone and their ids are never given again.
        fused: Changed: of two stored fused embeddings that of more evidence stays, until the next fusion.
        slots: (n,) int64 distinct slots of the keyframe's proposals.
        overlap: Share of the smaller instance's voxels, greater than 0.
        cosine: Of the instances' embeddings.

    Returns:
        Pairs of ids in the order in which they were merged: which is gone, and into which.
    """
    merged: list[tuple[int, int]] = []
    around: Tensor | None = None
    while True:
        first, second = _candidates(kernels, instances, slots, overlap, cosine)
        if around is None:
            held, _ = instances.hypotheses(slots)
            met, _, _ = kernels.distinct(held.masked_select((held >= 0) & (len(first) > 0)))
            around = kernels.holders(instances.held(), met, instances.pool.high_water)
        enough = _share_enough(kernels, instances, around, first, second, overlap)
        gone, into = _one_pass(instances, first.masked_select(enough), second.masked_select(enough))
        merged += zip(instances.ids(gone).tolist(), instances.ids(into).tolist(), strict=True)
        fused.merge(gone, into)
        instances.take_in(gone, into, around)
        if not len(gone):
            return merged


def _candidates(
    kernels: Kernels, instances: InstanceLayer, slots: Tensor, overlap: float, cosine: float
) -> tuple[Tensor, Tensor]:
    """Find the rows of pairs that meet, could share enough and are alike, in any order: two (p,) int64."""
    first, second, most_shared = _meeting(kernels, instances, slots)
    possible = _at_least(most_shared, _smaller(instances, first, second), overlap)
    first, second = first.masked_select(possible), second.masked_select(possible)
    rows, places, _ = kernels.distinct(torch.cat([first, second]))
    vectors = normalize(instances.pool.read(rows).to(torch.float64), dim=1)
    of_first, of_second = vectors.index_select(0, places).chunk(2)
    alike = (of_first * of_second).sum(dim=1) >= cosine
    return first.masked_select(alike), second.masked_select(alike)


def _share_enough(
    kernels: Kernels, instances: InstanceLayer, around: Tensor, first: Tensor, second: Tensor, overlap: float
) -> Tensor:
    """Tell which pairs share enough voxels, all of which are among the given slots: (p,) bool."""
    rows, places, _ = kernels.distinct(torch.cat([first, second]))
    shared = kernels.shared_voxels(instances.held().index_select(0, around), rows, instances.pool.high_water)
    pairs = places[: len(first)] * len(rows) + places[len(first) :]
    return _at_least(shared.flatten().index_select(0, pairs), _smaller(instances, first, second), overlap)


def _smaller(instances: InstanceLayer, first: Tensor, second: Tensor) -> Tensor:
    """Count the voxels of the smaller instance of each pair: (p,) int64."""
    return torch.minimum(instances.voxels(first), instances.voxels(second))


def _meeting(kernels: Kernels, instances: InstanceLayer, slots: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Find the pairs of rows that one slot holds, and the most voxels that they can share: three (p,) int64."""
    held, _ = instances.hypotheses(slots)
    used = held >= 0
    rows, found, here = kernels.distinct(held.masked_select(used))
    places = torch.full_like(held, -1).masked_scatter_(used, found)
    left, right = torch.triu_indices(held.shape[1], held.shape[1], 1, device=held.device)
    a, b = places.index_select(1, left).flatten(), places.index_select(1, right).flatten()
    both = (a >= 0) & (b >= 0)
    a, b = a.masked_select(both), b.masked_select(both)
    pairs = kernels.count_pairs(torch.minimum(a, b), torch.maximum(a, b), len(rows), len(rows))
    a, b = torch.repeat_interleave(torch.arange(len(rows), device=held.device), pairs.offsets.diff()), pairs.partners
    elsewhere = instances.voxels(rows) - here
    most_shared = pairs.counts + torch.minimum(elsewhere.index_select(0, a), elsewhere.index_select(0, b))
    return rows.index_select(0, a), rows.index_select(0, b), most_shared


def _at_least(shared: Tensor, size: Tensor, overlap: float) -> Tensor:
    """Tell whether a share is large enough; correctly rounded, so that 1/5 is 0.2."""
    return shared.to(torch.float64) / size.to(torch.float64) >= overlap


def _one_pass(instances: InstanceLayer, first: Tensor, second: Tensor) -> tuple[Tensor, Tensor]:
    """Choose the pairs that one pass merges: the row that is gone, and the older one that takes it in; two (n,) int64."""
    ids = torch.stack([instances.ids(first), instances.ids(second)], dim=1).tolist()
    by_id = [
        (min(pair), max(pair), rows if pair[0] > pair[1] else rows[::-1])
        for pair, rows in zip(ids, torch.stack([first, second], dim=1).tolist(), strict=True)
    ]
    merged: list[list[int]] = []
    is_gone: set[int] = set()
    has_grown: set[int] = set()
    for a, b, rows in sorted(by_id):
        if a not in is_gone and b not in is_gone and b not in has_grown:
            is_gone.add(b)
            has_grown.add(a)
            merged.append(rows)
    gone, into = torch.tensor(merged, dtype=torch.int64, device=first.device).view(-1, 2).T.contiguous()
    return gone, into
