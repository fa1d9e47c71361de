"""Small integers that name slots and rows: handed out from 0 upwards, and reused once they are given back."""

from __future__ import annotations

import torch
from torch import Tensor

from fus3dmaps_core.errors import MapError
from fus3dmaps_core.voxel_map.rows.columns import Column

_LIMIT = 2**31 - 1  # Numbers are held in 32-bit columns.


class NumberPool:
    """Keeps track of which numbers are in use."""

    def __init__(self, what: str, device: torch.device) -> None:
        """Start with none in use; ``what`` says in error messages what they number."""
        self._what = what
        self._device = device
        self._high = 0
        self._free = Column(torch.int32, -1, device)
        self._free_count = 0

    def __len__(self) -> int:
        """Return how many numbers are in use."""
        return self._high - self._free_count

    @property
    def high_water(self) -> int:
        """One more than the largest number ever handed out."""
        return self._high

    @property
    def nbytes(self) -> int:
        """Allocated bytes."""
        return self._free.nbytes

    @property
    def row_nbytes(self) -> int:
        """Bytes that a number takes once it is given back."""
        return self._free.row_nbytes

    def high_water_after(self, count: int) -> int:
        """Return the ``high_water`` that there is once ``count`` more numbers are in use."""
        return max(self._high, len(self) + count)

    def nbytes_after(self, count: int) -> int:
        """Return the most bytes that are allocated once ``count`` more numbers were in use and all were given back."""
        return self._free.nbytes_after(self.high_water_after(count))

    def check_room(self, count: int) -> None:
        """Raise MapError if 32 bits cannot tell ``count`` more numbers apart."""
        if len(self) + count > _LIMIT:
            raise MapError(f"the map holds {len(self)} {self._what} and cannot number {count} more")

    def take(self, count: int) -> Tensor:
        """Hand out numbers that are not in use, those given back last first: (count,) int64.

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
