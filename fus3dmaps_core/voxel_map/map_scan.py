"""Passes over all voxels of the map that answer a query, in memory that does not grow with the map.

Voxels are scanned block by block, and only the answer is kept: 16 bytes for each of its voxels, 20 with a label, and a few
sums for each instance and prompt. Where there are so many instances and prompts that the sums would be large, the map is
scanned several times, each time for some of the prompts, and the best scores so far are kept.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from fus3dmaps_core.voxel_map.kernels.protocols import (
    SCORE_UNIT,
    Extents,
    ScoredVoxels,
    ScoreSums,
    SlotBlock,
    Texts,
)
from fus3dmaps_core.voxel_map.layer_query import LayerQuery
from fus3dmaps_core.voxel_map.layers.fusion import FusionInputs
from fus3dmaps_core.voxel_map.layers.similarity import layer_named
from fus3dmaps_core.voxel_map.snapshots import InstanceSnapshot, snapshot_instances
from fus3dmaps_core.voxel_map.state import MapState

_BLOCK_VOXELS = 2**17  # Voxels that are left out of an answer together.
_SUM_BYTES = 12 * 2**20
_BLOCK_SUMS = 2**18  # Sums that are compared together.
_NEVER = -(2**63)


@dataclass(frozen=True)
class Finding:
    """The answer of a layer to a query.

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


@dataclass(frozen=True)
class Labelling:
    """Which text fits each voxel of a layer best, and each instance.

    Attributes:
        points_m: (n, 3) float32 centres of the voxels that have the layer, metres, map frame, in the order of slots.
        labels: (n,) int32 place of the text with the highest cosine, of equal ones the first.
        scores: (n,) float32 that cosine.
        instances: The instances of the same moment.
        instance_labels: (i,) int32, for each of these the place of the text with the highest mean cosine over the voxels
            that have the layer and whose top hypothesis it is, of equal ones the first; -1 for one without such voxels.
        instance_scores: (i,) float64 that mean; NaN for one without such voxels.
    """

    points_m: NDArray[np.float32]
    labels: NDArray[np.int32]
    scores: NDArray[np.float32]
    instances: InstanceSnapshot
    instance_labels: NDArray[np.int32]
    instance_scores: NDArray[np.float64]


class _Pass(NamedTuple):
    """The result of a pass for some of the prompts: the place of the first one, their sums, and extents of instances."""

    first: int
    sums: ScoreSums
    extents: Extents


class MapScan:
    """Passes over the voxels of a map, which must not change meanwhile."""

    def __init__(self, state: MapState, fusion: FusionInputs, voxel_size_m: float) -> None:
        """Prepare to scan the content of a map, whose layers are fused as ``fusion`` says."""
        self._state, self._fusion, self._voxel_size_m = state, fusion, voxel_size_m
        self._kernels = fusion.kernels
        self._ids, self._rows = state.instances.live()
        self._device = self._rows.device

    def instances(self) -> InstanceSnapshot:
        """Return all instances alive and what they occupy."""
        extents = self._state.instances.extents()
        nowhere = ScoredVoxels(torch.empty((0, 3)), torch.empty(0))
        for block in self._blocks(0):
            self._kernels.scan(block, self._state.instances.columns(), extents, None, None, -np.inf, nowhere)
        return self._snapshot(extents)

    def search(self, query: LayerQuery, texts: Texts) -> Finding:
        """Answer a query, whose prompts and negatives are given as unit vectors."""
        threshold = -np.inf if query.threshold is None else float(query.threshold)  # Loops are compiled by type.
        answer = _Answer(self._state.hash.high_water, threshold, self._device)
        best: list[tuple[NDArray[np.int64], NDArray[np.float64]]] = []
        for done in self._passes(query.layer, texts, answer):
            best += self._ranked(done.sums, done.extents, query)
        points_m, similarity = answer.voxels()
        return Finding(answer.found, points_m, similarity, self._snapshot(done.extents), best)

    def label(self, layer: str, vectors: Tensor) -> Labelling:
        """Find which of some unit vectors (p, d), at least one, is the most similar to each voxel and instance.

        Equal vectors are compared once, so that rounding, which depends on a text's place, does not choose among them.
        """
        first_of: dict[bytes, int] = {}
        for place, vector in enumerate(vectors.cpu().numpy()):
            first_of.setdefault(vector.tobytes(), place)
        place_of_text = np.array(list(first_of.values()), np.int32)
        distinct = vectors[torch.from_numpy(place_of_text).to(self._device, torch.int64)]
        answer = _Answer(self._state.hash.high_water, -np.inf, self._device, with_labels=True)
        most = torch.full((len(self._rows),), _NEVER, dtype=torch.int64, device=self._device)
        text = torch.zeros_like(most)
        for done in self._passes(layer, Texts(distinct, len(distinct), 1.0), answer):
            highest, which = _highest(done.sums.totals, self._rows)
            text = torch.where(highest > most, which + done.first, text)
            most = torch.maximum(highest, most)
        members = done.sums.members.index_select(0, self._rows).cpu().numpy()
        means = most.cpu().numpy() / np.where(members > 0, SCORE_UNIT * members.astype(np.float64), np.nan)
        points_m, scores = answer.voxels()
        labels, of_instances = answer.labels(), np.where(members > 0, place_of_text[text.cpu().numpy()], np.int32(-1))
        if len(place_of_text) < len(vectors):
            for block in range(0, len(labels), _BLOCK_VOXELS):
                labels[block : block + _BLOCK_VOXELS] = place_of_text[labels[block : block + _BLOCK_VOXELS]]
        return Labelling(points_m, labels, scores, self._snapshot(done.extents), of_instances, means)

    def _passes(self, layer: str, texts: Texts, answer: _Answer) -> Iterator[_Pass]:
        """Scan the map for some of the prompts at a time, and write the answer."""
        instance_rows, begin = self._state.instances.pool.high_water, 0
        prompts, negatives = texts.vectors[: texts.prompts], texts.vectors[texts.prompts :]
        # The sum itself, in an instance layer the instance's own score, and what threads have added up so far.
        bytes_per_prompt = (12 + 8 * torch.get_num_threads()) * max(instance_rows, 1)
        groups = torch.split(prompts, max(1, _SUM_BYTES // bytes_per_prompt))
        for number, group in enumerate(groups):
            few = Texts(torch.cat([group, negatives]), len(group), texts.logit_scale)
            sums = ScoreSums(
                torch.zeros(instance_rows, dtype=torch.int64, device=self._device),
                torch.zeros((instance_rows, len(group)), dtype=torch.int64, device=self._device),
            )
            extents, compared = self._state.instances.extents(), layer_named(layer, self._fusion, self._state.fused, few)
            answer.begin(number + 1, len(groups), begin)
            for block in self._blocks(len(few.vectors)):
                room = answer.room(len(block.keys))
                columns = self._state.instances.columns()
                answer.take(*self._kernels.scan(block, columns, extents, compared, sums, answer.least, room), room)
            yield _Pass(begin, sums, extents)
            begin += len(group)

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
        self, sums: ScoreSums, extents: Extents, query: LayerQuery
    ) -> Iterator[tuple[NDArray[np.int64], NDArray[np.float64]]]:
        """Yield for each prompt the places of the best instances and their mean scores."""
        members, voxels = sums.members.index_select(0, self._rows), extents.voxels.index_select(0, self._rows)
        rankable = torch.nonzero((members > 0) & (voxels >= query.min_voxels)).squeeze(1)
        rows, counts = self._rows.index_select(0, rankable), members.index_select(0, rankable).cpu().numpy()
        places = rankable.cpu().numpy()
        for totals in sums.totals.unbind(1):
            means = totals.index_select(0, rows).cpu().numpy() / (SCORE_UNIT * counts.astype(np.float64))
            chosen = _largest(means, query.top_k)
            yield places[chosen], means[chosen]


class _Answer:
    """Collects the voxels of an answer. Each pass over the map, for some of the prompts, brings the same voxels."""

    def __init__(self, slots: int, threshold: float, device: torch.device, with_labels: bool = False) -> None:
        """Start for a map with so many slots; with labels, remember which prompt is best."""
        self._threshold, self._device = threshold, device
        # As large as the answer can become; pages that are never written are never real.
        self._points_m, self._best = np.empty((slots, 3), np.float32), np.empty(slots, np.float32)
        self._labels = np.empty(slots, np.int32) if with_labels else None
        self._first, self._first_prompt = True, 0
        self.kept = self.found = 0
        self.least = -np.inf
        """A pass can leave out voxels with a score below this."""

    def begin(self, number: int, passes: int, first_prompt: int) -> None:
        """Begin a pass, counted from 1, for prompts from this one on."""
        self._first, self._first_prompt = number == 1, first_prompt
        self.kept = self.found = 0
        self.least = self._threshold if passes == 1 else -np.inf

    def room(self, length: int) -> ScoredVoxels:
        """Return the room that the next block's voxels are written to."""
        if self._first and self._device.type == "cpu":
            here = slice(self.kept, self.kept + length)
            which = None if self._labels is None else torch.from_numpy(self._labels[here])
            return ScoredVoxels(torch.from_numpy(self._points_m[here]), torch.from_numpy(self._best[here]), which)
        which = None if self._labels is None else torch.empty(length, dtype=torch.int32, device=self._device)
        return ScoredVoxels(torch.empty((length, 3), device=self._device), torch.empty(length, device=self._device), which)

    def take(self, found: int, count: int, room: ScoredVoxels) -> None:
        """Take over ``count`` voxels that were written into the room, of ``found`` that have the layer."""
        here = slice(self.kept, self.kept + count)
        if not self._first:
            best = room.best[:count].cpu().numpy()
            if self._labels is not None and room.which is not None:
                which = room.which[:count].cpu().numpy()
                np.add(which, self._first_prompt, out=self._labels[here], where=best > self._best[here])
            np.maximum(self._best[here], best, out=self._best[here])
        elif self._device.type != "cpu":
            self._points_m[here], self._best[here] = room.centers_m[:count].cpu().numpy(), room.best[:count].cpu().numpy()
            if self._labels is not None and room.which is not None:
                self._labels[here] = room.which[:count].cpu().numpy()
        self.kept += count
        self.found += found

    def labels(self) -> NDArray[np.int32]:
        """Return which prompt is best for each voxel, of equal ones the first; needs labels and no threshold."""
        return np.empty(0, np.int32) if self._labels is None else self._labels[: self.kept]

    def voxels(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return centres and scores of the voxels that reach the threshold."""
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


def _highest(totals: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
    """Find the largest of each of some rows of sums (rows, p), and which it is, of equal ones the first: (n,) int64."""
    most, which = [totals.new_zeros(0)], [totals.new_zeros(0)]
    for some in torch.split(rows, max(1, _BLOCK_SUMS // totals.shape[1])):
        highest = totals.index_select(0, some).max(dim=1)
        most.append(highest.values)
        which.append(highest.indices)
    return torch.cat(most), torch.cat(which)


def _largest(values: NDArray[np.float64], count: int) -> NDArray[np.int64]:
    """Find the places of the largest values, largest first, equal ones in their order."""
    places = np.arange(len(values))
    if len(values) > count:
        places = np.flatnonzero(values >= np.partition(values, len(values) - count)[len(values) - count])
    return places[np.argsort(-values[places], kind="stable")][:count]
