"""What is published of an instance: the voxels it occupies, their centroid and box."""

from __future__ import annotations

import numpy as np

from reference.semantic_map import ReferenceMap
from reference.vectors import Key, Vector, center_of


def occupied_voxels(reference: ReferenceMap, instance_id: int) -> set[Key]:
    """Voxels whose top hypothesis the instance is."""
    return {key for key in reference.voxels_of(instance_id) if reference.top_of(key) == instance_id}


def centroid_m(reference: ReferenceMap, instance_id: int) -> Vector | None:
    """Mean of the centres of the occupied voxels, each weighted by its count."""
    total, weight = np.zeros(3), 0
    for key in occupied_voxels(reference, instance_id):
        count = reference.hypotheses[key][instance_id]
        total += count * center_of(key, reference.voxel_size_m)
        weight += count
    return total / weight if weight else None


def box_m(reference: ReferenceMap, instance_id: int) -> tuple[Vector, Vector] | None:
    """Smallest and largest corner of the occupied voxels."""
    keys = occupied_voxels(reference, instance_id)
    if not keys:
        return None
    lowest = np.array([min(key[axis] for key in keys) for axis in range(3)], dtype=np.float64)
    highest = np.array([max(key[axis] for key in keys) + 1 for axis in range(3)], dtype=np.float64)
    return lowest * reference.voxel_size_m, highest * reference.voxel_size_m
