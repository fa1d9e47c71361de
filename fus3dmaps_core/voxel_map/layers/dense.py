"""The dense layer M^D: one weight and one mean embedding per voxel [sec: Dense Semantic Voxel Mapping]."""

from __future__ import annotations

import torch
from torch import Tensor

from fus3dmaps_core.voxel_map.kernels.protocols import GroupedCounts, Kernels
from fus3dmaps_core.voxel_map.rows.columns import Column
from fus3dmaps_core.voxel_map.rows.rounding import seeds_of
from fus3dmaps_core.voxel_map.rows.row_pool import RowPool, shortened


class DenseLayer:
    """Weights and mean embeddings in pooled rows. A voxel has a row only while it has dense evidence."""

    def __init__(self, dimension: int, dtype: torch.dtype, kernels: Kernels, device: torch.device) -> None:
        """Start empty; means are stored in ``dtype`` and computed in float32."""
        self._kernels = kernels
        self._device = device
        self.pool = RowPool(dimension, dtype, device)
        self._row_of_slot = Column(torch.int32, -1, device)
        self._slot_of_row = Column(torch.int32, -1, device)
        self._weight_of_row = Column(torch.float32, 0.0, device)

    def __len__(self) -> int:
        """Return the number of voxels with a dense embedding."""
        return len(self.pool)

    def reserve(self, slots: int) -> None:
        """Make slots 0 .. slots - 1 addressable."""
        self._row_of_slot.reserve(slots)

    def rows(self, slots: Tensor | slice) -> Tensor:
        """Look up the row of each slot, -1 where a voxel has no dense embedding: (n,) int64."""
        return self._row_of_slot[slots].to(torch.int64)

    def row_of_slot(self, slots: slice) -> Tensor:
        """Return the row of each slot, -1 where a voxel has no dense embedding: (n,) int32, a view."""
        return self._row_of_slot[slots]

    def slots(self, rows: Tensor) -> Tensor:
        """Look up the slot of each row, -1 for a free one: (n,) int64."""
        return self._slot_of_row[rows].to(torch.int64)

    def slot_of_row(self) -> Tensor:
        """Return the slot of every row, -1 for a free one: (rows,) int32, a view."""
        return self._slot_of_row[: self.pool.high_water]

    def weight_of_row(self) -> Tensor:
        """Return the weight w^D of every row: (rows,) float32, a view."""
        return self._weight_of_row[: self.pool.high_water]

    def weights(self, rows: Tensor) -> Tensor:
        """Look up the weight w^D of each row, 0 for row -1: (n,) float32."""
        if not self.pool.high_water:
            return torch.zeros(len(rows), device=self._device)
        return torch.where(rows >= 0, self._weight_of_row[rows.clamp(min=0)], 0.0)

    def live(self) -> tuple[Tensor, Tensor]:
        """Return the rows in use and their slots, in the order of rows: two (n,) int64."""
        slots = self.slot_of_row()
        rows = torch.nonzero(slots >= 0).squeeze(1)
        return rows, slots.index_select(0, rows).to(torch.int64)

    def accumulate(
        self, slots: Tensor, keys: Tensor, observations: GroupedCounts, embeddings: Tensor, weights: Tensor
    ) -> Tensor:
        """Add the observations of one keyframe [eq. dense_agg].

        Observations are counted per (voxel, patch) pair first and then multiplied, so that no point-by-d matrix exists.

        Args:
            slots: (v,) int64 distinct slots.
            keys: (v,) int64 packed keys of these voxels.
            observations: v groups of patches: how many points of each patch fell into the voxel.
            embeddings: (p, d) float32 unit vectors, one per patch.
            weights: (p,) float32 > 0, the weight a of one observation of a patch.

        Returns:
            Slots that were observed, int64.
        """
        lengths = observations.offsets.diff()
        hit = torch.nonzero(lengths).squeeze(1)
        if len(hit) < len(slots):  # A voxel all of whose points had no weight is left as it is.
            slots, keys, lengths = (each.index_select(0, hit) for each in (slots, keys, lengths))
            offsets = torch.cat([observations.offsets[:1], observations.offsets[1:].index_select(0, hit)])
            observations = GroupedCounts(offsets, observations.partners, observations.counts)
        if not len(slots):
            return slots
        added = observations.counts.to(torch.float32) * weights.index_select(0, observations.partners)
        rows = self._rows_for(slots)
        old = self._weight_of_row[rows]
        new = old + torch.segment_reduce(added, "sum", lengths=lengths)
        seeds = seeds_of(keys, new)
        self._kernels.merge_means(self.pool, rows, old, new, seeds, observations, added, embeddings)
        self._weight_of_row[rows] = new
        return slots

    def drop(self, rows: Tensor) -> None:
        """Forget the embeddings and weights in the rows; their storage is reused."""
        self._row_of_slot[self._slot_of_row[rows].to(torch.int64)] = -1
        self._slot_of_row[rows] = -1
        self._weight_of_row[rows] = 0.0
        self.pool.free(rows)

    def least_observed(self, count: int) -> Tensor:
        """Find the rows of the ``count`` lowest weights, of equal ones those of the lowest slots: (count,) int64.

        Args:
            count: At most as many as there are voxels with a dense embedding.
        """
        rows, slots = self.live()
        if count >= len(rows):
            return rows
        if not count:
            return rows[:0]
        weights = self._weight_of_row[rows]
        limit = torch.kthvalue(weights, count).values
        below, level = rows.masked_select(weights < limit), weights == limit
        level_rows, level_slots = rows.masked_select(level), slots.masked_select(level)
        oldest = torch.sort(level_slots).indices[: count - len(below)]
        return torch.cat([below, level_rows.index_select(0, oldest)])

    def compact(self) -> None:
        """Move embeddings together and free the blocks that are then empty. What the layer knows stays the same."""
        count = len(self.pool)
        if self.pool.spare_blocks:
            used = self.slot_of_row() >= 0
            sources = count + torch.nonzero(used[count:]).squeeze(1)
            targets = torch.nonzero(~used[:count]).squeeze(1)
            slots = self._slot_of_row[sources]
            self.pool.move(sources, targets)
            self._slot_of_row[targets] = slots
            self._weight_of_row[targets] = self._weight_of_row[sources]
            self._row_of_slot[slots.to(torch.int64)] = targets.to(torch.int32)
            self._slot_of_row = shortened(self._slot_of_row, count, -1)
            self._weight_of_row = shortened(self._weight_of_row, count, 0.0)
            self.pool.truncate(count)

    def add(self, slots: Tensor, weights: Tensor) -> Tensor:
        """Give slots without a dense embedding rows with the weights (n,): (n,) int64 rows, whose means are undefined."""
        rows = self._rows_for(slots)
        self._weight_of_row[rows] = weights
        return rows

    @property
    def block_nbytes(self) -> int:
        """Most bytes that one more block of embeddings takes, with columns that have just doubled."""
        columns = 2 * (self._slot_of_row.row_nbytes + self._weight_of_row.row_nbytes)
        return self.pool.block_nbytes + self.pool.block_rows * columns

    @property
    def link_nbytes(self) -> int:
        """Allocated bytes of what every voxel has, with a dense embedding or without."""
        return self._row_of_slot.nbytes

    def link_nbytes_after(self, slots: int) -> int:
        """Return the most bytes of that once slots 0 .. slots - 1 are addressable."""
        return self._row_of_slot.nbytes_after(slots)

    @property
    def nbytes(self) -> int:
        """Allocated bytes."""
        return self.pool.nbytes + self._row_of_slot.nbytes + self._slot_of_row.nbytes + self._weight_of_row.nbytes

    def _rows_for(self, slots: Tensor) -> Tensor:
        """Look up the rows of distinct slots. Those without one get a row of weight 0."""
        rows = self.rows(slots)
        fresh = rows < 0
        count = int(fresh.sum())
        if count:
            given = self.pool.allocate(count)
            self._slot_of_row.reserve(self.pool.high_water)
            self._weight_of_row.reserve(self.pool.high_water)
            self._slot_of_row[given] = slots.masked_select(fresh).to(torch.int32)
            self._weight_of_row[given] = 0.0
            rows.masked_scatter_(fresh, given)
            self._row_of_slot[slots] = rows.to(torch.int32)
        return rows
