"""Small integers that name slots and rows: given out from 0 upwards, and given again once they were given back."""

from __future__ import annotations

import torch
from torch import Tensor

from fus3dmaps_core.errors import MapError
from fus3dmaps_core.voxel_map.rows.columns import Column

_LIMIT = 2**31 - 1  # Numbers are held in 32-bit columns.


class Numbers:
    """Which numbers are in use."""

    def __init__(self, what: str, device: torch.device) -> None:
        """None is in use; ``what`` they number is for messages."""
        self._what = what
        self._device = device
        self._high = 0
        self._free = Column(torch.int32, -1, device)
        self._free_count = 0

    def __len__(self) -> int:
        """How many are in use."""
        return self._high - self._free_count

    @property
    def high_water(self) -> int:
        """One more than the largest ever given."""
        return self._high

    @property
    def nbytes(self) -> int:
        """Allocated bytes."""
        return self._free.nbytes

    def check_room(self, count: int) -> None:
        """Raise MapError if ``count`` more would be more than 32 bits can tell apart."""
        if len(self) + count > _LIMIT:
            raise MapError(f"the map holds {len(self)} {self._what} and cannot number {count} more")

    def take(self, count: int) -> Tensor:
        """Numbers not in use, those given back last first: (count,) int64.

        Raises:
            MapError: As :meth:`check_room`; none was taken.
        """
        self.check_room(count)
        reused = min(count, self._free_count)
        taken = torch.empty(count, dtype=torch.int64, device=self._device)
        taken[:reused] = self._free[self._free_count - reused : self._free_count].to(torch.int64)
        taken[reused:] = torch.arange(self._high, self._high + count - reused, device=self._device)
        self._free_count -= reused
        self._high += count - reused
        return taken

    def give_back(self, numbers: Tensor) -> None:
        """Free distinct numbers that are in use: (n,) int64."""
        self._free.reserve(self._free_count + len(numbers))
        self._free[self._free_count : self._free_count + len(numbers)] = numbers.to(torch.int32)
        self._free_count += len(numbers)
