"""The voxel hash: integer voxel coordinates to stable slots, in batches.

Coordinates are packed into one 63-bit key, 21 signed bits an axis (52 km either way at 5 cm), and kept in an
open-addressing table with linear probing. Slots are dense numbers in the order of insertion and never move, so every
other property of a voxel is a column indexed by slot.
"""

from __future__ import annotations

import torch
from torch import Tensor

from fus3dmaps_core.errors import MapError
from fus3dmaps_core.voxels.columns import Column

_BITS = 21
_HALF = 1 << (_BITS - 1)
_EMPTY = -1
_MULTIPLIER = -7046029254386353131  # 2^64 / golden ratio as a signed 64-bit integer (Fibonacci hashing)
_MAX_LOAD = 0.5  # Linear probing stays at one or two probes up to here.

MAX_COORDINATE = _HALF - 1
"""Largest voxel coordinate of either sign."""


def pack(coordinates: Tensor) -> Tensor:
    """Keys of (n, 3) integer voxel coordinates: (n,) int64, not negative.

    Raises:
        MapError: A coordinate is beyond +-MAX_COORDINATE.
    """
    if coordinates.numel() and int(coordinates.abs().max()) > MAX_COORDINATE:
        raise MapError(f"voxel coordinate {int(coordinates.abs().max())} is beyond the map's range of +-{MAX_COORDINATE}")
    x, y, z = (coordinates.to(torch.int64) + _HALF).unbind(1)
    return (x << (2 * _BITS)) | (y << _BITS) | z


def unpack(keys: Tensor) -> Tensor:
    """Voxel coordinates of keys: (n, 3) int64."""
    mask = (1 << _BITS) - 1
    return torch.stack([(keys >> (2 * _BITS)) & mask, (keys >> _BITS) & mask, keys & mask], dim=1) - _HALF


class VoxelHash:
    """Finds or inserts batches of keys; a key keeps its slot for the life of the map."""

    def __init__(self, device: torch.device) -> None:
        """Start empty on the given device."""
        self._device = device
        self._count = 0
        self._keys = Column(torch.int64, _EMPTY, device)
        self._allocate_table(1024)

    def __len__(self) -> int:
        """Number of voxels, which is also the next slot."""
        return self._count

    def keys(self, slots: Tensor | slice | None = None) -> Tensor:
        """Keys of the slots, or of all slots in order."""
        return self._keys[slice(0, self._count) if slots is None else slots]

    def coordinates(self, slots: Tensor | slice | None = None) -> Tensor:
        """Voxel coordinates of the slots, or of all slots in order: (n, 3) int64."""
        return unpack(self.keys(slots))

    def find(self, keys: Tensor) -> Tensor:
        """Slots of the keys, -1 where a key is not in the map: (n,) int64."""
        slots = torch.full_like(keys, -1)
        rows = torch.arange(len(keys), device=self._device)
        cells = self._home(keys)
        while len(rows):
            found = self._table_keys[cells]
            hit = found == keys[rows]
            slots[rows[hit]] = self._table_slots[cells[hit]].to(torch.int64)
            onward = ~hit & (found != _EMPTY)
            rows, cells = rows[onward], (cells[onward] + 1) & self._mask
        return slots

    def find_or_insert(self, keys: Tensor) -> Tensor:
        """Slots of distinct keys; missing ones get the next slots in the order given.

        Args:
            keys: (n,) int64 packed keys without repetition.

        Returns:
            (n,) int64 slots.
        """
        slots = self.find(keys)
        missing = slots < 0
        fresh = keys[missing]
        if len(fresh):
            first, self._count = self._count, self._count + len(fresh)
            slots[missing] = torch.arange(first, self._count, device=self._device)
            self._keys.reserve(self._count)
            self._keys[first : self._count] = fresh
            if self._count > _MAX_LOAD * (self._mask + 1):
                capacity = self._mask + 1
                while self._count > _MAX_LOAD * capacity:
                    capacity *= 2
                self._allocate_table(capacity)
                self._place(self.keys(), torch.arange(self._count, device=self._device))
            else:
                self._place(fresh, slots[missing])
        return slots

    @property
    def nbytes(self) -> int:
        """Allocated bytes."""
        tables = (self._table_keys, self._table_slots)
        return self._keys.nbytes + sum(table.numel() * table.element_size() for table in tables)

    def _allocate_table(self, capacity: int) -> None:
        self._mask = capacity - 1
        self._shift = 64 - capacity.bit_length() + 1
        self._table_keys = torch.full((capacity,), _EMPTY, dtype=torch.int64, device=self._device)
        self._table_slots = torch.full((capacity,), -1, dtype=torch.int32, device=self._device)

    def _home(self, keys: Tensor) -> Tensor:
        return ((keys * _MULTIPLIER) >> self._shift) & self._mask

    def _place(self, keys: Tensor, slots: Tensor) -> None:
        """Put keys that are not in the table into it."""
        cells = self._home(keys)
        while len(keys):
            free = self._table_keys[cells] == _EMPTY
            # Several keys may claim one cell: one write survives, whose key reads back; the others probe on.
            self._table_keys[cells[free]] = keys[free]
            won = free & (self._table_keys[cells] == keys)
            self._table_slots[cells[won]] = slots[won].to(torch.int32)
            keys, slots, cells = keys[~won], slots[~won], (cells[~won] + 1) & self._mask
