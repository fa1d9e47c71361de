"""Rounding of running means to few bits, so that they neither drift nor freeze.

A running mean moves by (x - f) a / w. Rounded to the nearest value, it stops moving once that is less than half a step,
which in half precision happens after some hundred observations. Here a value is rounded up with the probability of its
fraction, by bits that are a function of the voxel, its weight and the column: the expectation of the stored mean is then the
true mean, and the same input gives the same map. Values that do not change are on the grid already and stay as they are, so
the error does not add up over updates: it settles where the steps of the grid and the spread of the observations leave it.

An int8 row has a scale, one step of its values. A new scale would round every value anew, so a row keeps its scale as long
as its largest value fits and uses a fair part of the range.
"""

from __future__ import annotations

import torch
from torch import Tensor

KEEP_SCALE_BELOW, KEEP_SCALE_ABOVE, FRESH_SCALE_STEPS = 127.0, 40.0, 112.0
"""An int8 row keeps its scale while its largest value is between 40 and 127 steps; a fresh scale makes it 112."""

TINY = 1e-30
"""Scale times 112 of a row of zeros."""

_WORD = 0xFFFFFFFF


def seeds_of(keys: Tensor, weights: Tensor) -> Tensor:
    """Return a seed for each voxel and state: (n,) int64 of 32 bits from its key and the bits of its float32 weight."""
    place = _mix((keys ^ (keys >> 32)) & _WORD)  # Mixed first, or neighbours' weights would meet in the same seed.
    return _mix((place + weights.view(torch.int32).to(torch.int64)) & _WORD)


def dither(seeds: Tensor, width: int) -> Tensor:
    """Return random bits: (n, width) int64 of 32 bits."""
    columns = torch.arange(width, dtype=torch.int64, device=seeds.device) * 0x9E3779B9
    return _mix((seeds[:, None] + columns) & _WORD)


def to_half(values: Tensor, seeds: Tensor) -> Tensor:
    """Convert float32 values of at most 1 to halves, (n, d) float16, each rounded up with the probability of its fraction.

    Below 2^-14, where halves are 2^-24 apart, they are rounded to the nearest.
    """
    bits = values.view(torch.int32) + (dither(seeds, values.shape[1]) & 0x1FFF).to(torch.int32)
    return (bits & ~0x1FFF).view(torch.float32).to(torch.float16)


def to_int8(values: Tensor, scales: Tensor, seeds: Tensor) -> tuple[Tensor, Tensor]:
    """Convert float32 values to steps of a scale per row.

    Args:
        values: (n, d) float32.
        scales: (n,) float32 scales that the rows have, 0 for a new row.
        seeds: (n,) as :func:`seeds_of` gives them.

    Returns:
        Steps (n, d) int8 in [-127, 127] and scales (n,) float32.
    """
    largest = values.abs().amax(dim=1).clamp(min=TINY)
    fits = (largest <= KEEP_SCALE_BELOW * scales) & (largest >= KEEP_SCALE_ABOVE * scales)
    scales = torch.where(fits, scales, largest / FRESH_SCALE_STEPS)
    chance = ((dither(seeds, values.shape[1]) >> 20).to(torch.float32) + 0.5) * 2.0**-12
    steps = torch.floor(values * (1.0 / scales)[:, None] + chance)
    return steps.clamp(-127, 127).to(torch.int8), scales


def _mix(bits: Tensor) -> Tensor:
    """Hash 32-bit words in int64."""
    bits = bits ^ (bits >> 16)
    bits = (bits * 0x7FEB352D) & _WORD
    bits = bits ^ (bits >> 15)
    bits = (bits * 0x846CA68B) & _WORD
    return bits ^ (bits >> 16)
