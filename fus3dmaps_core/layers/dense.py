"""The dense layer M^D: one weight and one mean embedding per voxel [sec: Dense Semantic Voxel Mapping]."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import embedding_bag

from fus3dmaps_core.voxels.columns import Column
from fus3dmaps_core.voxels.rows import RowPool


class DenseLayer:
    """Weights and mean embeddings in pooled rows; a voxel has a row only while it has dense evidence."""

    def __init__(self, dimension: int, dtype: torch.dtype, device: torch.device) -> None:
        """Start empty; means are stored in ``dtype`` and computed in float32."""
        self._device = device
        self.pool = RowPool(dimension, dtype, device)
        self._row_of_slot = Column(torch.int32, -1, device)
        self._slot_of_row = Column(torch.int32, -1, device)
        self._weight_of_row = Column(torch.float32, 0.0, device)

    def __len__(self) -> int:
        """Number of voxels with a dense embedding."""
        return len(self.pool)

    def reserve(self, slots: int) -> None:
        """Make slots 0 .. slots - 1 addressable."""
        self._row_of_slot.reserve(slots)

    def rows(self, slots: Tensor | slice) -> Tensor:
        """Row of each slot, -1 where a voxel has no dense embedding: (n,) int64."""
        return self._row_of_slot[slots].to(torch.int64)

    def weights(self, slots: Tensor | slice) -> Tensor:
        """Weight w^D of each slot, 0 where a voxel has no dense embedding: (n,) float32."""
        rows = self.rows(slots)
        if not len(self._weight_of_row[:]):
            return torch.zeros(len(rows), device=self._device)
        return torch.where(rows >= 0, self._weight_of_row[rows.clamp(min=0)], 0.0)

    def live(self) -> tuple[Tensor, Tensor]:
        """Rows in use and their slots, in the order of rows: two (n,) int64."""
        slots = self._slot_of_row[: self.pool.high_water]
        rows = torch.nonzero(slots >= 0).squeeze(1)
        return rows, slots[rows].to(torch.int64)

    def live_blocks(self) -> list[tuple[Tensor, Tensor, Tensor]]:
        """Per storage block: slots (n,) int64, weights (n,) float32 and means (n, d) float32 of the voxels in it."""
        parts = []
        for first, block in self.pool.blocks():
            slots = self._slot_of_row[first : first + len(block)].to(torch.int64)
            used = torch.nonzero(slots >= 0).squeeze(1)
            if len(used):
                parts.append((slots[used], self._weight_of_row[first + used], block[used].to(torch.float32)))
        return parts

    def accumulate(self, slots: Tensor, voxels: Tensor, patches: Tensor, embeddings: Tensor, weights: Tensor) -> None:
        """Add the observations of one keyframe [eq. dense_agg].

        Observations are counted per (voxel, patch) pair first and then multiplied, so that no point-by-d matrix exists.

        Args:
            slots: (v,) int64 distinct slots.
            voxels: (n,) int64, for each point the index of its voxel in ``slots``.
            patches: (n,) int64, for each point the index of its patch.
            embeddings: (p, d) float32 unit vectors, one per patch.
            weights: (p,) float32, the weight a of one observation of a patch; patches of weight 0 add nothing.
        """
        useful = weights[patches] > 0
        pairs, counts = torch.unique(voxels[useful] * len(weights) + patches[useful], return_counts=True)
        if not len(pairs):
            return
        pair_patch = pairs % len(weights)
        pair_weight = counts.to(torch.float32) * weights[pair_patch]
        hit, lengths = torch.unique_consecutive(pairs // len(weights), return_counts=True)
        offsets = torch.cumsum(lengths, 0) - lengths
        sums = embedding_bag(pair_patch, embeddings, offsets, mode="sum", per_sample_weights=pair_weight)
        added = torch.segment_reduce(pair_weight, "sum", lengths=lengths)

        rows, fresh = self._rows_for(slots[hit])
        old_weight = self._weight_of_row[rows]
        new_weight = old_weight + added
        means = self.pool.read(rows)
        means[fresh] = 0.0  # A fresh row holds whatever its last owner left.
        means.mul_(old_weight[:, None]).add_(sums).div_(new_weight[:, None])
        self.pool.write(rows, means)
        self._weight_of_row[rows] = new_weight

    def drop(self, rows: Tensor) -> None:
        """Forget the embeddings and weights in the rows; their storage is reused."""
        self._row_of_slot[self._slot_of_row[rows].to(torch.int64)] = -1
        self._slot_of_row[rows] = -1
        self._weight_of_row[rows] = 0.0
        self.pool.free(rows)

    def restore(self, slots: Tensor, weights: Tensor, embeddings: Tensor) -> None:
        """Give slots without a dense embedding the stored weights (n,) and means (n, d)."""
        rows, _ = self._rows_for(slots)
        self._weight_of_row[rows] = weights
        self.pool.write(rows, embeddings)

    @property
    def nbytes(self) -> int:
        """Allocated bytes."""
        return self.pool.nbytes + self._row_of_slot.nbytes + self._slot_of_row.nbytes + self._weight_of_row.nbytes

    def _rows_for(self, slots: Tensor) -> tuple[Tensor, Tensor]:
        """Rows of the slots, allocating missing ones, and which of them are fresh."""
        rows = self.rows(slots)
        fresh = rows < 0
        count = int(fresh.sum())
        if count:
            rows[fresh] = self.pool.allocate(count)
            self._slot_of_row.reserve(self.pool.high_water)
            self._weight_of_row.reserve(self.pool.high_water)
            self._slot_of_row[rows[fresh]] = slots[fresh].to(torch.int32)
            self._weight_of_row[rows[fresh]] = 0.0
            self._row_of_slot[slots] = rows.to(torch.int32)
        return rows, fresh
