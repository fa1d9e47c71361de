"""The inner loops compiled by numba, for the CPU. Long ones are shared among torch's number of threads."""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from fus3dmaps_core.voxel_map.kernels import (
    numba_cosines,
    numba_fusion,
    numba_instances,
    numba_points,
    numba_rows,
    numba_scan,
)
from fus3dmaps_core.voxel_map.kernels.keys import BITS, HALF
from fus3dmaps_core.voxel_map.kernels.numba_values import stored
from fus3dmaps_core.voxel_map.kernels.protocols import (
    DELETED,
    EMPTY,
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
from fus3dmaps_core.voxel_map.kernels.workers import Lanes, Workers, cuts
from fus3dmaps_core.voxel_map.rows.row_pool import RowPool
from fus3dmaps_core.voxel_map.rows.scratch import Scratch

_LANES = 2  # Fixed, so that sums over many voxels do not depend on the number of threads; each lane has sums of its own.
_PART_VALUES = 256 * 1024  # Work of some 0.1 ms: less is not worth a second thread.
_SCAN_SLOTS = 8192  # Of a scan, the same.


class CompiledKernels:
    """:class:`Kernels` as compiled loops. Results do not depend on the number of threads."""

    def __init__(self) -> None:
        """Prepare threads and memory. numba compiles each loop at its first call, or takes it from its cache."""
        self._workers = Workers()
        self._scratch = Scratch()

    @property
    def scratch_nbytes(self) -> int:
        """Bytes that are kept for the next call."""
        return self._scratch.nbytes

    def voxel_keys(self, points_m: Tensor, voxel_size_m: float) -> tuple[Tensor, float]:
        keys = np.empty(len(points_m), np.int64)
        largest = numba_points.voxel_keys(points_m.contiguous().numpy(), voxel_size_m, HALF, BITS, keys)
        return torch.from_numpy(keys), float(largest)

    def unit_rows(self, values: Tensor) -> tuple[Tensor, int]:
        if values.dtype not in (torch.float32, torch.float64):
            values = values.to(torch.float32)
        units = np.empty(values.shape, np.float32)
        failures = self._share(numba_rows.unit_rows, len(values), values.shape[1], values.contiguous().numpy(), units)
        return torch.from_numpy(units), max(failures)

    def distinct(self, keys: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        # In the order of first appearance.
        unique, inverse, counts = (np.empty(len(keys), np.int64) for _ in range(3))
        found = numba_points.distinct(keys.numpy(), unique, inverse, counts)
        return torch.from_numpy(unique[:found]), torch.from_numpy(inverse), torch.from_numpy(counts[:found])

    def count_pairs(self, first: Tensor, second: Tensor, groups: int, partners: int) -> GroupedCounts:
        # Partners of a group in the order of first appearance.
        offsets = np.empty(groups + 1, np.int64)
        found, counts = np.empty(len(first), np.int64), np.empty(len(first), np.int64)
        numba_points.count_pairs(first.numpy(), second.numpy(), partners, offsets, found, counts)
        end = int(offsets[-1])
        return GroupedCounts(torch.from_numpy(offsets), torch.from_numpy(found[:end]), torch.from_numpy(counts[:end]))

    def find(self, table: HashTable, keys: Tensor) -> Tensor:
        slots = np.empty(len(keys), np.int64)
        numba_points.find(table.keys.numpy(), table.slots.numpy(), _shift(table), EMPTY, keys.numpy(), slots)
        return torch.from_numpy(slots)

    def place(self, table: HashTable, keys: Tensor, slots: Tensor) -> None:
        numba_points.place(table.keys.numpy(), table.slots.numpy(), _shift(table), EMPTY, keys.numpy(), slots.numpy())

    def mark_deleted(self, table: HashTable, keys: Tensor) -> None:
        numba_points.mark_deleted(table.keys.numpy(), _shift(table), DELETED, keys.numpy())

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
        arrays = (rows, old, new, seeds, groups.offsets, groups.partners, amounts, embeddings.contiguous())
        pooled = (*stored(pool), pool.scales[:].numpy())
        self._share(numba_rows.merge_means, len(rows), pool.dimension, *pooled, *(each.numpy() for each in arrays))

    def associate(
        self,
        hypotheses: Hypotheses,
        proposals: GroupedCounts,
        spare_rows: Tensor,
        next_id: int,
        iou_threshold: float,
        hidden_of_row: Tensor | None = None,
    ) -> Association:
        matched, ids = (np.empty(len(proposals.offsets) - 1, np.int64) for _ in range(2))
        dead = np.empty(len(hypotheses.id_of_row), np.int64)
        created, died = numba_instances.associate(
            proposals.offsets.numpy(),
            proposals.partners.numpy(),
            proposals.counts.numpy(),
            spare_rows.numpy(),
            next_id,
            iou_threshold,
            np.empty(0, np.int32) if hidden_of_row is None else hidden_of_row.numpy(),
            hypotheses.held_row.numpy(),
            hypotheses.held_count.numpy(),
            hypotheses.id_of_row.numpy(),
            hypotheses.voxels_of_row.numpy(),
            hypotheses.observations_of_row.numpy(),
            hypotheses.changed.numpy(),
            matched,
            ids,
            dead,
        )
        died_rows = torch.from_numpy(dead[:died].copy())
        return Association(torch.from_numpy(matched), torch.from_numpy(ids), int(created), died_rows)

    def holders(self, held_row: Tensor, rows: Tensor, row_count: int) -> Tensor:
        with self._scratch.lend((len(held_row),), np.int64) as slots:
            found = numba_instances.holders(held_row.numpy(), rows.numpy(), np.zeros(row_count, np.bool_), slots)
            return torch.from_numpy(slots[:found].copy())

    def shared_voxels(self, held_row: Tensor, rows: Tensor, row_count: int) -> Tensor:
        shared = np.zeros((len(rows), len(rows)), np.int64)
        numba_instances.shared_voxels(held_row.numpy(), rows.numpy(), np.full(row_count, -1, np.int32), shared)
        return torch.from_numpy(shared)

    def merge(self, hypotheses: Hypotheses, slots: Tensor, gone: Tensor, into: Tensor) -> None:
        numba_instances.merge(
            slots.numpy(),
            gone.numpy(),
            into.numpy(),
            np.full(len(hypotheses.id_of_row), -1, np.int32),
            hypotheses.held_row.numpy(),
            hypotheses.held_count.numpy(),
            hypotheses.id_of_row.numpy(),
            hypotheses.voxels_of_row.numpy(),
            hypotheses.observations_of_row.numpy(),
            hypotheses.changed.numpy(),
        )

    def top_hypotheses(self, hypotheses: Hypotheses, slots: Tensor) -> tuple[Tensor, Tensor]:
        rows, counts = np.empty(len(slots), np.int32), np.empty(len(slots), np.int32)
        numba_scan.top_hypotheses(slots.numpy(), *_held(hypotheses), rows, counts)
        return torch.from_numpy(rows).to(torch.int64), torch.from_numpy(counts).to(torch.int64)

    def scan_limit(self, texts: int) -> int:
        # Parts of a scan are small, so only the room for its result counts.
        return 2**20

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
        asked = _asked(layer)
        slots, rows, sums_width = len(block.keys), len(hypotheses.id_of_row), 0 if sums is None else asked.prompts + 1
        parts = cuts(slots, _SCAN_SLOTS)
        found, kept = [0] * len(parts), [0] * len(parts)
        keys, dense_rows, held = block.keys.numpy(), block.dense_rows.numpy(), _held(hypotheses)
        known = [getattr(extents, each).numpy() for each in ("voxels", "counts", "sums", "low", "high")]
        if sums is not None:
            known += [sums.members.numpy(), sums.totals.numpy()]
        else:
            known += [np.empty(0, np.int64), np.empty((0, 0), np.int64)]
        room = [room_for.centers_m.numpy(), room_for.best.numpy()]
        room.append(np.empty(0, np.int32) if room_for.which is None else room_for.which.numpy())
        adding = threading.Lock()

        def look(number: int, first: int, last: int) -> None:
            most, here = min(rows, last - first), slice(first, last)
            with (
                self._scratch.lend((rows,), np.int32) as part_of_row,
                self._scratch.lend((most,), np.int32) as row_of_part,
                self._scratch.lend((most, numba_scan.EXTENT_COLUMNS), np.int64) as part_extents,
                self._scratch.lend((most, sums_width), np.int64) as part_sums,
            ):
                part_of_row.fill(-1)
                voxels = numba_scan.Voxels(block.first + first, keys[here], dense_rows[here], block.voxel_size_m)
                table = numba_scan.Table(part_of_row, row_of_part, part_extents, part_sums)
                room_here = numba_scan.Room(*(each[here] for each in room))
                used, found[number], kept[number] = numba_scan.scan(voxels, held, asked, threshold, table, room_here)
                with adding:
                    numba_scan.add_parts(row_of_part[:used], part_extents[:used], part_sums[:used], *known)

        self._workers.run([partial(look, number, *part) for number, part in enumerate(parts)])
        end = 0
        for (first, _), count in zip(parts, kept, strict=True):
            if first != end:
                for array in room:
                    array[end : end + count] = array[first : first + count].copy()
            end += count
        return sum(found), end

    def farther(self, keys: Tensor, voxel_size_m: float, point_m: Tensor, radius_m: float) -> Tensor:
        places = np.empty(len(keys), np.int64)
        found = numba_points.farther(keys.numpy(), voxel_size_m, HALF, BITS, point_m.numpy(), radius_m, places)
        return torch.from_numpy(places[:found])

    def centers(self, keys: Tensor, voxel_size_m: float) -> Tensor:
        centers = np.empty((len(keys), 3), np.float32)
        numba_points.centers(keys.numpy(), voxel_size_m, HALF, BITS, centers)
        return torch.from_numpy(centers)

    def cosines(self, pool: RowPool, rows: Tensor, texts: Tensor) -> Tensor:
        found = np.empty((len(rows), len(texts)), np.float32)
        arrays = (rows.numpy(), texts.contiguous().numpy(), found)
        self._share(numba_cosines.cosines, len(rows), pool.dimension, *stored(pool), *arrays)
        return torch.from_numpy(found)

    def fuse(self, voxels: FusionRows, rows: Tensor, own: RowPool, amounts: Tensor, bars: Tensor, target: RowPool) -> Tensor:
        pool, count = voxels.pool, len(rows)
        place = np.full(own.high_water, -1, np.int32)
        place[rows.numpy()] = np.arange(count, dtype=np.int32)
        arrays = [each.numpy() for each in (voxels.slot_of_row, voxels.weight_of_row, voxels.held_row)]
        totals, known = np.zeros((_LANES, count)), np.zeros((_LANES, count), np.bool_)
        evidence = np.empty(count)
        parts = min(count, voxels.held_row.shape[1] * pool.block_rows)

        blocks = -(-len(voxels.slot_of_row) // pool.block_rows)
        lanes = Lanes(blocks, _LANES)

        with self._scratch.lend((_LANES, count, pool.dimension), np.float64) as sums:

            def add() -> None:
                with self._scratch.lend((parts, pool.dimension), np.float32) as room:
                    for lane, first, last in lanes:
                        which = (first, last, _LANES, room, sums[lane], totals[lane], known[lane])
                        numba_fusion.add_rows(*stored(pool), pool.scales[:].numpy(), *arrays, place, *which)

            self._workers.run([add] * _LANES)
            rest = (
                rows.numpy(),
                own.addresses,
                amounts.numpy(),
                target.addresses,
                stored(target)[-1],
                bars.numpy(),
                evidence,
            )
            write = (sums, totals, known, *rest)
            self._share(numba_fusion.write_fused, count, pool.dimension, *write)
        return torch.from_numpy(evidence)

    def _share(self, loop: Callable[..., Any], count: int, width: int, *arguments: Any) -> list[Any]:
        """Run a loop over [0, count) in parts; returns what the parts return."""
        parts = cuts(count, _PART_VALUES // width)
        return self._workers.run([partial(loop, *arguments, start, stop) for start, stop in parts])


def _shift(table: HashTable) -> int:
    return 65 - len(table.keys).bit_length()


def _held(hypotheses: Hypotheses) -> numba_scan.Held:
    return numba_scan.Held(hypotheses.held_row.numpy(), hypotheses.held_count.numpy(), hypotheses.id_of_row.numpy())


def _asked(layer: EmbeddedLayer | InheritedLayer | None) -> numba_scan.Asked:
    if layer is None:
        return numba_scan.Asked()
    if isinstance(layer, InheritedLayer):
        scores = layer.scores_of_row.numpy()
        return numba_scan.Asked(numba_scan.INSTANCES, prompts=scores.shape[1], scores_of_row=scores)
    tag, size, addresses, shift = stored(layer.pool)
    asked = numba_scan.Asked(
        numba_scan.DENSE,
        tag,
        size,
        addresses,
        shift,
        layer.pool.scales[:].numpy(),
        layer.weight_of_row.numpy(),
        texts=layer.texts.vectors.contiguous().numpy(),
        prompts=layer.texts.prompts,
        logit_scale=layer.texts.logit_scale,
    )
    if layer.own is None:
        return asked
    own = stored(layer.own)
    return asked._replace(
        layer=numba_scan.FUSED, own_addresses=own[2], own_shift=own[3], variance_ratio=np.float32(layer.variance_ratio)
    )
