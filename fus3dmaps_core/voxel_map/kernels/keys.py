"""Packed voxel keys: three signed coordinates in one 63-bit integer, 21 bits an axis (52 km either way at 5 cm)."""

from __future__ import annotations

import torch
from torch import Tensor

BITS = 21
HALF = 1 << (BITS - 1)
MULTIPLIER = -7046029254386353131
"""2^64 / golden ratio as a signed 64-bit integer (Fibonacci hashing)."""

MAX_COORDINATE = HALF - 1
"""Largest voxel coordinate of either sign."""


def pack(coordinates: Tensor) -> Tensor:
    """Pack (n, 3) integer voxel coordinates within +-MAX_COORDINATE into keys: (n,) int64, not negative."""
    x, y, z = (coordinates.to(torch.int64) + HALF).unbind(1)
    return (x << (2 * BITS)) | (y << BITS) | z


def unpack(keys: Tensor) -> Tensor:
    """Unpack keys into voxel coordinates: (n, 3) int64."""
    mask = (1 << BITS) - 1
    return torch.stack([(keys >> (2 * BITS)) & mask, (keys >> BITS) & mask, keys & mask], dim=1) - HALF


def home(keys: Tensor, cells: int) -> Tensor:
    """Find the cell at which probing for each key begins, in a table of a power of two cells."""
    return ((keys * MULTIPLIER) >> (65 - cells.bit_length())) & (cells - 1)
