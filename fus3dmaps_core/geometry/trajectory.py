"""Poses over time: a buffer that interpolates and forgets."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from enum import Enum

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp


class PoseGap(Enum):
    """Why there is no pose at a stamp."""

    BEFORE_FIRST = "before the first pose"
    AFTER_LAST = "after the last pose"
    TOO_WIDE = "between poses too far apart"


class PoseBuffer:
    """Poses in stamp order, from the oldest that is still needed to the newest. Not thread-safe."""

    def __init__(self, max_gap_s: float) -> None:
        """Start empty; poses farther apart than ``max_gap_s`` seconds are not interpolated."""
        self._max_gap_ns = round(max_gap_s * 1e9)
        self._stamps_ns: list[int] = []
        self._poses: list[NDArray[np.float64]] = []

    def __len__(self) -> int:
        """Return the number of poses held."""
        return len(self._stamps_ns)

    @property
    def first_ns(self) -> int | None:
        """Stamp of the oldest pose held."""
        return self._stamps_ns[0] if self._stamps_ns else None

    @property
    def last_ns(self) -> int | None:
        """Stamp of the newest pose."""
        return self._stamps_ns[-1] if self._stamps_ns else None

    def add(self, stamp_ns: int, T: NDArray[np.float64]) -> None:
        """Append a pose.

        Args:
            stamp_ns: Must be later than that of every pose before.
            T: (4, 4) rigid transform; kept, not copied.

        Raises:
            ValueError: The stamp is not later.
        """
        if self._stamps_ns and stamp_ns <= self._stamps_ns[-1]:
            raise ValueError(f"pose stamp {stamp_ns} is not later than {self._stamps_ns[-1]}")
        self._stamps_ns.append(stamp_ns)
        self._poses.append(T)

    def lookup(self, stamp_ns: int) -> NDArray[np.float64] | PoseGap:
        """Return the pose at a stamp: the stored one where stamps coincide, else position by lerp and rotation by slerp.

        Returns:
            A fresh (4, 4) float64 transform, or the reason why there is none. AFTER_LAST may become a pose later, the
            others cannot.
        """
        after = bisect_left(self._stamps_ns, stamp_ns)
        if after == len(self._stamps_ns):
            return PoseGap.AFTER_LAST
        if self._stamps_ns[after] == stamp_ns:
            return self._poses[after].copy()
        if after == 0:
            return PoseGap.BEFORE_FIRST
        start_ns, end_ns = self._stamps_ns[after - 1], self._stamps_ns[after]
        if end_ns - start_ns > self._max_gap_ns:
            return PoseGap.TOO_WIDE
        return _interpolate(self._poses[after - 1], self._poses[after], (stamp_ns - start_ns) / (end_ns - start_ns))

    def forget_before(self, stamp_ns: int) -> None:
        """Forget the poses that no lookup at this stamp or later needs."""
        needless = max(bisect_right(self._stamps_ns, stamp_ns) - 1, 0)
        del self._stamps_ns[:needless]
        del self._poses[:needless]

    def clear(self) -> None:
        """Forget every pose."""
        self._stamps_ns.clear()
        self._poses.clear()


def _interpolate(T_start: NDArray[np.float64], T_end: NDArray[np.float64], share: float) -> NDArray[np.float64]:
    T = np.eye(4)
    T[:3, :3] = Slerp([0.0, 1.0], Rotation.from_matrix([T_start[:3, :3], T_end[:3, :3]]))(share).as_matrix()
    T[:3, 3] = (1.0 - share) * T_start[:3, 3] + share * T_end[:3, 3]
    return T
