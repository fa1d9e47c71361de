"""Hypotheses as kernels hold them, from dictionaries."""

from __future__ import annotations

from collections import Counter

import numpy as np
import torch

from fus3dmaps_core.voxel_map.kernels.protocols import Hypotheses


def columns(held: list[dict[int, int]], places: int, id_of_row: list[int], device: torch.device, rng) -> Hypotheses:
    """Columns of voxels that hold rows with counts, each voxel's in any order."""
    rows, counts = np.full((len(held), places), -1, np.int32), np.zeros((len(held), places), np.int32)
    for slot, of_voxel in enumerate(held):
        order = rng.permutation(places)[: len(of_voxel)]
        rows[slot, order], counts[slot, order] = list(of_voxel), list(of_voxel.values())
    flat = [(row, count) for of_voxel in held for row, count in of_voxel.items()]
    voxels = Counter(row for row, _ in flat)
    observations = [sum(count for row, count in flat if row == each) for each in range(len(id_of_row))]
    arrays = (
        rows,
        counts,
        np.array(id_of_row, np.int64),
        np.array([voxels[each] for each in range(len(id_of_row))], np.int32),
        np.array(observations, np.int64),
        np.zeros(len(id_of_row), bool),
    )
    return Hypotheses(*(torch.tensor(each, device=device) for each in arrays))
