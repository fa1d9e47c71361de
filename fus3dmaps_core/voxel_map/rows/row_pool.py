"""Pooled storage of embedding rows in blocks of fixed size. It grows without copying and reuses freed rows."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from fus3dmaps_core.voxel_map.rows.columns import Column
from fus3dmaps_core.voxel_map.rows.number_pool import NumberPool
from fus3dmaps_core.voxel_map.rows.rounding import to_half, to_int8

_BLOCK_ROWS = {"cpu": 1024, "cuda": 32768}  # A CPU visits blocks in cache-sized steps, a GPU wants few launches.
_MOVED_ROWS = 1024
_LEAST_ADDRESSES = 16


def shortened(column: Column, count: int, fill: int | float) -> Column:
    """Copy the first ``count`` rows of a column of one value a row into a new column that is no longer than needed."""
    kept = column[:count]
    short = Column(kept.dtype, fill, kept.device)
    short.reserve(count)
    short[:count] = kept
    return short


class RowPool:
    """Rows of d values under integer row numbers, stored as float32, float16 or int8 and handed out as float32.

    Attributes:
        dimension: Values d of a row.
        dtype: Storage type.
        block_rows: Rows of a block, a power of two.
        blocks: The blocks, (block_rows, d) each; row r is row r % block_rows of block r // block_rows.
        addresses: Address of each block's first value, for compiled kernels.
        scales: Step of each row's values; written for int8 only.
    """

    def __init__(self, dimension: int, dtype: torch.dtype, device: torch.device) -> None:
        """Start empty."""
        self.dimension = dimension
        self.dtype = dtype
        self.block_rows = _BLOCK_ROWS.get(device.type, _BLOCK_ROWS["cpu"])
        self.blocks: list[Tensor] = []
        self.addresses: NDArray[np.int64] = np.zeros(0, np.int64)
        self.scales = Column(torch.float32, 0.0, device)
        self._device = device
        self._numbers = NumberPool("embeddings", device)

    def __len__(self) -> int:
        """Return the number of rows in use."""
        return len(self._numbers)

    @property
    def high_water(self) -> int:
        """One more than the largest row number ever handed out."""
        return self._numbers.high_water

    @property
    def spare_blocks(self) -> int:
        """Blocks that could be given back if the rows in use were moved together."""
        return len(self.blocks) - -(-len(self) // self.block_rows)

    @property
    def nbytes(self) -> int:
        """Allocated bytes."""
        values = sum(block.numel() * block.element_size() for block in self.blocks)
        return values + self.addresses.nbytes + self.scales.nbytes + self._numbers.nbytes

    @property
    def block_nbytes(self) -> int:
        """Most bytes that one more block takes, with columns that have just doubled."""
        columns = 2 * (self._numbers.row_nbytes + (self.scales.row_nbytes if self.dtype == torch.int8 else 0))
        return self.block_rows * (self._values_nbytes + columns) + _LEAST_ADDRESSES * self.addresses.itemsize

    def high_water_after(self, count: int) -> int:
        """Return the ``high_water`` that there is once ``count`` more rows are in use."""
        return self._numbers.high_water_after(count)

    def nbytes_after(self, count: int) -> int:
        """Return the most bytes that are allocated once ``count`` more rows are in use, or were and are free again."""
        rows = self.high_water_after(count)
        blocks = max(len(self.blocks), -(-rows // self.block_rows))
        addresses = len(self.addresses) if blocks <= len(self.addresses) else max(_LEAST_ADDRESSES, 2 * blocks)
        scales = self.scales.nbytes_after(rows) if self.dtype == torch.int8 else self.scales.nbytes
        values = blocks * self.block_rows * self._values_nbytes
        return values + addresses * self.addresses.itemsize + scales + self._numbers.nbytes_after(count)

    @property
    def _values_nbytes(self) -> int:
        return self.dimension * self.dtype.itemsize

    def check_room(self, count: int) -> None:
        """Raise MapError if 32-bit row numbers cannot tell ``count`` more rows apart."""
        self._numbers.check_room(count)

    def allocate(self, count: int) -> Tensor:
        """Hand out ``count`` rows, freed ones first: (count,) int64 row numbers. Their content is undefined."""
        rows = self._numbers.take(count)
        while self.high_water > len(self.blocks) * self.block_rows:
            block = torch.empty((self.block_rows, self.dimension), dtype=self.dtype, device=self._device)
            if len(self.blocks) == len(self.addresses):
                self.addresses = np.concatenate(
                    [self.addresses, np.zeros(max(_LEAST_ADDRESSES, len(self.blocks)), np.int64)]
                )
            self.addresses[len(self.blocks)] = block.data_ptr()
            self.blocks.append(block)
        if self.dtype == torch.int8:
            self.scales.reserve(self.high_water)
        return rows

    def free(self, rows: Tensor) -> None:
        """Take rows back; each must be in use and appear once."""
        self._numbers.give_back(rows)

    def move(self, sources: Tensor, targets: Tensor) -> None:
        """Copy the values of rows to other rows as they are stored: two (n,) int64 without a row in common."""
        for some, places in zip(torch.split(sources, _MOVED_ROWS), torch.split(targets, _MOVED_ROWS), strict=True):
            self.write_stored(places, *self.read_stored(some))

    def truncate(self, count: int) -> None:
        """Declare rows 0 .. count - 1 in use and no others, and free the blocks and columns beyond them."""
        self._numbers = NumberPool("embeddings", self._device)
        self._numbers.take(count)
        del self.blocks[-(-count // self.block_rows) :]
        self.addresses[len(self.blocks) :] = 0
        if self.dtype == torch.int8:
            self.scales = shortened(self.scales, count, 0.0)

    def read(self, rows: Tensor) -> Tensor:
        """Return the values of the rows: (n, d) float32."""
        stored, scales = self.read_stored(rows)
        values = stored.to(torch.float32)
        return values.mul_(scales[:, None]) if self.dtype == torch.int8 else values

    def read_stored(self, rows: Tensor) -> tuple[Tensor, Tensor]:
        """Return the values as they are stored, (n, d), and for int8 the rows' scales, (n,) float32."""
        stored = torch.empty((len(rows), self.dimension), dtype=self.dtype, device=self._device)
        for block, where in self._by_block(rows):
            within = rows.index_select(0, where) - block * self.block_rows
            stored.index_copy_(0, where, self.blocks[block].index_select(0, within))
        return stored, self.scales[rows] if self.dtype == torch.int8 else self.scales[:0]

    def write(self, rows: Tensor, values: Tensor, seeds: Tensor | None = None, scales: Tensor | None = None) -> None:
        """Overwrite the rows with (n, d) float32 values; a row must not appear twice.

        Args:
            rows: (n,) int64.
            values: (n, d) float32.
            seeds: (n,) seeds of rounding; they may be left out where rows are float32.
            scales: (n,) float32 scales of int8 rows that should be kept if they fit, 0 for none.
        """
        if self.dtype == torch.float32:
            self.write_stored(rows, values)
        elif seeds is None:
            raise ValueError("rows of low precision are rounded by seeds")
        elif self.dtype == torch.float16:
            self.write_stored(rows, to_half(values, seeds))
        else:
            self.write_stored(rows, *to_int8(values, torch.zeros_like(values[:, 0]) if scales is None else scales, seeds))

    def write_stored(self, rows: Tensor, stored: Tensor, scales: Tensor | None = None) -> None:
        """Overwrite the rows with values of the storage type, (n, d), and for int8 their scales, (n,) float32."""
        for block, where in self._by_block(rows):
            within = rows.index_select(0, where) - block * self.block_rows
            self.blocks[block].index_copy_(0, within, stored.index_select(0, where))
        if scales is not None and self.dtype == torch.int8:
            self.scales[rows] = scales

    def _by_block(self, rows: Tensor) -> Iterator[tuple[int, Tensor]]:
        blocks, order = torch.sort(torch.div(rows, self.block_rows, rounding_mode="floor"), stable=True)
        touched, counts = torch.unique_consecutive(blocks, return_counts=True)
        end = 0
        for block, count in zip(touched.tolist(), counts.tolist(), strict=True):
            start, end = end, end + count
            yield block, order[start:end]
