"""The inner loops in plain torch, for any device."""

from __future__ import annotations

import itertools

import torch
from torch import Tensor
from torch.nn.functional import embedding_bag, normalize

from fus3dmaps_core.voxel_map.kernels.keys import MAX_COORDINATE, home, pack, unpack
from fus3dmaps_core.voxel_map.kernels.protocols import (
    DELETED,
    EMPTY,
    MAX_COUNT,
    SCORE_UNIT,
    Association,
    EmbeddedLayer,
    Extents,
    FusionRows,
    GroupedCounts,
    HashTable,
    Hypotheses,
    InheritedLayer,
    ScoredVoxels,
    ScoreSums,
    SlotBlock,
)
from fus3dmaps_core.voxel_map.kernels.scores import scores_of
from fus3dmaps_core.voxel_map.rows.row_pool import RowPool

_COUNT_UNIT = 2**32  # Orders by count first, then by id, in one integer.
_READ_ROWS = 2048  # Rows that are decoded at once, so that memory stays bounded.
_SCANNED_SLOTS = 2**17  # Of hypotheses, the same.


class TorchKernels:
    """:class:`Kernels` as tensor operations. Only proposals, whose order matters, are taken one by one."""

    def voxel_keys(self, points_m: Tensor, voxel_size_m: float) -> tuple[Tensor, float]:
        if not len(points_m):
            return torch.zeros(0, dtype=torch.int64, device=points_m.device), 0.0
        coordinates = torch.floor(points_m.to(torch.float64) / voxel_size_m)
        largest = float(coordinates.abs().max())
        return pack(coordinates.nan_to_num(0.0).clamp(-MAX_COORDINATE, MAX_COORDINATE)), largest

    def unit_rows(self, values: Tensor) -> tuple[Tensor, int]:
        wide = values.to(torch.float64)
        if not bool(torch.isfinite(wide).all()):
            return values, 1
        largest = wide.abs().amax(dim=1, keepdim=True) if len(wide) else wide[:, :1]
        if bool((largest == 0).any()):
            return values, 2
        # Scaled first, so that squares neither overflow nor vanish whatever the row's length.
        return normalize(wide / largest, dim=1).to(torch.float32), 0

    def distinct(self, keys: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        # In ascending order.
        unique, inverse, counts = torch.unique(keys, return_inverse=True, return_counts=True)
        return unique, inverse, counts

    def count_pairs(self, first: Tensor, second: Tensor, groups: int, partners: int) -> GroupedCounts:
        # Partners of a group in ascending order.
        pairs, counts = torch.unique(first * partners + second, return_counts=True)
        offsets = torch.zeros(groups + 1, dtype=torch.int64, device=first.device)
        if len(pairs):
            offsets[1:] = torch.cumsum(torch.bincount(pairs // partners, minlength=groups), 0)
            pairs = pairs % partners
        return GroupedCounts(offsets, pairs, counts)

    def find(self, table: HashTable, keys: Tensor) -> Tensor:
        slots = torch.full_like(keys, -1)
        rows = torch.arange(len(keys), device=keys.device)
        cells = home(keys, len(table.keys))
        while len(rows):
            found = table.keys[cells]
            hit = found == keys[rows]
            slots[rows[hit]] = table.slots[cells[hit]].to(torch.int64)
            onward = ~hit & (found != EMPTY)
            rows, cells = rows[onward], (cells[onward] + 1) & (len(table.keys) - 1)
        return slots

    def place(self, table: HashTable, keys: Tensor, slots: Tensor) -> None:
        cells = home(keys, len(table.keys))
        while len(keys):
            free = table.keys[cells] == EMPTY
            # Several keys may claim one cell: one write survives, whose key reads back; the others probe on.
            table.keys[cells[free]] = keys[free]
            won = free & (table.keys[cells] == keys)
            table.slots[cells[won]] = slots[won].to(torch.int32)
            keys, slots, cells = keys[~won], slots[~won], (cells[~won] + 1) & (len(table.keys) - 1)

    def mark_deleted(self, table: HashTable, keys: Tensor) -> None:
        cells = home(keys, len(table.keys))
        while len(keys):
            hit = table.keys[cells] == keys
            table.keys[cells[hit]] = DELETED
            keys, cells = keys[~hit], (cells[~hit] + 1) & (len(table.keys) - 1)

    def merge_means(
        self,
        pool: RowPool,
        rows: Tensor,
        old: Tensor,
        new: Tensor,
        seeds: Tensor,
        groups: GroupedCounts,
        amounts: Tensor,
        embeddings: Tensor,
    ) -> None:
        known = old > 0
        means = torch.where(known[:, None], pool.read(rows), 0.0)
        sums = embedding_bag(groups.partners, embeddings, groups.offsets[:-1], mode="sum", per_sample_weights=amounts)
        scales = torch.where(known, pool.scales[rows], 0.0) if pool.dtype == torch.int8 else None
        pool.write(rows, means.mul_((old / new)[:, None]).add_(sums.div_(new[:, None])), seeds, scales)

    def associate(
        self,
        hypotheses: Hypotheses,
        proposals: GroupedCounts,
        spare_rows: Tensor,
        next_id: int,
        iou_threshold: float,
        hidden_of_row: Tensor | None = None,
    ) -> Association:
        matched, ids, dead, created = [], [], [], 0
        ends = proposals.offsets.tolist()
        for start, end in itertools.pairwise(ends):
            if start == end:
                matched.append(-1)
                ids.append(-1)
                continue
            slots, counts = proposals.partners[start:end], proposals.counts[start:end]
            held = hypotheses.held_row[slots].to(torch.int64)
            row = _best_match(hypotheses, held, len(slots), iou_threshold, hidden_of_row)
            if row is None:
                row = int(spare_rows[created])
                hypotheses.id_of_row[row] = next_id + created
                created += 1
            matched.append(row)
            ids.append(int(hypotheses.id_of_row[row]))
            dead.append(_count(hypotheses, slots, counts, held, row))
        device = proposals.offsets.device
        died = torch.cat(dead) if dead else torch.zeros(0, dtype=torch.int64, device=device)
        rows, given = (torch.tensor(each, dtype=torch.int64, device=device) for each in (matched, ids))
        return Association(rows, given, created, died)

    def holders(self, held_row: Tensor, rows: Tensor, row_count: int) -> Tensor:
        if not len(rows):
            return rows
        is_wanted = torch.zeros(row_count + 1, dtype=torch.bool, device=held_row.device)
        is_wanted[rows] = True  # Row -1, an empty place, finds the last one.
        holds = [is_wanted[part.to(torch.int64)].any(dim=1) for part in torch.split(held_row, _SCANNED_SLOTS)]
        return torch.nonzero(torch.cat(holds)).squeeze(1)

    def shared_voxels(self, held_row: Tensor, rows: Tensor, row_count: int) -> Tensor:
        count = len(rows)
        place_of_row = torch.full((row_count + 1,), -1, dtype=torch.int64, device=held_row.device)
        place_of_row[rows] = torch.arange(count, device=held_row.device)  # Row -1, an empty place, finds the last one.
        shared = torch.zeros(count * count, dtype=torch.int64, device=held_row.device)
        for part in torch.split(held_row, _SCANNED_SLOTS):
            places = place_of_row[part.to(torch.int64)]
            for k in range(places.shape[1]):
                both = (places[:, k, None] >= 0) & (places >= 0)
                pairs = (places[:, k, None] * count + places)[both]
                shared.index_add_(0, pairs, torch.ones_like(pairs))
        return shared.view(count, count)

    def merge(self, hypotheses: Hypotheses, slots: Tensor, gone: Tensor, into: Tensor) -> None:
        target_of_row = torch.full((len(hypotheses.id_of_row) + 1,), -1, dtype=torch.int64, device=slots.device)
        target_of_row[gone] = into  # Row -1, an empty place, finds the last one.
        hypotheses.id_of_row[gone] = -1
        hypotheses.voxels_of_row[gone] = 0
        hypotheses.observations_of_row[gone] = 0
        hypotheses.changed[into] = True
        for part in torch.split(slots, _SCANNED_SLOTS):
            _rename(hypotheses, part, target_of_row)

    def top_hypotheses(self, hypotheses: Hypotheses, slots: Tensor) -> tuple[Tensor, Tensor]:
        rows = hypotheses.held_row[slots].to(torch.int64)
        counts = hypotheses.held_count[slots].to(torch.int64)
        if not len(hypotheses.id_of_row):
            return rows[:, 0], counts[:, 0]
        column = torch.argmax(counts * _COUNT_UNIT - hypotheses.id_of_row[rows.clamp(min=0)], dim=1, keepdim=True)
        return rows.gather(1, column).squeeze(1), counts.gather(1, column).squeeze(1)

    def scan_limit(self, texts: int) -> int:
        return min(2**17, max(256, 2**20 // max(texts, 1)))

    def scan(
        self,
        block: SlotBlock,
        hypotheses: Hypotheses,
        extents: Extents,
        layer: EmbeddedLayer | InheritedLayer | None,
        sums: ScoreSums | None,
        threshold: float,
        room_for: ScoredVoxels,
    ) -> tuple[int, int]:
        slots = torch.arange(block.first, block.first + len(block.keys), device=block.keys.device)
        top_rows, top_counts = self.top_hypotheses(hypotheses, slots)
        owned = top_rows >= 0
        _add_extents(extents, top_rows[owned], top_counts[owned], unpack(block.keys[owned]))
        if layer is None:
            return 0, 0
        dense_rows = block.dense_rows.to(torch.int64)
        if isinstance(layer, InheritedLayer):
            picked = torch.nonzero(owned).squeeze(1)
            scores = layer.scores_of_row[top_rows[picked]]
        else:
            picked = torch.nonzero((dense_rows >= 0) | (owned & (layer.own is not None))).squeeze(1)
            scores = self._scores(layer, dense_rows[picked], top_rows[picked], top_counts[picked])
        if sums is not None:
            rows = top_rows[picked]
            belong = rows >= 0
            rows = rows[belong]
            sums.members.index_add_(0, rows, torch.ones_like(rows))
            sums.totals.index_add_(0, rows, (scores[belong] * SCORE_UNIT).to(torch.int64))
        best, which = scores.max(dim=1)  # Of equal ones the first.
        kept = best >= threshold
        count = int(kept.sum())
        room_for.best[:count] = best[kept]
        if room_for.which is not None:
            room_for.which[:count] = which[kept].to(torch.int32)
        room_for.centers_m[:count] = self.centers(block.keys[picked[kept]], block.voxel_size_m)
        return len(picked), count

    def farther(self, keys: Tensor, voxel_size_m: float, point_m: Tensor, radius_m: float) -> Tensor:
        offsets = (unpack(keys).to(torch.float64) + 0.5) * voxel_size_m - point_m
        return torch.nonzero(torch.linalg.vector_norm(offsets, dim=1) > radius_m).squeeze(1)

    def centers(self, keys: Tensor, voxel_size_m: float) -> Tensor:
        return ((unpack(keys).to(torch.float64) + 0.5) * voxel_size_m).to(torch.float32)

    def cosines(self, pool: RowPool, rows: Tensor, texts: Tensor) -> Tensor:
        found = texts.new_empty((len(rows), len(texts)))
        for start in range(0, len(rows), _READ_ROWS):
            part = slice(start, start + _READ_ROWS)
            found[part] = normalize(pool.read(rows[part]), dim=1) @ texts.T
        return found

    def fuse(self, voxels: FusionRows, rows: Tensor, own: RowPool, amounts: Tensor, bars: Tensor, target: RowPool) -> Tensor:
        place = torch.full((own.high_water,), -1, dtype=torch.int64, device=rows.device)
        place[rows] = torch.arange(len(rows), device=rows.device)
        sums, evidence = _weighted_sums(voxels, place, len(rows))
        evidence += amounts
        for part in torch.split(torch.arange(len(rows), device=rows.device), _READ_ROWS):
            part = part[evidence[part] > bars[part]]
            total, means = evidence[part, None], own.read(rows[part])
            fused = sums[part].addcmul_(means.to(torch.float64), amounts[part, None]).div_(total)
            # Without lambda and dense evidence an instance has nothing to be fused from and keeps its own embedding.
            target.write(rows[part], torch.where(total > 0, fused.to(torch.float32), means))
        return evidence

    def _scores(self, layer: EmbeddedLayer, dense_rows: Tensor, top_rows: Tensor, top_counts: Tensor) -> Tensor:
        """Score the voxels that have the layer: (n, p)."""
        vectors = layer.texts.vectors
        found = vectors.new_empty((len(dense_rows), len(vectors)))
        for start in range(0, len(dense_rows), _READ_ROWS):
            part = slice(start, start + _READ_ROWS)
            rows = dense_rows[part]
            if layer.own is None:
                means = layer.pool.read(rows)
            else:
                means = _fused_means(layer, layer.own, rows, top_rows[part], top_counts[part])
            found[part] = normalize(means, dim=1) @ vectors.T
        return scores_of(found, layer.texts)


def _add_extents(extents: Extents, rows: Tensor, counts: Tensor, coordinates: Tensor) -> None:
    extents.voxels.index_add_(0, rows, torch.ones_like(rows))
    extents.counts.index_add_(0, rows, counts)
    extents.sums.index_add_(0, rows, counts[:, None] * coordinates)
    by_axis = rows[:, None].expand(-1, 3)
    extents.low.scatter_reduce_(0, by_axis, coordinates, "amin")
    extents.high.scatter_reduce_(0, by_axis, coordinates, "amax")


def _fused_means(layer: EmbeddedLayer, own: RowPool, rows: Tensor, top_rows: Tensor, top_counts: Tensor) -> Tensor:
    """Compute (w f + lambda c g) / (w + lambda c) of voxels with a row, a top hypothesis or both: (n, d) float32."""
    known, held = rows >= 0, top_rows >= 0
    weights = layer.weight_of_row.new_zeros(len(rows))
    weights[known] = layer.weight_of_row[rows[known]]
    own_weights = layer.variance_ratio * top_counts.to(torch.float32)
    total = weights + own_weights
    shares = torch.where(held, weights / total, 1.0)
    rests = torch.where(known, own_weights / total, 1.0)
    fused = layer.texts.vectors.new_zeros((len(rows), own.dimension))
    for pool, where, used, share in ((layer.pool, rows, known, shares), (own, top_rows, held, rests)):
        fused[used] += pool.read(where[used]) * share[used, None]
    return fused


def _weighted_sums(voxels: FusionRows, place_of_instance: Tensor, places: int) -> tuple[Tensor, Tensor]:
    """Sum w f, (places, d) float64, and w, (places,) float64, over the voxels of instances."""
    pool, slot_of_row = voxels.pool, voxels.slot_of_row
    sums = torch.zeros((places, pool.dimension), dtype=torch.float64, device=slot_of_row.device)
    totals = torch.zeros(places, dtype=torch.float64, device=slot_of_row.device)
    for first in range(0, len(slot_of_row), pool.block_rows):
        slots = slot_of_row[first : first + pool.block_rows].to(torch.int64)
        held = torch.where((slots >= 0)[:, None], voxels.held_row[slots.clamp(min=0)], -1).to(torch.int64)
        place = torch.where(held >= 0, place_of_instance[held.clamp(min=0)], -1)
        row, column = torch.nonzero(place >= 0, as_tuple=True)
        if not len(row):
            continue
        owners, order = torch.sort(place[row, column], stable=True)
        touched, lengths = torch.unique_consecutive(owners, return_counts=True)
        # Only the rows that someone asks for are decoded.
        wanted, row = torch.unique(row[order], return_inverse=True)
        weights = voxels.weight_of_row[first + wanted][row]
        bags = torch.cumsum(lengths, 0) - lengths
        means = pool.read(first + wanted)
        sums[touched] += embedding_bag(row, means, bags, mode="sum", per_sample_weights=weights).to(torch.float64)
        totals[touched] += torch.segment_reduce(weights.to(torch.float64), "sum", lengths=lengths)
    return sums, totals


def _best_match(
    hypotheses: Hypotheses, held: Tensor, size: int, iou_threshold: float, hidden_of_row: Tensor | None
) -> int | None:
    """Find the row of the instance with the largest IoU above the threshold (ties: the lowest id) among those held."""
    candidates, shared = torch.unique(held[held >= 0], return_counts=True)
    if not len(candidates):
        return None
    # Correctly rounded float64 quotients: equal ratios compare equal, and 1/5 is not above 0.2.
    union = size + hypotheses.voxels_of_row[candidates].to(torch.int64) - shared
    if hidden_of_row is not None:
        union -= hidden_of_row[candidates]
    iou = shared.to(torch.float64) / union.to(torch.float64)
    best = float(iou.max())
    if best <= iou_threshold:
        return None
    winners = candidates[iou == best]
    return int(winners[hypotheses.id_of_row[winners].argmin()])


def _count(hypotheses: Hypotheses, slots: Tensor, counts: Tensor, held: Tensor, row: int) -> Tensor:
    """Add the counts to an instance's hypotheses, displacing the weakest one of a full voxel; returns rows that died."""
    is_own = held == row
    known = is_own.any(dim=1)
    had = hypotheses.held_count[slots].to(torch.int64)
    # Empty places first (by position), then the lowest count, then the oldest id.
    places = torch.arange(held.shape[1], device=held.device) - held.shape[1]
    preference = torch.where(held < 0, places, had * _COUNT_UNIT + hypotheses.id_of_row[held.clamp(min=0)])
    column = torch.where(known, is_own.to(torch.int64).argmax(dim=1), preference.argmin(dim=1))[:, None]
    loser, lost_count = held.gather(1, column).squeeze(1), had.gather(1, column).squeeze(1)
    before = torch.where(known, lost_count, 0)
    after = (before + counts).clamp(max=MAX_COUNT)
    hypotheses.held_row[slots] = held.scatter(1, column, row).to(torch.int32)
    hypotheses.held_count[slots] = had.scatter(1, column, after[:, None]).to(torch.int32)
    hypotheses.voxels_of_row[row] += int((~known).sum())
    hypotheses.observations_of_row[row] += int((after - before).sum())
    hypotheses.changed[row] = True
    displaced = ~known & (loser >= 0)
    losers, index, lost = torch.unique(loser[displaced], return_inverse=True, return_counts=True)
    lost_observations = torch.zeros_like(losers).index_add_(0, index, lost_count[displaced])
    hypotheses.voxels_of_row[losers] -= lost.to(torch.int32)
    hypotheses.observations_of_row[losers] -= lost_observations
    hypotheses.changed[losers] = True
    dead: Tensor = losers[hypotheses.voxels_of_row[losers] == 0]
    hypotheses.id_of_row[dead] = -1
    return dead


def _rename(hypotheses: Hypotheses, slots: Tensor, target_of_row: Tensor) -> None:
    """Give the hypotheses of rows that have a target to it, in distinct slots."""
    held = hypotheses.held_row[slots].to(torch.int64)
    counts = hypotheses.held_count[slots].to(torch.int64)
    for k in range(held.shape[1]):
        where = torch.nonzero(target_of_row[held[:, k]] >= 0).squeeze(1)
        targets, arrived = target_of_row[held[where, k]], counts[where, k]
        is_own = held[where] == targets[:, None]
        known, own = is_own.any(dim=1), is_own.to(torch.int64).argmax(dim=1)
        before = torch.where(known, counts[where, own], 0)
        after = (before + arrived).clamp(max=MAX_COUNT)
        column = torch.where(known, own, k)
        # Its place is emptied, unless it is there that the target goes.
        held[where, k], counts[where, k] = -1, 0
        held[where, column], counts[where, column] = targets, after
        hypotheses.voxels_of_row.index_add_(0, targets, (~known).to(torch.int32))
        hypotheses.observations_of_row.index_add_(0, targets, after - before)
    hypotheses.held_row[slots] = held.to(torch.int32)
    hypotheses.held_count[slots] = counts.to(torch.int32)
