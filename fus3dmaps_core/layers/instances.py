"""The instance layer M^I: objects as overlapping sets of voxels [sec: Instance-Level Semantic Voxel Mapping].

A voxel holds up to K hypotheses, pairs of an instance id and an observation count. An instance holds an embedding, a weight
and the fused embedding with its evidence. Ids grow and are never given twice.
"""

from __future__ import annotations

import torch
from torch import Tensor

from fus3dmaps_core.errors import MapError
from fus3dmaps_core.voxels.columns import Column
from fus3dmaps_core.voxels.rows import RowPool

_MAX_ID = 2**31 - 1
_COUNT_UNIT = 2**32  # Orders by count first, then by id, in one integer.


class InstanceLayer:
    """Hypotheses per slot, and everything known of an instance under its id."""

    def __init__(self, dimension: int, max_hypotheses: int, iou_threshold: float, device: torch.device) -> None:
        """Start empty; embeddings are float32, for there are few of them."""
        self._device = device
        self._dimension = dimension
        self._k = max_hypotheses
        self._iou_threshold = iou_threshold
        self._hypothesis_id = Column(torch.int32, -1, device, width=max_hypotheses)
        self._hypothesis_count = Column(torch.int32, 0, device, width=max_hypotheses)
        self.next_id = 0
        self._alive = 0
        self._row = Column(torch.int32, -1, device)
        self._weight = Column(torch.float64, 0.0, device)
        self._voxels = Column(torch.int32, 0, device)
        self._observations = Column(torch.int64, 0, device)
        self._evidence = Column(torch.float64, 0.0, device)
        self._pool = RowPool(dimension, torch.float32, device)
        self._fused_pool = RowPool(dimension, torch.float32, device)

    def __len__(self) -> int:
        """Number of instances alive."""
        return self._alive

    def reserve(self, slots: int) -> None:
        """Make slots 0 .. slots - 1 addressable."""
        self._hypothesis_id.reserve(slots)
        self._hypothesis_count.reserve(slots)

    def ids(self) -> Tensor:
        """Ids of the instances alive, ascending: (n,) int64."""
        return torch.nonzero(self._row[: self.next_id] >= 0).squeeze(1)

    def hypotheses(self, slots: Tensor | slice) -> tuple[Tensor, Tensor]:
        """Ids (-1 where empty) and counts of the slots' hypotheses: two (n, K) int64, in no meaningful order."""
        return self._hypothesis_id[slots].to(torch.int64), self._hypothesis_count[slots].to(torch.int64)

    def top(self, slots: Tensor | slice) -> tuple[Tensor, Tensor]:
        """Per slot the id with the highest count (ties: the lowest id; -1 without hypothesis) and that count: (n,) int64."""
        ids, counts = self.hypotheses(slots)
        column = torch.argmax(counts * _COUNT_UNIT - ids, dim=1, keepdim=True)
        return ids.gather(1, column).squeeze(1), counts.gather(1, column).squeeze(1)

    def weights(self, ids: Tensor) -> Tensor:
        """Weight w_id: (n,) float64."""
        return self._weight[ids]

    def voxels(self, ids: Tensor) -> Tensor:
        """|V_id|, the voxels that hold the instance as a hypothesis: (n,) int64."""
        return self._voxels[ids].to(torch.int64)

    def observations(self, ids: Tensor) -> Tensor:
        """Sum of the instance's counts over V_id: (n,) int64."""
        return self._observations[ids]

    def embeddings(self, ids: Tensor) -> Tensor:
        """Mean embeddings f_id: (n, d) float32."""
        return self._pool.read(self._row[ids].to(torch.int64))

    def evidence(self, ids: Tensor) -> Tensor:
        """Evidence e_id of the stored fused embeddings, 0 before the first fusion: (n,) float64."""
        return self._evidence[ids]

    def fused_embeddings(self, ids: Tensor) -> Tensor:
        """Stored fused embeddings; f_id itself before an instance's first fusion: (n, d) float32."""
        rows = self._row[ids].to(torch.int64)
        fused = self._evidence[ids] > 0
        values = self._pool.read(rows)
        values[fused] = self._fused_pool.read(rows[fused])
        return values

    def store_fused(self, ids: Tensor, fused: Tensor, evidence: Tensor) -> None:
        """Replace fused embeddings and evidence of the given instances."""
        self._fused_pool.write(self._row[ids].to(torch.int64), fused)
        self._evidence[ids] = evidence

    def integrate(self, slots: Tensor, counts: Tensor, embedding: Tensor) -> int:
        """Associate one proposal with an instance, or make a new one, and update both [sec: Geometric Instance Association].

        Args:
            slots: (v,) int64, the distinct slots of V_m.
            counts: (v,) int64, N_i, the proposal's points in each of them.
            embedding: (d,) float32 unit vector.

        Returns:
            Id of the instance.
        """
        held = self._hypothesis_id[slots].to(torch.int64)
        match = self._associate(held, len(slots))
        points = int(counts.sum())
        if match is None:
            match = self._create()
        row = self._row[match : match + 1].to(torch.int64)
        weight = self._weight[match : match + 1]
        total = weight + points
        old = self._pool.read(row) if float(weight) else torch.zeros((1, self._dimension), device=self._device)
        share = (weight / total).to(torch.float32)
        self._pool.write(row, old * share + embedding * (points / total).to(torch.float32))
        self._weight[match : match + 1] = total
        self._observations[match : match + 1] += points
        self._count(slots, counts, held, match)
        return match

    def restore(self, slots: Tensor, ids: Tensor, counts: Tensor) -> None:
        """Write the stored hypotheses of slots: ids and counts (n, K)."""
        self._hypothesis_id[slots] = ids.to(torch.int32)
        self._hypothesis_count[slots] = counts.to(torch.int32)

    def restore_instances(
        self, next_id: int, ids: Tensor, weights: Tensor, embeddings: Tensor, fused: Tensor, evidence: Tensor, slots: int
    ) -> None:
        """Write the stored instances; voxel and observation counts are recounted from the hypotheses of all slots."""
        self._reserve_ids(next_id)
        self.next_id, self._alive = next_id, len(ids)
        rows = self._pool.allocate(len(ids))
        self._fused_pool.allocate(len(ids))
        self._row[ids] = rows.to(torch.int32)
        self._weight[ids] = weights
        self._evidence[ids] = evidence
        self._pool.write(rows, embeddings)
        self._fused_pool.write(rows, fused)
        held, counts = self.hypotheses(slice(0, slots))
        used = held >= 0
        self._voxels[:next_id] = torch.bincount(held[used], minlength=next_id).to(torch.int32)
        totals = torch.zeros(next_id, dtype=torch.int64, device=self._device)
        self._observations[:next_id] = totals.index_add(0, held[used], counts[used])

    @property
    def nbytes(self) -> int:
        """Allocated bytes."""
        columns = (
            self._hypothesis_id,
            self._hypothesis_count,
            self._row,
            self._weight,
            self._voxels,
            self._observations,
            self._evidence,
        )
        return self._pool.nbytes + self._fused_pool.nbytes + sum(column.nbytes for column in columns)

    def _associate(self, held: Tensor, size: int) -> int | None:
        """The instance with the largest IoU above the threshold among those held by the proposal's voxels."""
        candidates, shared = torch.unique(held[held >= 0], return_counts=True)
        if not len(candidates):
            return None
        # Correctly rounded float64 quotients: equal ratios compare equal, and 1/5 is not above 0.2.
        iou = shared.to(torch.float64) / (size + self.voxels(candidates) - shared).to(torch.float64)
        best = float(iou.max())
        if best <= self._iou_threshold:
            return None
        return int(candidates[iou == best].min())

    def _create(self) -> int:
        if self.next_id > _MAX_ID:
            raise MapError("the map has used up its instance ids")
        created, self.next_id = self.next_id, self.next_id + 1
        self._alive += 1
        self._reserve_ids(self.next_id)
        self._row[created : created + 1] = self._pool.allocate(1).to(torch.int32)
        self._fused_pool.allocate(1)  # Both pools see the same sequence of calls, hence the same row.
        return created

    def _reserve_ids(self, ids: int) -> None:
        for column in (self._row, self._weight, self._voxels, self._observations, self._evidence):
            column.reserve(ids)

    def _count(self, slots: Tensor, counts: Tensor, held: Tensor, instance: int) -> None:
        """Add the counts to the instance's hypotheses, displacing the weakest one of a full voxel."""
        is_own = held == instance
        known = is_own.any(dim=1)
        had = self._hypothesis_count[slots].to(torch.int64)
        # Empty places first (by position), then the lowest count, then the oldest id.
        preference = torch.where(held < 0, torch.arange(self._k, device=self._device) - self._k, had * _COUNT_UNIT + held)
        column = torch.where(known, is_own.to(torch.int64).argmax(dim=1), preference.argmin(dim=1))[:, None]
        old_id, old_count = held.gather(1, column).squeeze(1), had.gather(1, column).squeeze(1)
        held.scatter_(1, column, instance)
        had.scatter_(1, column, (counts + torch.where(known, old_count, 0))[:, None])
        self._hypothesis_id[slots] = held.to(torch.int32)
        self._hypothesis_count[slots] = had.to(torch.int32)
        self._voxels[instance : instance + 1] += int((~known).sum())
        displaced = ~known & (old_id >= 0)
        if bool(displaced.any()):
            self._displace(old_id[displaced], old_count[displaced])

    def _displace(self, ids: Tensor, counts: Tensor) -> None:
        """Take voxels and counts from instances that lost a hypothesis, and delete those left with none."""
        losers, index, lost = torch.unique(ids, return_inverse=True, return_counts=True)
        self._voxels[losers] -= lost.to(torch.int32)
        lost_counts = torch.zeros(len(losers), dtype=torch.int64, device=self._device).index_add_(0, index, counts)
        self._observations[losers] -= lost_counts
        dead = losers[self._voxels[losers] == 0]
        if len(dead):
            rows = self._row[dead].to(torch.int64)
            self._pool.free(rows)
            self._fused_pool.free(rows)
            self._row[dead] = -1
            for column in (self._weight, self._observations, self._evidence):
                column[dead] = 0
            self._alive -= len(dead)
