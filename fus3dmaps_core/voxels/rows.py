"""Pooled storage of embedding rows in blocks of fixed size: it grows without copying and reuses what is freed."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

from fus3dmaps_core.voxels.columns import Column

BLOCK_ROWS = 4096


class RowPool:
    """Rows of d values under integer row numbers, stored in ``dtype`` and handed out as float32."""

    def __init__(self, dimension: int, dtype: torch.dtype, device: torch.device) -> None:
        """Start empty."""
        self._dimension = dimension
        self._dtype = dtype
        self._device = device
        self._blocks: list[Tensor] = []
        self._high = 0
        self._free = Column(torch.int64, -1, device)
        self._free_count = 0

    def __len__(self) -> int:
        """Number of rows in use."""
        return self._high - self._free_count

    @property
    def high_water(self) -> int:
        """One more than the largest row number ever handed out."""
        return self._high

    @property
    def nbytes(self) -> int:
        """Allocated bytes."""
        return sum(block.numel() * block.element_size() for block in self._blocks) + self._free.nbytes

    def allocate(self, count: int) -> Tensor:
        """Row numbers for ``count`` new rows, freed ones first: (count,) int64. Their content is undefined."""
        reused = min(count, self._free_count)
        rows = torch.empty(count, dtype=torch.int64, device=self._device)
        rows[:reused] = self._free[self._free_count - reused : self._free_count]
        self._free_count -= reused
        rows[reused:] = torch.arange(self._high, self._high + count - reused, device=self._device)
        self._high += count - reused
        while self._high > len(self._blocks) * BLOCK_ROWS:
            self._blocks.append(torch.empty((BLOCK_ROWS, self._dimension), dtype=self._dtype, device=self._device))
        return rows

    def free(self, rows: Tensor) -> None:
        """Give rows back; each must be in use and appear once."""
        self._free.reserve(self._free_count + len(rows))
        self._free[self._free_count : self._free_count + len(rows)] = rows
        self._free_count += len(rows)

    def read(self, rows: Tensor) -> Tensor:
        """Values of the rows: (n, d) float32."""
        values = torch.empty((len(rows), self._dimension), dtype=torch.float32, device=self._device)
        for block, where in self._by_block(rows):
            values[where] = self._blocks[block][rows[where] - block * BLOCK_ROWS].to(torch.float32)
        return values

    def write(self, rows: Tensor, values: Tensor) -> None:
        """Overwrite the rows with (n, d) values; a row must not appear twice."""
        for block, where in self._by_block(rows):
            self._blocks[block][rows[where] - block * BLOCK_ROWS] = values[where].to(self._dtype)

    def blocks(self) -> Iterator[tuple[int, Tensor]]:
        """First row number and stored values of each block, up to the high-water mark; free rows are among them."""
        for index, block in enumerate(self._blocks):
            first = index * BLOCK_ROWS
            if first < self._high:
                yield first, block[: self._high - first]

    def _by_block(self, rows: Tensor) -> Iterator[tuple[int, Tensor]]:
        blocks, order = torch.sort(torch.div(rows, BLOCK_ROWS, rounding_mode="floor"), stable=True)
        touched, counts = torch.unique_consecutive(blocks, return_counts=True)
        end = 0
        for block, count in zip(touched.tolist(), counts.tolist(), strict=True):
            start, end = end, end + count
            yield block, order[start:end]
