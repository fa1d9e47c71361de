"""A growing column of values, one row per slot, voxel or instance."""

from __future__ import annotations

import torch
from torch import Tensor

_LEAST_ROWS = 1024


class Column:
    """A tensor that grows by doubling. Rows that were never written hold the fill value."""

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
        length = max(rows, 2 * capacity, _LEAST_ROWS)
        grown = torch.full((length, *self._trailing), self._fill, dtype=self._data.dtype, device=self._data.device)
        grown[:capacity] = self._data
        self._data = grown

    # Not by torch's advanced indexing: it shares even small work among threads, and on a machine whose cores are all busy
    # each such call waits a time slice for them.

    def __getitem__(self, rows: Tensor | slice) -> Tensor:
        """Return the values of the rows: a copy for (n,) int64, a view for a slice."""
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
    def row_nbytes(self) -> int:
        """Bytes of one row."""
        return self._data.element_size() * (self._trailing[0] if self._trailing else 1)

    @property
    def nbytes(self) -> int:
        """Allocated bytes."""
        return len(self._data) * self.row_nbytes

    def nbytes_after(self, rows: int) -> int:
        """Return the most bytes that are allocated once ``rows`` rows are reserved, in however many steps."""
        capacity = len(self._data)
        if rows > capacity:
            doubled = max(2 * capacity, _LEAST_ROWS)
            # A first step that doubles may be followed by a second one that does so again.
            capacity = doubled if rows <= doubled else 2 * rows
        return capacity * self.row_nbytes
