"""The inner loops compiled by numba, for the CPU. Long ones are shared among torch's number of threads."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from fus3dmaps_core.kernels import numba_instances, numba_points, numba_rows
from fus3dmaps_core.kernels.keys import BITS, HALF
from fus3dmaps_core.kernels.protocols import (
    DELETED,
    EMPTY,
    Association,
    Extents,
    HashTable,
    Hypotheses,
    Pairs,
    SlotBlock,
    VoxelBlock,
)
from fus3dmaps_core.memory.rows import RowPool

_KINDS = {torch.float32: numba_rows.FLOAT32, torch.float16: numba_rows.FLOAT16, torch.int8: numba_rows.INT8}
_LANES = 2  # Fixed, so that sums over many voxels do not depend on the number of threads; each lane has sums of its own.
_PART_VALUES = 256 * 1024  # Work of some 0.1 ms: less is not worth a second thread.
_PARTS_PER_THREAD = 4


class CompiledKernels:
    """Kernels as compiled loops. Results do not depend on the number of threads."""

    def __init__(self) -> None:
        """Compiles nothing yet: numba does at the first call of each loop, or takes it from its cache."""
        self._executor: ThreadPoolExecutor | None = None

    def voxel_keys(self, points_m: Tensor, voxel_size_m: float) -> tuple[Tensor, float]:
        """As the protocol says."""
        keys = np.empty(len(points_m), np.int64)
        largest = numba_points.voxel_keys(points_m.contiguous().numpy(), voxel_size_m, HALF, BITS, keys)
        return torch.from_numpy(keys), float(largest)

    def unit_rows(self, values: Tensor) -> tuple[Tensor, int]:
        """As the protocol says."""
        if values.dtype not in (torch.float32, torch.float64):
            values = values.to(torch.float32)
        units = np.empty(values.shape, np.float32)
        failures = self._share(numba_rows.unit_rows, len(values), values.shape[1], values.contiguous().numpy(), units)
        return torch.from_numpy(units), max(failures)

    def distinct(self, keys: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """As the protocol says: in the order of first appearance."""
        unique, inverse, counts = (np.empty(len(keys), np.int64) for _ in range(3))
        found = numba_points.distinct(keys.numpy(), unique, inverse, counts)
        return torch.from_numpy(unique[:found]), torch.from_numpy(inverse), torch.from_numpy(counts[:found])

    def count_pairs(self, first: Tensor, second: Tensor, groups: int, partners: int) -> Pairs:
        """As the protocol says: partners of a group in the order of first appearance."""
        offsets = np.empty(groups + 1, np.int64)
        found, counts = np.empty(len(first), np.int64), np.empty(len(first), np.int64)
        numba_points.count_pairs(first.numpy(), second.numpy(), partners, offsets, found, counts)
        end = int(offsets[-1])
        return Pairs(torch.from_numpy(offsets), torch.from_numpy(found[:end]), torch.from_numpy(counts[:end]))

    def find(self, table: HashTable, keys: Tensor) -> Tensor:
        """As the protocol says."""
        slots = np.empty(len(keys), np.int64)
        numba_points.find(table.keys.numpy(), table.slots.numpy(), _shift(table), EMPTY, keys.numpy(), slots)
        return torch.from_numpy(slots)

    def place(self, table: HashTable, keys: Tensor, slots: Tensor) -> None:
        """As the protocol says."""
        numba_points.place(table.keys.numpy(), table.slots.numpy(), _shift(table), EMPTY, keys.numpy(), slots.numpy())

    def bury(self, table: HashTable, keys: Tensor) -> None:
        """As the protocol says."""
        numba_points.bury(table.keys.numpy(), _shift(table), DELETED, keys.numpy())

    def merge_means(
        self,
        pool: RowPool,
        rows: Tensor,
        old: Tensor,
        new: Tensor,
        seeds: Tensor,
        groups: Pairs,
        amounts: Tensor,
        embeddings: Tensor,
    ) -> None:
        """As the protocol says."""
        arrays = (rows, old, new, seeds, groups.offsets, groups.partners, amounts, embeddings.contiguous())
        self._share(numba_rows.merge_means, len(rows), pool.dimension, *_stored(pool), *(each.numpy() for each in arrays))

    def integrate(
        self, hypotheses: Hypotheses, proposals: Pairs, spare_rows: Tensor, next_id: int, iou_threshold: float
    ) -> Association:
        """As the protocol says."""
        matched, ids = (np.empty(len(proposals.offsets) - 1, np.int64) for _ in range(2))
        dead = np.empty(len(hypotheses.id_of_row), np.int64)
        created, died = numba_instances.integrate(
            proposals.offsets.numpy(),
            proposals.partners.numpy(),
            proposals.counts.numpy(),
            spare_rows.numpy(),
            next_id,
            iou_threshold,
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

    def top_hypotheses(self, hypotheses: Hypotheses, slots: Tensor) -> tuple[Tensor, Tensor]:
        """As the protocol says."""
        rows, counts = np.empty(len(slots), np.int64), np.empty(len(slots), np.int64)
        held = (hypotheses.held_row.numpy(), hypotheses.held_count.numpy(), hypotheses.id_of_row.numpy())
        numba_instances.top_hypotheses(slots.numpy(), *held, rows, counts)
        return torch.from_numpy(rows), torch.from_numpy(counts)

    def survey(
        self, block: SlotBlock, hypotheses: Hypotheses, extents: Extents, with_dense: bool, with_instance: bool
    ) -> VoxelBlock:
        """As the protocol says."""
        count = len(block.keys)
        centers_m = np.empty((count, 3), np.float32)
        dense_rows, top_rows, top_counts = (np.empty(count, np.int64) for _ in range(3))
        held = (hypotheses.held_row, hypotheses.held_count, hypotheses.id_of_row)
        occupied = (extents.voxels, extents.counts, extents.sums, extents.low, extents.high)
        picked = numba_instances.survey(
            block.first,
            block.voxel_size_m,
            BITS,
            HALF,
            with_dense,
            with_instance,
            *(each.numpy() for each in (block.keys, block.dense_rows, *held, *occupied)),
            centers_m,
            dense_rows,
            top_rows,
            top_counts,
        )
        arrays = (each[:picked] for each in (centers_m, dense_rows, top_rows, top_counts))
        return VoxelBlock(*(torch.from_numpy(each) for each in arrays))

    def farther(self, keys: Tensor, voxel_size_m: float, point_m: Tensor, radius_m: float) -> Tensor:
        """As the protocol says."""
        places = np.empty(len(keys), np.int64)
        found = numba_points.farther(keys.numpy(), voxel_size_m, HALF, BITS, point_m.numpy(), radius_m, places)
        return torch.from_numpy(places[:found])

    def centers(self, keys: Tensor, voxel_size_m: float) -> Tensor:
        """As the protocol says."""
        centers = np.empty((len(keys), 3), np.float32)
        numba_points.centers(keys.numpy(), voxel_size_m, HALF, BITS, centers)
        return torch.from_numpy(centers)

    def cosines(self, pool: RowPool, rows: Tensor, texts: Tensor) -> Tensor:
        """As the protocol says."""
        found = np.empty((len(rows), len(texts)), np.float32)
        arrays = (rows.numpy(), texts.contiguous().numpy(), found)
        self._share(numba_rows.cosines, len(rows), pool.dimension, *_stored(pool), *arrays)
        return torch.from_numpy(found)

    def fused_cosines(
        self,
        pool: RowPool,
        rows: Tensor,
        weights: Tensor,
        own_pool: RowPool,
        own_rows: Tensor,
        own_weights: Tensor,
        texts: Tensor,
    ) -> Tensor:
        """As the protocol says."""
        found = np.empty((len(rows), len(texts)), np.float32)
        dense = (*_stored(pool), rows.numpy(), weights.numpy())
        own = (own_pool.addresses, own_pool.block_rows, own_rows.numpy(), own_weights.numpy())
        self._share(numba_rows.fused_cosines, len(rows), pool.dimension, *dense, *own, texts.contiguous().numpy(), found)
        return torch.from_numpy(found)

    def weighted_sums(
        self,
        pool: RowPool,
        slot_of_row: Tensor,
        weight_of_row: Tensor,
        held_row: Tensor,
        place_of_instance: Tensor,
        places: int,
    ) -> tuple[Tensor, Tensor]:
        """As the protocol says."""
        arrays = [each.numpy() for each in (slot_of_row, weight_of_row, held_row, place_of_instance)]
        sums = [np.zeros((places, pool.dimension)) for _ in range(_LANES)]
        totals = [np.zeros(places) for _ in range(_LANES)]

        def add(lane: int) -> None:
            numba_rows.weighted_sums(*_stored(pool), *arrays, lane, _LANES, sums[lane], totals[lane])

        self._run([partial(add, lane) for lane in range(_LANES)])
        for lane in range(1, _LANES):
            sums[0] += sums[lane]
            totals[0] += totals[lane]
        return torch.from_numpy(sums[0]), torch.from_numpy(totals[0])

    def _share(self, loop: Callable[..., Any], count: int, width: int, *arguments: Any) -> list[Any]:
        """Run a loop over [0, count) in parts; returns what the parts return."""
        parts = min(1 + count * width // _PART_VALUES, _PARTS_PER_THREAD * torch.get_num_threads())
        cuts = [count * part // parts for part in range(parts + 1)]
        return self._run([partial(loop, *arguments, start, stop) for start, stop in itertools.pairwise(cuts)])

    def _run(self, tasks: list[Callable[[], Any]]) -> list[Any]:
        """Run independent tasks on this thread and helpers; returns what they return, in order.

        On a busy machine a helper may have to wait for a core longer than the whole work takes. So tasks are taken from a
        common list, and this thread waits only for those that a helper has begun.
        """
        results: list[Any] = [None] * len(tasks)
        waiting = iter(range(len(tasks)))  # Taking the next number is atomic.

        def work() -> None:
            for index in waiting:
                results[index] = tasks[index]()

        helpers = min(torch.get_num_threads(), len(tasks)) - 1
        if helpers and self._executor is None:
            self._executor = ThreadPoolExecutor(torch.get_num_threads() - 1, thread_name_prefix="map_kernels")
        futures = [self._executor.submit(work) for _ in range(helpers)] if self._executor else []
        work()
        for future in futures:
            if not future.cancel():
                future.result()
        return results


def _shift(table: HashTable) -> int:
    return 65 - len(table.keys).bit_length()


def _stored(pool: RowPool) -> tuple[Any, ...]:
    return _KINDS[pool.dtype], pool.addresses, pool.block_rows, pool.scales[:].numpy()
