"""The voxel hash: packed voxel keys to stable slots, in batches.

Keys are kept in an open-addressing table with linear probing. A voxel's slot never changes while the voxel is in the map, so
every other property of it is a column indexed by slot; slots of removed voxels are given to new ones.
"""

from __future__ import annotations

import torch
from torch import Tensor

from fus3dmaps_core.voxel_map.kernels.keys import unpack
from fus3dmaps_core.voxel_map.kernels.protocols import EMPTY, HashTable, Kernels
from fus3dmaps_core.voxel_map.rows.columns import Column
from fus3dmaps_core.voxel_map.rows.number_pool import NumberPool

_MAX_LOAD = 0.5  # Linear probing stays at one or two probes up to here; deleted cells count.


class VoxelHash:
    """Finds, inserts and removes batches of keys."""

    def __init__(self, kernels: Kernels, device: torch.device) -> None:
        """Start empty on the given device."""
        self._kernels = kernels
        self._device = device
        self._keys = Column(torch.int64, EMPTY, device)
        self._slots = NumberPool("voxels", device)
        self._table = self._new_table(1024)
        self._used_cells = 0

    def __len__(self) -> int:
        """Return the number of voxels."""
        return len(self._slots)

    @property
    def high_water(self) -> int:
        """One more than the largest slot ever handed out."""
        return self._slots.high_water

    def keys(self, slots: Tensor | slice) -> Tensor:
        """Return the keys of the slots, EMPTY where a slot has no voxel."""
        return self._keys[slots]

    def live(self) -> Tensor:
        """Return the slots of all voxels, ascending: (n,) int64."""
        return torch.nonzero(self._keys[: self.high_water] != EMPTY).squeeze(1)

    def coordinates(self, slots: Tensor | slice) -> Tensor:
        """Return the voxel coordinates of slots that have a voxel: (n, 3) int64."""
        return unpack(self.keys(slots))

    def find(self, keys: Tensor) -> Tensor:
        """Look up the slots of the keys, -1 where a key is not in the map: (n,) int64."""
        return self._kernels.find(self._table, keys)

    def find_or_insert(self, keys: Tensor) -> Tensor:
        """Look up the slots of distinct keys. Missing keys get free slots, those given up last first, then new ones.

        Args:
            keys: (n,) int64 packed keys without repetition.

        Returns:
            (n,) int64 slots.

        Raises:
            MapError: There would be more voxels than 32-bit slots can tell apart; nothing was inserted.
        """
        slots = self.find(keys)
        missing = slots < 0
        fresh = keys.masked_select(missing)
        if not len(fresh):
            return slots
        given = self._slots.take(len(fresh))
        self._keys.reserve(self.high_water)
        slots.masked_scatter_(missing, given)
        self._keys[given] = fresh
        if self._used_cells + len(fresh) > _MAX_LOAD * len(self._table.keys):
            self._rebuild()
        else:
            self._kernels.place(self._table, fresh, given)
            self._used_cells += len(fresh)
        return slots

    def remove(self, slots: Tensor) -> None:
        """Forget the voxels of distinct slots; the slots will be given to others."""
        self._kernels.mark_deleted(self._table, self._keys[slots])
        self._keys[slots] = EMPTY
        self._slots.give_back(slots)

    @property
    def nbytes(self) -> int:
        """Allocated bytes."""
        return self._keys.nbytes + self._slots.nbytes + len(self._table.keys) * self._cell_nbytes

    def high_water_after(self, count: int) -> int:
        """Return the ``high_water`` that there is once the map has ``count`` more voxels."""
        return self._slots.high_water_after(count)

    def nbytes_after(self, count: int) -> int:
        """Return the most bytes that are allocated once the map has ``count`` more voxels."""
        cells = len(self._table.keys)
        if self._used_cells + count > _MAX_LOAD * cells:
            cells = self._cells_for(len(self) + count)
        return self._keys.nbytes_after(self.high_water_after(count)) + self._slots.nbytes + cells * self._cell_nbytes

    @property
    def _cell_nbytes(self) -> int:
        return self._table.keys.element_size() + self._table.slots.element_size()

    def _cells_for(self, voxels: int) -> int:
        """Return the cells of a new table: as many as now, or more by a power of two."""
        cells = len(self._table.keys)
        # Half of the allowed load stays free, so that the next rebuilding is as many insertions away.
        while voxels > 0.5 * _MAX_LOAD * cells:
            cells *= 2
        return cells

    def _new_table(self, cells: int) -> HashTable:
        return HashTable(
            torch.full((cells,), EMPTY, dtype=torch.int64, device=self._device),
            torch.full((cells,), -1, dtype=torch.int32, device=self._device),
        )

    def _rebuild(self) -> None:
        """Make a table of all keys: a larger one, or as large as before where deleted cells had filled it."""
        self._table = self._new_table(self._cells_for(len(self)))
        slots = self.live()
        self._kernels.place(self._table, self._keys[slots], slots)
        self._used_cells = len(slots)
