"""The interface of the map's inner loops. Tensors live on one device; no call changes more than it says."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from torch import Tensor

from fus3dmaps_core.voxel_map.rows.row_pool import RowPool

EMPTY, DELETED = -1, -2
"""Contents of cells of a hash table without a key. Probing ends at an empty cell and goes on past a deleted one."""


MAX_COUNT = 2**31 - 1
"""Largest count of a hypothesis; counts stop growing here."""

SCORE_UNIT = 2**30
"""Scores are summed as integers of steps this small: whatever the order, the sum is the same, and 2^32 of them fit."""


@dataclass(frozen=True)
class HashTable:
    """An open-addressing table with linear probing.

    Attributes:
        keys: (c,) int64, c being a power of two: keys, EMPTY or DELETED.
        slots: (c,) int32 slot of each key.
    """

    keys: Tensor
    slots: Tensor


@dataclass(frozen=True)
class GroupedCounts:
    """Counts of partners in groups: a sparse matrix, stored by rows.

    Attributes:
        offsets: (groups + 1,) int64, where each group begins in the other two, and where the last one ends.
        partners: (n,) int64.
        counts: (n,) int64, positive.
    """

    offsets: Tensor
    partners: Tensor
    counts: Tensor


@dataclass(frozen=True)
class Hypotheses:
    """The columns of the instance layer that association works on.

    Attributes:
        held_row: (slots, K) int32 rows of the instances that a voxel holds, -1 where empty.
        held_count: (slots, K) int32 their counts.
        id_of_row: (rows,) int64 ids, -1 for a row without an instance.
        voxels_of_row: (rows,) int32 |V_id|.
        observations_of_row: (rows,) int64 sum of an instance's counts.
        changed: (rows,) bool, set where an instance's voxels or counts change.
    """

    held_row: Tensor
    held_count: Tensor
    id_of_row: Tensor
    voxels_of_row: Tensor
    observations_of_row: Tensor
    changed: Tensor


@dataclass(frozen=True)
class Extents:
    """What instances occupy, by their row: sums over the voxels whose top hypothesis they are.

    Attributes:
        voxels: (rows,) int64, how many these are.
        counts: (rows,) int64, sum of their top counts.
        sums: (rows, 3) int64, sum of top count times voxel coordinate.
        low: (rows, 3) int64, smallest voxel coordinates.
        high: (rows, 3) int64, largest voxel coordinates.
    """

    voxels: Tensor
    counts: Tensor
    sums: Tensor
    low: Tensor
    high: Tensor


@dataclass(frozen=True)
class SlotBlock:
    """Consecutive slots.

    Attributes:
        first: Number of the first slot.
        keys: (n,) int64 keys, negative where a slot has no voxel.
        dense_rows: (n,) int32 dense rows, -1 for none.
        voxel_size_m: Edge of a voxel, metres.
    """

    first: int
    keys: Tensor
    dense_rows: Tensor
    voxel_size_m: float


@dataclass(frozen=True)
class Texts:
    """The texts that the voxels of a layer are compared with.

    Without negatives a score is a cosine. With them it is the smallest over the negatives of
    exp(s c) / (exp(s c) + exp(s c_negative)), s being the logit scale and c the cosines.

    Attributes:
        vectors: (p + q, d) float32 unit vectors: prompts, then negatives.
        prompts: p, at least 1.
        logit_scale: s.
    """

    vectors: Tensor
    prompts: int
    logit_scale: float


@dataclass(frozen=True)
class EmbeddedLayer:
    """A layer whose voxels have an embedding of their own: f_i, or (w_i f_i + lambda c_i g) / (w_i + lambda c_i).

    Attributes:
        pool: Rows of the f_i.
        weight_of_row: (rows,) float32 w of each row.
        own: Rows (float32) of instances: g is that of the top hypothesis and c_i its count; voxels with either have the
            layer. None for the f_i alone.
        variance_ratio: lambda.
        texts: What voxels are compared with.
    """

    pool: RowPool
    weight_of_row: Tensor
    own: RowPool | None
    variance_ratio: float
    texts: Texts


@dataclass(frozen=True)
class InheritedLayer:
    """A layer whose voxels have the embedding of their top hypothesis.

    Attributes:
        scores_of_row: (instance rows, p) float32 score of each instance with each prompt.
    """

    scores_of_row: Tensor


@dataclass(frozen=True)
class ScoreSums:
    """Scores of the voxels whose top hypothesis an instance is, by its row.

    Attributes:
        members: (rows,) int64, how many of these voxels have the layer.
        totals: (rows, p) int64, sum of their scores in steps of 1 / SCORE_UNIT.
    """

    members: Tensor
    totals: Tensor


@dataclass(frozen=True)
class ScoredVoxels:
    """Room for voxels and their scores.

    Attributes:
        centers_m: (n, 3) float32, metres.
        best: (n,) float32 best score over the prompts.
        which: (n,) int32 the prompt that has it, of equal ones the first; None where nobody asks.
    """

    centers_m: Tensor
    best: Tensor
    which: Tensor | None = None


@dataclass(frozen=True)
class FusionRows:
    """The rows of the dense layer that instances are fused with.

    Attributes:
        pool: Rows f of the dense layer.
        slot_of_row: (rows,) int32 slot of each row, -1 for a free one.
        weight_of_row: (rows,) float32 w.
        held_row: (slots, K) int32 instances that each slot holds, -1 where empty.
    """

    pool: RowPool
    slot_of_row: Tensor
    weight_of_row: Tensor
    held_row: Tensor


@dataclass(frozen=True)
class Association:
    """The result of associating a keyframe's proposals.

    Attributes:
        rows: (m,) int64 row of each proposal's instance, -1 for a proposal without points.
        ids: (m,) int64 its id.
        created: How many instances were made.
        dead: Rows of the instances that lost their last voxel, int64.
    """

    rows: Tensor
    ids: Tensor
    created: int
    dead: Tensor


class Kernels(Protocol):
    """The inner loops of the map."""

    def voxel_keys(self, points_m: Tensor, voxel_size_m: float) -> tuple[Tensor, float]:
        """Compute the packed key of the voxel of each point (n, 3): floor(p / size) per axis.

        Returns:
            (n,) int64 keys, and the largest coordinate's size: keys mean nothing if that is beyond MAX_COORDINATE, or NaN
            because a point is not finite.
        """

    def unit_rows(self, values: Tensor) -> tuple[Tensor, int]:
        """Scale rows (n, d) of any length to unit length.

        Returns:
            (n, d) float32 and 0; or nothing of meaning and 1, a value is not finite, or 2, a row has length 0.
        """

    def distinct(self, keys: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Find the distinct keys, in an order that the input alone decides, the place of each input, and counts: int64."""

    def count_pairs(self, first: Tensor, second: Tensor, groups: int, partners: int) -> GroupedCounts:
        """Count equal (first, second) pairs, (n,) int64 in [0, groups) and [0, partners), grouped by first."""

    def find(self, table: HashTable, keys: Tensor) -> Tensor:
        """Look up the slots of the keys, -1 where the table lacks one: (n,) int64."""

    def place(self, table: HashTable, keys: Tensor, slots: Tensor) -> None:
        """Put distinct keys that the table lacks into it, which must have room."""

    def mark_deleted(self, table: HashTable, keys: Tensor) -> None:
        """Mark distinct keys that the table has as deleted."""

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
        """Write rows[i] <- (old[i] rows[i] + sum over group i of amounts embeddings[partners]) / new[i].

        Args:
            pool: The rows.
            rows: (n,) int64 distinct rows.
            old: (n,) float32 weights; 0 for rows whose content is undefined.
            new: (n,) float32 weights, positive.
            seeds: (n,) int64 seeds of rounding.
            groups: n groups.
            amounts: One float32 for each of the groups' partners.
            embeddings: (p, d) float32.
        """

    def associate(
        self,
        hypotheses: Hypotheses,
        proposals: GroupedCounts,
        spare_rows: Tensor,
        next_id: int,
        iou_threshold: float,
        hidden_of_row: Tensor | None = None,
    ) -> Association:
        """Associate proposals in order and count them, each against the map as the previous one left it.

        Args:
            hypotheses: Changed, but for rows' embeddings and weights.
            proposals: m groups of slots and N_i.
            spare_rows: (m,) int64 rows for new instances, taken from the front.
            next_id: Id of the next new instance.
            iou_threshold: An IoU must be larger than this to match.
            hidden_of_row: (rows,) int32, how many of an instance's voxels do not count in the IoU's union, none of them one
                of a proposal's; None where all count.
        """

    def holders(self, held_row: Tensor, rows: Tensor, row_count: int) -> Tensor:
        """Find the slots that hold any of some instances, (n,) int64 ascending; arguments as of :meth:`shared_voxels`."""

    def shared_voxels(self, held_row: Tensor, rows: Tensor, row_count: int) -> Tensor:
        """Count the voxels that each two of some instances share, in one pass over slots.

        Args:
            held_row: (slots, K) int32 rows that each slot holds, -1 where empty.
            rows: (m,) int64 distinct rows of the instances.
            row_count: One more than the largest row held.

        Returns:
            (m, m) int64, symmetrical; on the diagonal how many voxels each has.
        """

    def merge(self, hypotheses: Hypotheses, slots: Tensor, gone: Tensor, into: Tensor) -> None:
        """Let instances take in others.

        Where a voxel holds both, the counts are added; elsewhere the hypothesis changes its instance.

        Args:
            hypotheses: Changed: of rows that are gone nothing is left, id and all.
            slots: (s,) int64 distinct slots, all that hold any of those that are taken in among them.
            gone: (n,) int64 distinct rows of the instances that are taken in.
            into: (n,) int64 rows of those that take them in, none of them gone; one may take in several.
        """

    def top_hypotheses(self, hypotheses: Hypotheses, slots: Tensor) -> tuple[Tensor, Tensor]:
        """Find per slot the row with the highest count (ties: the lowest id; -1 without one) and that count: (n,) int64."""

    def scan_limit(self, texts: int) -> int:
        """Return how many slots may be scanned at a time, compared with so many texts, for its memory to stay small."""

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
        """Scan a block of slots: add what instances occupy, and compare its voxels with texts.

        Args:
            block: The slots.
            hypotheses: Of all slots.
            extents: Changed, by every voxel of the block that has a hypothesis.
            layer: What is compared; None for nothing.
            sums: Changed, by the voxels that have the layer; only without a layer None.
            threshold: Voxels that score less are not written; -inf for none.
            room_for: Written from the front, in the order of slots, its rest left undefined; with a layer as long as the
                block.

        Returns:
            How many voxels have the layer, and how many were written.
        """

    def farther(self, keys: Tensor, voxel_size_m: float, point_m: Tensor, radius_m: float) -> Tensor:
        """Find the keys whose voxel's centre is farther than a radius from a point (3,) float64: places, int64 ascending."""

    def centers(self, keys: Tensor, voxel_size_m: float) -> Tensor:
        """Compute the centres of voxels: (n, 3) float32, metres."""

    def cosines(self, pool: RowPool, rows: Tensor, texts: Tensor) -> Tensor:
        """Compute the cosines of the rows with unit vectors (p, d): (n, p) float32."""

    def fuse(self, voxels: FusionRows, rows: Tensor, own: RowPool, amounts: Tensor, bars: Tensor, target: RowPool) -> Tensor:
        """Fuse instances: target[row] <- (sum of w f over the voxels that hold it + amount own[row]) / evidence.

        The evidence is the sum of w over these voxels, plus the amount. Where it is 0, own[row] is what is written.

        Args:
            voxels: The dense rows.
            rows: (n,) int64 distinct rows of the instances. The result for one does not depend on the others.
            own: Their own embeddings, float32.
            amounts: (n,) float64 weight of these.
            bars: (n,) float64; a row is written only where its evidence is greater.
            target: The rows that are written, float32.

        Returns:
            (n,) float64 evidence.
        """
