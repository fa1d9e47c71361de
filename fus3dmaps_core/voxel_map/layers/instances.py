"""The instance layer M^I: objects as overlapping sets of voxels [sec: Instance-Level Semantic Voxel Mapping].

A voxel holds up to K hypotheses, pairs of an instance and an observation count. An instance has an id, which is never
reused, and a row under which everything known of it is kept. An instance dies when no voxel holds it any more; its row is
then reused, so that memory follows the instances alive. Voxels refer to instances by row.
"""

from __future__ import annotations

import torch
from torch import Tensor

from fus3dmaps_core.errors import MapError
from fus3dmaps_core.voxel_map.kernels.protocols import Extents, GroupedCounts, Hypotheses, Kernels
from fus3dmaps_core.voxel_map.rows.columns import Column
from fus3dmaps_core.voxel_map.rows.row_pool import RowPool

MAX_ID = 2**31 - 1
"""Largest id, because messages and files hold ids in 32 bits."""


class InstanceLayer:
    """Hypotheses per slot, and everything known of an instance under its row."""

    def __init__(
        self, dimension: int, max_hypotheses: int, iou_threshold: float, kernels: Kernels, device: torch.device
    ) -> None:
        """Start empty. Embeddings are float32, because there are few of them."""
        self._kernels = kernels
        self._device = device
        self._iou_threshold = iou_threshold
        self._held_row = Column(torch.int32, -1, device, width=max_hypotheses)
        self._held_count = Column(torch.int32, 0, device, width=max_hypotheses)
        self.next_id = 0
        self.pool = RowPool(dimension, torch.float32, device)
        self._id_of_row = Column(torch.int64, -1, device)
        self._weight_of_row = Column(torch.float64, 0.0, device)
        self._voxels_of_row = Column(torch.int32, 0, device)
        self._observations_of_row = Column(torch.int64, 0, device)
        self._changed = Column(torch.bool, False, device)

    def __len__(self) -> int:
        """Return the number of instances alive."""
        return len(self.pool)

    def reserve(self, slots: int) -> None:
        """Make slots 0 .. slots - 1 addressable."""
        for column in self._columns_of_slots():
            column.reserve(slots)

    def live(self) -> tuple[Tensor, Tensor]:
        """Return the ids of the instances alive, ascending, and their rows: two (n,) int64."""
        ids = self._id_of_row[: self.pool.high_water]
        rows = torch.nonzero(ids >= 0).squeeze(1)
        ordered, order = torch.sort(ids.index_select(0, rows))
        return ordered, rows.index_select(0, order)

    def ids(self, rows: Tensor) -> Tensor:
        """Look up the id of each row, -1 for row -1: (n,) int64."""
        if not self.pool.high_water:
            return rows
        return torch.where(rows >= 0, self._id_of_row[rows.clamp(min=0).flatten()].view(rows.shape), -1)

    def held(self) -> Tensor:
        """Return the rows that each slot holds, -1 where empty: (slots, K) int32, a view."""
        return self._held_row[:]

    def hypotheses(self, slots: Tensor | slice) -> tuple[Tensor, Tensor]:
        """Return rows (-1 where empty) and counts of the slots' hypotheses: two (n, K) int64, in no meaningful order."""
        return self._held_row[slots].to(torch.int64), self._held_count[slots].to(torch.int64)

    def top(self, slots: Tensor) -> tuple[Tensor, Tensor]:
        """Find per slot the row with the highest count (ties: the lowest id; -1 without any) and that count: (n,) int64."""
        return self._kernels.top_hypotheses(self.columns(), slots)

    def columns(self) -> Hypotheses:
        """Return the columns that kernels work on, as views."""
        rows = slice(0, self.pool.high_water)
        return Hypotheses(
            self._held_row[:],
            self._held_count[:],
            self._id_of_row[rows],
            self._voxels_of_row[rows],
            self._observations_of_row[rows],
            self._changed[rows],
        )

    def weights(self, rows: Tensor) -> Tensor:
        """Look up the weights w_id: (n,) float64."""
        return self._weight_of_row[rows]

    def voxels(self, rows: Tensor) -> Tensor:
        """Look up |V_id|, the number of voxels that hold an instance as a hypothesis: (n,) int64."""
        return self._voxels_of_row[rows].to(torch.int64)

    def observations(self, rows: Tensor) -> Tensor:
        """Look up the sums of the instances' counts over V_id: (n,) int64."""
        return self._observations_of_row[rows]

    def changed(self) -> Tensor:
        """Find the instances alive that may have changed since they were marked as fused: (n,) int64 rows, ascending."""
        return torch.nonzero(self._changed[: self.pool.high_water]).squeeze(1)

    def mark_fused(self, rows: Tensor) -> None:
        """Mark instances as fused: their fused embeddings are up to date."""
        self._changed[rows] = False

    def mark_changed(self, slots: Tensor) -> None:
        """Mark the instances that the slots hold as changed, because the dense layer has changed there."""
        held = self._held_row[slots]
        self._changed[held.masked_select(held >= 0).to(torch.int64)] = True

    def check_room(self, count: int) -> None:
        """Raise MapError if there are no ids for ``count`` new instances."""
        if self.next_id + count > MAX_ID:
            raise MapError(f"the map has given {self.next_id} instance ids and has none for {count} proposals")
        self.pool.check_room(count)

    def extents(self) -> Extents:
        """Make empty extents, one for each row, to which voxels are added."""
        rows = self.pool.high_water
        none = torch.zeros(rows, dtype=torch.int64, device=self._device)
        nowhere = torch.zeros((rows, 3), dtype=torch.int64, device=self._device)
        far = torch.full_like(nowhere, 2**62)
        return Extents(voxels=none, counts=none.clone(), sums=nowhere, low=far, high=-far)

    def associate(
        self, proposals: GroupedCounts, embeddings: Tensor, visible: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Associate proposals with instances, in order, and update both [sec: Geometric Instance Association].

        Args:
            proposals: m groups: the distinct slots of V_m, and N_i, the proposal's points in each of them.
            embeddings: (m, d) float32 unit vectors.
            visible: (v,) distinct slots, those of all proposals among them. With them an IoU's union counts no other voxel
                of an instance: |V_m n V_id| / |V_m u (V_id n V_visible)|.

        Returns:
            Id of each proposal's instance, (m,) int64, -1 for one without points; and the rows of new instances.
        """
        spare = self.pool.allocate(len(embeddings))
        self._reserve_rows()
        hidden = None if visible is None else self._hidden(visible)
        outcome = self._kernels.associate(self.columns(), proposals, spare, self.next_id, self._iou_threshold, hidden)
        ends = torch.zeros(len(proposals.counts) + 1, dtype=torch.int64, device=self._device)
        ends[1:] = torch.cumsum(proposals.counts, 0)
        self._average(outcome.rows, ends.index_select(0, proposals.offsets).diff(), embeddings)
        self.next_id += outcome.created
        self.pool.free(spare[outcome.created :])
        self._free_rows(outcome.dead)
        return outcome.ids, spare[: outcome.created]

    def take_in(self, gone: Tensor, into: Tensor, slots: Tensor) -> None:
        """Merge instances into others: f = (w f + w_gone f_gone) / (w + w_gone), w += w_gone, and counts are added.

        Args:
            gone: (n,) distinct rows of the instances that are taken in, and given up.
            into: (n,) rows of those that take them in, none of them gone; one may take in several.
            slots: Distinct slots, all that hold one of those that are taken in among them.
        """
        self._kernels.merge(self.columns(), slots, gone, into)
        self._average(into, self._weight_of_row[gone], self.pool.read(gone))
        self._free_rows(gone)

    def forget(self, slots: Tensor) -> None:
        """Empty the hypotheses of distinct slots. Instances left without a voxel die."""
        held, counts = self.hypotheses(slots)
        used = held >= 0
        losers, index, lost = torch.unique(held[used], return_inverse=True, return_counts=True)
        self._voxels_of_row[losers] -= lost.to(torch.int32)
        self._observations_of_row[losers] -= torch.zeros_like(losers).index_add_(0, index, counts[used])
        self._changed[losers] = True
        self._held_row[slots] = -1
        self._held_count[slots] = 0
        dead = losers[self._voxels_of_row[losers] == 0]
        self._id_of_row[dead] = -1
        self._free_rows(dead)

    def restore(
        self, slots: Tensor, ids: Tensor, counts: Tensor, next_id: int, alive: Tensor, weights: Tensor, embeddings: Tensor
    ) -> Tensor:
        """Fill an empty layer.

        Args:
            slots: (n,) slots of all voxels.
            ids: (n, K) ids of their hypotheses, -1 where empty.
            counts: (n, K) their counts.
            next_id: Id of the next new instance.
            alive: (i,) ids of the instances alive.
            weights: (i,) w_id.
            embeddings: (i, d) f_id.

        Returns:
            Rows of the instances, in the order of ``alive``.
        """
        self.next_id = next_id
        rows = self.pool.allocate(len(alive))
        self._reserve_rows()
        self._id_of_row[rows] = alive
        self._weight_of_row[rows] = weights
        self._changed[rows] = True
        self.pool.write(rows, embeddings)
        ordered, order = torch.sort(alive)
        used = ids >= 0
        held = torch.full_like(ids, -1, dtype=torch.int32)
        if len(alive):
            held[used] = rows[order[torch.searchsorted(ordered, ids[used].to(torch.int64))]].to(torch.int32)
        self._held_row[slots] = held
        self._held_count[slots] = counts.to(torch.int32)
        flat = held[used].to(torch.int64)
        self._voxels_of_row[rows] = torch.bincount(flat, minlength=self.pool.high_water).to(torch.int32)[rows]
        totals = torch.zeros(self.pool.high_water, dtype=torch.int64, device=self._device)
        self._observations_of_row[rows] = totals.index_add_(0, flat, counts[used].to(torch.int64))[rows]
        return rows

    @property
    def nbytes(self) -> int:
        """Allocated bytes."""
        return self.pool.nbytes + sum(column.nbytes for column in (*self._columns_of_slots(), *self._columns_of_rows()))

    def nbytes_after(self, slots: int, count: int) -> int:
        """Return the most bytes that are allocated with slots 0 .. slots - 1 and ``count`` more instances."""
        rows = self.pool.high_water_after(count)
        of_slots = sum(column.nbytes_after(slots) for column in self._columns_of_slots())
        return (
            self.pool.nbytes_after(count) + of_slots + sum(column.nbytes_after(rows) for column in self._columns_of_rows())
        )

    def _columns_of_slots(self) -> tuple[Column, ...]:
        return self._held_row, self._held_count

    def _columns_of_rows(self) -> tuple[Column, ...]:
        return self._id_of_row, self._weight_of_row, self._voxels_of_row, self._observations_of_row, self._changed

    def _reserve_rows(self) -> None:
        for column in self._columns_of_rows():
            column.reserve(self.pool.high_water)

    def _hidden(self, visible: Tensor) -> Tensor:
        """Count the voxels that each instance has outside of distinct slots: (rows,) int32.

        The counts stay valid while proposals are associated whose slots are all among them.
        """
        held = self._held_row[visible]
        seen = torch.bincount(held.masked_select(held >= 0), minlength=self.pool.high_water)
        return self._voxels_of_row[: self.pool.high_water] - seen.to(torch.int32)

    def _average(self, rows: Tensor, points: Tensor, embeddings: Tensor) -> None:
        """Update f_id = (w_id f_id + sum of N_m f_m) / (w_id + sum of N_m) over the m that an instance was given.

        Args:
            rows: (m,) row of the instance that each was given to, -1 for none.
            points: (m,) N_m.
            embeddings: (m, d) f_m.
        """
        given = torch.nonzero(rows >= 0).squeeze(1)
        if not len(given):
            return
        owners, place, _ = self._kernels.distinct(rows[given])
        groups = self._kernels.count_pairs(place, given, len(owners), len(rows))
        points = points.index_select(0, groups.partners)
        old = self._weight_of_row[owners]
        new = old + torch.segment_reduce(points.to(torch.float64), "sum", lengths=groups.offsets.diff())
        weights = (old.to(torch.float32), new.to(torch.float32))
        amounts, seeds = points.to(torch.float32), torch.zeros_like(owners)
        self._kernels.merge_means(self.pool, owners, *weights, seeds, groups, amounts, embeddings)
        self._weight_of_row[owners] = new

    def _free_rows(self, dead: Tensor) -> None:
        """Free the rows of instances that have died."""
        for column in (self._weight_of_row, self._observations_of_row, self._changed):
            column[dead] = 0
        self.pool.free(dead)
