"""A question to a layer of the map: passes over all voxels, in memory that does not follow the size of the map.

Voxels are looked at block by block, and only the answer is kept: 16 bytes for each voxel of it, and a few sums for each
instance and prompt. Where there are so many of both that the sums would be large, prompts are taken some at a time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields

import numpy as np
import torch
from numpy.typing import NDArray

from fus3dmaps_core.kernels.protocols import (
    SCORE_UNIT,
    EmbeddedLayer,
    Extents,
    InheritedLayer,
    Kernels,
    ScoredVoxels,
    ScoreSums,
    SlotBlock,
    Texts,
)
from fus3dmaps_core.map_state import MapState
from fus3dmaps_core.snapshots import InstanceSnapshot, snapshot_instances

_BLOCK_VOXELS = 2**17  # Voxels that are left out of an answer together.
_SUM_BYTES = 12 * 2**20


@dataclass(frozen=True)
class Question:
    """What is asked of a layer.

    Attributes:
        texts: Prompts, what they are compared against, and the logit scale.
        threshold: Voxels with a lower score are left out; None leaves none out.
        top_k: At most this many instances per prompt.
        min_voxels: Instances that occupy fewer voxels are not ranked.
    """

    texts: Texts
    threshold: float | None
    top_k: int
    min_voxels: int


@dataclass(frozen=True)
class Finding:
    """What a layer answers.

    Attributes:
        voxels: How many voxels have the layer.
        points_m: (n, 3) float32 centres of those that reach the threshold, metres, map frame, in the order of slots.
        similarity: (n,) float32 score of each: the best over the prompts.
        instances: The instances of the same moment.
        best: For each prompt the places in ``instances`` of the best, at most ``top_k``, and their scores; ties by id.
    """

    voxels: int
    points_m: NDArray[np.float32]
    similarity: NDArray[np.float32]
    instances: InstanceSnapshot
    best: list[tuple[NDArray[np.int64], NDArray[np.float64]]]


class Survey:
    """Passes over the voxels of a map that nobody changes meanwhile."""

    def __init__(self, state: MapState, kernels: Kernels, voxel_size_m: float) -> None:
        """Of a map's content."""
        self._state, self._kernels, self._voxel_size_m = state, kernels, voxel_size_m
        self._ids, self._rows = state.instances.live()
        self._device = self._rows.device

    def instances(self) -> InstanceSnapshot:
        """All instances alive and what they occupy."""
        extents = self._state.instances.extents()
        nowhere = ScoredVoxels(torch.empty((0, 3)), torch.empty(0))
        for block in self._blocks(0):
            self._kernels.scan(block, self._state.instances.columns(), extents, None, None, -np.inf, nowhere)
        return self._snapshot(extents)

    def search(self, layer_of: Callable[[Texts], EmbeddedLayer | InheritedLayer], question: Question) -> Finding:
        """Answer a question.

        Args:
            layer_of: Makes the layer that is asked, compared with some of the prompts and all negatives.
            question: What is asked.
        """
        texts, instance_rows = question.texts, self._state.instances.pool.high_water
        prompts, negatives = texts.vectors[: texts.prompts], texts.vectors[texts.prompts :]
        # The sum itself, in an instance layer the instance's own score, and what threads have added up so far.
        bytes_per_prompt = (12 + 8 * torch.get_num_threads()) * max(instance_rows, 1)
        groups = torch.split(prompts, max(1, _SUM_BYTES // bytes_per_prompt))
        threshold = -np.inf if question.threshold is None else question.threshold
        answer = _Answer(self._state.hash.high_water, threshold, self._device)
        best: list[tuple[NDArray[np.int64], NDArray[np.float64]]] = []
        for number, group in enumerate(groups):
            few = Texts(torch.cat([group, negatives]), len(group), texts.logit_scale)
            sums = ScoreSums(
                torch.zeros(instance_rows, dtype=torch.int64, device=self._device),
                torch.zeros((instance_rows, len(group)), dtype=torch.int64, device=self._device),
            )
            extents, layer = self._state.instances.extents(), layer_of(few)
            answer.begin(number + 1, len(groups))
            for block in self._blocks(len(few.vectors)):
                room = answer.room(len(block.keys))
                columns = self._state.instances.columns()
                answer.take(*self._kernels.scan(block, columns, extents, layer, sums, answer.least, room), room)
            best += self._ranked(sums, extents, question)
        points_m, similarity = answer.voxels()
        return Finding(answer.found, points_m, similarity, self._snapshot(extents), best)

    def _blocks(self, texts: int) -> Iterator[SlotBlock]:
        voxels, dense = self._state.hash, self._state.dense
        step = self._kernels.scan_limit(texts)
        for first in range(0, voxels.high_water, step):
            slots = slice(first, min(first + step, voxels.high_water))
            yield SlotBlock(first, voxels.keys(slots), dense.row_of_slot(slots), self._voxel_size_m)

    def _snapshot(self, extents: Extents) -> InstanceSnapshot:
        of_rows = Extents(*(getattr(extents, field.name).index_select(0, self._rows) for field in fields(Extents)))
        weights, hypotheses = self._state.instances.weights(self._rows), self._state.instances.voxels(self._rows)
        return snapshot_instances(self._ids, weights, hypotheses, of_rows, self._voxel_size_m)

    def _ranked(
        self, sums: ScoreSums, extents: Extents, question: Question
    ) -> Iterator[tuple[NDArray[np.int64], NDArray[np.float64]]]:
        """For each prompt the places of the best instances, by ascending id, and their mean scores."""
        members, voxels = sums.members.index_select(0, self._rows), extents.voxels.index_select(0, self._rows)
        rankable = torch.nonzero((members > 0) & (voxels >= question.min_voxels)).squeeze(1)
        rows, counts = self._rows.index_select(0, rankable), members.index_select(0, rankable).cpu().numpy()
        places = rankable.cpu().numpy()
        for totals in sums.totals.unbind(1):
            means = totals.index_select(0, rows).cpu().numpy() / (SCORE_UNIT * counts.astype(np.float64))
            chosen = _largest(means, question.top_k)
            yield places[chosen], means[chosen]


class _Answer:
    """Voxels of an answer as they come; each pass over the map, for some of the prompts, brings the same ones."""

    def __init__(self, slots: int, threshold: float, device: torch.device) -> None:
        """For a map whose voxels are in so many slots."""
        self._threshold, self._device = threshold, device
        # As large as the answer can become; pages that are never written are never real.
        self._points_m, self._best = np.empty((slots, 3), np.float32), np.empty(slots, np.float32)
        self._first = True
        self.kept = self.found = 0
        self.least = -np.inf
        """Scores of voxels that a pass can leave out at once are below this."""

    def begin(self, number: int, passes: int) -> None:
        """Before a pass, counted from 1."""
        self._first = number == 1
        self.kept = self.found = 0
        self.least = self._threshold if passes == 1 else -np.inf

    def room(self, length: int) -> ScoredVoxels:
        """Where the next block's voxels go."""
        if self._first and self._device.type == "cpu":
            here = slice(self.kept, self.kept + length)
            return ScoredVoxels(torch.from_numpy(self._points_m[here]), torch.from_numpy(self._best[here]))
        return ScoredVoxels(torch.empty((length, 3), device=self._device), torch.empty(length, device=self._device))

    def take(self, found: int, count: int, room: ScoredVoxels) -> None:
        """Take ``count`` voxels that were written into the room, of ``found`` that have the layer."""
        here = slice(self.kept, self.kept + count)
        if not self._first:
            np.maximum(self._best[here], room.best[:count].cpu().numpy(), out=self._best[here])
        elif self._device.type != "cpu":
            self._points_m[here], self._best[here] = room.centers_m[:count].cpu().numpy(), room.best[:count].cpu().numpy()
        self.kept += count
        self.found += found

    def voxels(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Centres and scores of the voxels that reach the threshold."""
        points_m, best = self._points_m[: self.kept], self._best[: self.kept]
        if self.least >= self._threshold:
            return points_m, best
        end = 0
        for first in range(0, self.kept, _BLOCK_VOXELS):
            block = slice(first, first + _BLOCK_VOXELS)
            chosen = best[block] >= self._threshold
            count = int(np.count_nonzero(chosen))
            points_m[end : end + count], best[end : end + count] = points_m[block][chosen], best[block][chosen]
            end += count
        return points_m[:end], best[:end]


def _largest(values: NDArray[np.float64], count: int) -> NDArray[np.int64]:
    """Places of the largest values, largest first, equal ones in their order."""
    places = np.arange(len(values))
    if len(values) > count:
        places = np.flatnonzero(values >= np.partition(values, len(values) - count)[len(values) - count])
    return places[np.argsort(-values[places], kind="stable")][:count]
