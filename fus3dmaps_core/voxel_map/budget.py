"""Keeping a map within its memory: first by a smaller window, then by dropping the voxels that were observed least.

A map grows in steps, by blocks of embedding rows and by columns that double. So the budget looks at what the map would take
after the largest keyframe that can come, and makes room before that. Voxel keys, hypotheses and instances stay for the whole
map; only the dense layer gives way.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

_log = logging.getLogger(__name__)

_NEAR, _TARGET, _RELAXED = 0.9, 0.8, 0.7
_SHRINK, _GROW = 0.85, 1.05
_LEAST_RADIUS_M, _LEAST_RADIUS_VOXELS = 1.0, 20.0
_MIB = float(2**20)


@dataclass(frozen=True)
class KeyframeBound:
    """The most that one keyframe can add to a map.

    Attributes:
        voxels: New voxels, seen by either layer.
        dense_voxels: New dense embeddings.
        instances: New instances.
    """

    voxels: int
    dense_voxels: int
    instances: int


@dataclass(frozen=True)
class MemoryUse:
    """What a map takes, in bytes, and what it may take after its next keyframe.

    Attributes:
        allocated: Allocated bytes.
        lasting: Those that remain however few voxels have a dense embedding.
        lasting_next: The same after the next keyframe, at most.
        dense_voxels: Voxels with a dense embedding.
        new_dense_voxels: Dense embeddings that the next keyframe brings, at most.
        dense_rows: Dense embeddings for which there is memory.
        block_rows: Dense embeddings whose memory is taken and given back together.
        block_bytes: Bytes of so many, at most.
    """

    allocated: int
    lasting: int
    lasting_next: int
    dense_voxels: int
    new_dense_voxels: int
    dense_rows: int
    block_rows: int
    block_bytes: int

    def after_next(self) -> int:
        """Return the most bytes allocated after the next keyframe."""
        return self.lasting_next + self._dense_bytes(max(self.dense_rows, self.dense_voxels + self.new_dense_voxels))

    def without_slack(self) -> MemoryUse:
        """Return the same once memory without a dense embedding is given back."""
        blocks = -(-self.dense_voxels // self.block_rows)
        allocated = min(self.allocated, self.lasting + blocks * self.block_bytes)
        return MemoryUse(
            allocated,
            self.lasting,
            self.lasting_next,
            self.dense_voxels,
            self.new_dense_voxels,
            blocks * self.block_rows,
            self.block_rows,
            self.block_bytes,
        )

    def _dense_bytes(self, rows: int) -> int:
        return -(-rows // self.block_rows) * self.block_bytes


class BudgetedMap(Protocol):
    """What a budget asks of a map."""

    @property
    def window_radius_m(self) -> float:
        """Effective radius of the sliding window, metres; 0 without one."""

    def memory_use(self, bound: KeyframeBound) -> MemoryUse:
        """Return what the map takes, and would take after a keyframe of at most this size."""

    def set_window_radius(self, radius_m: float) -> None:
        """Change the effective radius of the sliding window."""

    def prune_window(self, center_m: NDArray[np.floating]) -> int:
        """Drop the dense embeddings outside the window; returns how many."""

    def drop_least_observed(self, count: int) -> int:
        """Drop the dense embeddings of the least observed voxels; returns how many."""

    def release_unused(self) -> int:
        """Give back memory that no dense embedding is in; returns the bytes."""


class MemoryBudget:
    """Keeps a map's allocated bytes within a bound, if what cannot be dropped fits. Never raises for lack of memory.

    A map is *near* its budget if it takes more than 90 % of it or could take more than all of it after the next keyframe.
    Then the window shrinks until the map is no longer near, down to a metre or 20 voxels, whichever is more. If that does
    not suffice, the least observed voxels lose their dense embeddings until 80 % are taken, but never so many that fewer
    remain than a keyframe can bring. Below 70 %, the window widens by 5 % a keyframe, up to what was configured.
    """

    def __init__(self, budget_mib: float, window_radius_m: float, voxel_size_m: float, bound: KeyframeBound) -> None:
        """Set the bound; :meth:`make_room` enforces it.

        Args:
            budget_mib: What the map may take, MiB; 0 for no bound.
            window_radius_m: Configured radius of the sliding window, metres; 0 for a map without one.
            voxel_size_m: Edge of a voxel, metres.
            bound: The most that a keyframe adds.
        """
        self.budget_bytes = round(budget_mib * _MIB)
        self._configured_radius_m = window_radius_m
        self._least_radius_m = min(window_radius_m, max(_LEAST_RADIUS_M, _LEAST_RADIUS_VOXELS * voxel_size_m))
        self._bound = bound
        self._warned_of_drops = self._warned_of_excess = False

    def make_room(self, target: BudgetedMap, center_m: NDArray[np.floating]) -> int:
        """Make room for the next keyframe.

        Args:
            target: The map.
            center_m: (3,) position of its camera in the map frame, metres.

        Returns:
            Number of voxels that lost their dense embedding for it.
        """
        if not self.budget_bytes:
            return 0
        use = target.memory_use(self._bound)
        if not self.is_near(use):
            if self.load(use) < _RELAXED:
                self._relax(target)
            return 0
        before, radius_before_m = use, target.window_radius_m
        beyond_window = self._shrink_window(target, center_m)
        excess = self.excess(target.memory_use(self._bound).without_slack())
        least_observed = target.drop_least_observed(excess) if excess else 0
        target.release_unused()
        use = target.memory_use(self._bound)
        if beyond_window or least_observed or target.window_radius_m < radius_before_m:
            self._warn_of_drops(before, use, beyond_window, least_observed, radius_before_m, target.window_radius_m)
        if self.load(use) > _NEAR:
            self._warn_of_excess(use)
        return beyond_window + least_observed

    def load(self, use: MemoryUse) -> float:
        """Return the share of the budget that is taken, or a tenth less than the next keyframe could make it, if larger."""
        reserve = (1.0 - _NEAR) * self.budget_bytes
        return max(use.allocated, use.after_next() - reserve) / self.budget_bytes

    def is_near(self, use: MemoryUse) -> bool:
        """Tell whether the map must give way."""
        return self.load(use) > _NEAR

    def excess(self, use: MemoryUse) -> int:
        """Count the dense embeddings to drop so that 80 % are taken; 0 for a map that is not near its budget."""
        if not self.is_near(use):
            return 0
        target = _TARGET * self.budget_bytes
        now = self._rows_within(target - use.lasting, use)
        after_next = self._rows_within(target + (1.0 - _NEAR) * self.budget_bytes - use.lasting_next, use)
        kept = max(min(now, after_next - use.new_dense_voxels), use.new_dense_voxels)
        return max(0, use.dense_voxels - kept)

    @staticmethod
    def _rows_within(nbytes: float, use: MemoryUse) -> int:
        return int(nbytes // use.block_bytes) * use.block_rows

    def _shrink_window(self, target: BudgetedMap, center_m: NDArray[np.floating]) -> int:
        """Shrink the window until it suffices or is at its least; returns how many embeddings were dropped."""
        dropped = 0
        while target.window_radius_m > self._least_radius_m:
            if not self.is_near(target.memory_use(self._bound).without_slack()):
                break
            target.set_window_radius(max(self._least_radius_m, _SHRINK * target.window_radius_m))
            dropped += target.prune_window(center_m)
        return dropped

    def _relax(self, target: BudgetedMap) -> None:
        """Widen the window again, far from the budget, and allow the next warning."""
        self._warned_of_drops = self._warned_of_excess = False
        if 0.0 < target.window_radius_m < self._configured_radius_m:
            target.set_window_radius(min(self._configured_radius_m, _GROW * target.window_radius_m))

    def _warn_of_drops(
        self, before: MemoryUse, after: MemoryUse, beyond_window: int, least_observed: int, from_m: float, to_m: float
    ) -> None:
        if self._warned_of_drops:
            return
        self._warned_of_drops = True
        window = (
            f"the window shrank from {from_m:.2f} to {to_m:.2f} m and {beyond_window} voxels left it, " if from_m else ""
        )
        _log.warning(
            "map.memory_budget_mib: the map takes %.1f of %.1f MiB and needs room for up to %.1f MiB; %s%d of the least"
            " observed voxels lost their dense embedding; it takes %.1f MiB now. More may follow without a warning.",
            before.allocated / _MIB,
            self.budget_bytes / _MIB,
            before.after_next() / _MIB,
            window,
            least_observed,
            after.allocated / _MIB,
        )

    def _warn_of_excess(self, use: MemoryUse) -> None:
        if self._warned_of_excess:
            return
        self._warned_of_excess = True
        _log.warning(
            "map.memory_budget_mib: %.1f MiB are too little: voxel hash, hypotheses and instances, which stay, take %.1f MiB"
            " and with a further keyframe up to %.1f MiB. Objects are mapped on; the dense layer is held at %d voxels and"
            " what a keyframe brings.",
            self.budget_bytes / _MIB,
            use.lasting / _MIB,
            use.lasting_next / _MIB,
            use.dense_voxels,
        )
