"""A growing column of values, one row per slot, voxel or instance."""

from __future__ import annotations

import torch
from torch import Tensor


class Column:
    """A tensor that grows by doubling; rows beyond those ever written hold the fill value."""

    def __init__(self, dtype: torch.dtype, fill: int | float, device: torch.device, width: int | None = None) -> None:
        """Start empty; ``width`` gives every row that many values instead of one."""
        self._fill = fill
        self._trailing = () if width is None else (width,)
        self._data = torch.full((0, *self._trailing), fill, dtype=dtype, device=device)

    def reserve(self, rows: int) -> None:
        """Make rows 0 .. rows - 1 addressable."""
        capacity = len(self._data)
        if rows <= capacity:
            return
        grown = torch.full(
            (max(rows, 2 * capacity, 1024), *self._trailing), self._fill, dtype=self._data.dtype, device=self._data.device
        )
        grown[:capacity] = self._data
        self._data = grown

    # Not by torch's advanced indexing: it shares even small work among threads, and on a machine whose cores are all busy
    # each such call waits a time slice for them.

    def __getitem__(self, rows: Tensor | slice) -> Tensor:
        """Values of the rows, a copy for (n,) int64 and no copy for a slice."""
        return self._data[rows] if isinstance(rows, slice) else self._data.index_select(0, rows)

    def __setitem__(self, rows: Tensor | slice, values: Tensor | int | float) -> None:
        """Write the rows, which must be reserved."""
        if isinstance(rows, slice):
            self._data[rows] = values
        elif isinstance(values, Tensor):
            self._data.index_copy_(0, rows, values)
        else:
            self._data.index_fill_(0, rows, values)

    @property
    def nbytes(self) -> int:
        """Allocated bytes."""
        return self._data.numel() * self._data.element_size()
