"""Fused embeddings of instances: what fusion stored, and with how much evidence."""

from __future__ import annotations

import torch
from torch import Tensor

from fus3dmaps_core.voxel_map.layers.fusion import FusionInputs, fuse_instances
from fus3dmaps_core.voxel_map.layers.instances import InstanceLayer
from fus3dmaps_core.voxel_map.rows.columns import Column
from fus3dmaps_core.voxel_map.rows.row_pool import RowPool

_FUSE_SUM_BYTES, _QUERY_SUM_BYTES = 8 * 2**20, 4 * 2**20
_COPIED_ROWS = 128


class FusedInstances:
    """Fused embeddings and evidence under the rows of the instance layer.

    The stored set changes only by :meth:`fuse`. Without a window a query answers with the fusion of the map as it is, so
    there is a second, current set, which :meth:`refreshed` brings up to date. Instances that have not changed are not
    computed again.
    """

    def __init__(self, dimension: int, windowed: bool, device: torch.device, keep_most_evidence: bool = True) -> None:
        """Start empty. ``keep_most_evidence`` matters only with a window."""
        self._device = device
        self._windowed = windowed
        self._keep_most_evidence = keep_most_evidence
        self._stored = RowPool(dimension, torch.float32, device)
        self._evidence = Column(torch.float64, 0.0, device)
        self._current = RowPool(dimension, torch.float32, device)
        self._current_evidence = Column(torch.float64, 0.0, device)
        self._unstored = Column(torch.bool, False, device)

    def make_room(self, rows: Tensor) -> None:
        """Make room for new instances, whose rows may have belonged to others."""
        if not len(rows):
            return
        highest = int(rows.max()) + 1
        self._stored.allocate(max(0, highest - self._stored.high_water))
        self._evidence.reserve(highest)
        self._evidence[rows] = 0.0
        if not self._windowed:
            self._current.allocate(max(0, highest - self._current.high_water))
            self._current_evidence.reserve(highest)
            self._unstored.reserve(highest)
            self._unstored[rows] = False

    def fuse(self, inputs: FusionInputs, full: bool) -> tuple[int, int]:
        """Fuse the layers and store the result.

        Without a window every instance gets the fused embedding of the map as it is. With one, an instance gets its new
        fused embedding only if the new evidence is greater than the stored one [sec: Sliding Window]; always, if
        ``keep_most_evidence`` is false. If none of an instance's voxels has a dense embedding, the new one is f_id itself.

        Args:
            inputs: The layers.
            full: Compute every instance, not only those that have changed; the result is the same.

        Returns:
            How many instances have their stored embedding from this fusion, and how many were computed.
        """
        instances = inputs.instances
        alive = instances.live()[1]
        rows = alive.sort().values if full else instances.changed()
        if not self._windowed:
            self._refresh(inputs, rows, _FUSE_SUM_BYTES)
            pending = torch.nonzero(self._unstored[: instances.pool.high_water]).squeeze(1)
            for part in torch.split(pending, _COPIED_ROWS):
                self._stored.write(part, self._current.read(part))
            self._evidence[pending] = self._current_evidence[pending]
            self._unstored[pending] = False
            return len(alive), len(rows)
        before = self._evidence[rows]
        bars = before if self._keep_most_evidence else torch.full_like(before, -torch.inf)
        evidence = fuse_instances(inputs, rows, bars, self._stored, _FUSE_SUM_BYTES)
        self._evidence[rows] = torch.maximum(bars, evidence)
        instances.mark_fused(rows)
        return int((evidence > before).sum()) if self._keep_most_evidence else len(alive), len(rows)

    def merge(self, gone: Tensor, into: Tensor) -> None:
        """Keep, for instances that take in others, what was stored with the most evidence; of equal evidence, their own.

        Args:
            gone: (n,) rows of the instances that are taken in.
            into: (n,) rows of those that take them in, none of them gone; one may take in several, and of equal evidence
                has what was stored for the first.
        """
        owners = into.tolist()
        most = dict(zip(owners, self._evidence[into].tolist(), strict=True))
        best: dict[int, int] = {}
        for row, owner, evidence in zip(gone.tolist(), owners, self._evidence[gone].tolist(), strict=True):
            if evidence > most[owner]:
                most[owner], best[owner] = evidence, row
        sources, targets = (
            torch.tensor(list(each), dtype=torch.int64, device=self._device) for each in (best.values(), best)
        )
        self._stored.write(targets, self._stored.read(sources))
        self._evidence[targets] = self._evidence[sources]

    def restore(self, rows: Tensor, fused: Tensor, evidence: Tensor) -> None:
        """Store fused embeddings (n, d) and evidence (n,), 0 for none."""
        self.make_room(rows)
        self._stored.write(rows, fused)
        self._evidence[rows] = evidence

    def evidence(self, rows: Tensor) -> Tensor:
        """Return the stored evidence e_id, 0 before the first fusion: (n,) float64."""
        return self._evidence[rows]

    def stored(self, rows: Tensor, instances: InstanceLayer) -> Tensor:
        """Return the stored fused embeddings; f_id itself before an instance's first fusion: (n, d) float32."""
        values = instances.pool.read(rows)
        fused = self._evidence[rows] > 0
        values[fused] = self._stored.read(rows[fused])
        return values

    def refreshed(self, inputs: FusionInputs) -> RowPool:
        """Return the fused embeddings that a query sees, brought up to date; valid where :meth:`are_fused` is true."""
        if self._windowed:
            return self._stored
        self._refresh(inputs, inputs.instances.changed(), _QUERY_SUM_BYTES)
        return self._current

    def are_fused(self, rows: Tensor) -> Tensor:
        """Tell which instances have a fused embedding; with a window, none before its first fusion: (n,) bool."""
        return self._evidence[rows] > 0 if self._windowed else torch.ones_like(rows, dtype=torch.bool)

    @property
    def nbytes(self) -> int:
        """Allocated bytes."""
        columns = (self._evidence, self._current_evidence, self._unstored)
        return self._stored.nbytes + self._current.nbytes + sum(column.nbytes for column in columns)

    def nbytes_after(self, rows: int) -> int:
        """Return the most bytes that are allocated once there is room for rows 0 .. rows - 1."""
        pools, columns = [self._stored], [self._evidence]
        if not self._windowed:
            pools, columns = [*pools, self._current], [*columns, self._current_evidence, self._unstored]
        grown = sum(pool.nbytes_after(max(0, rows - pool.high_water)) for pool in pools)
        return grown + sum(column.nbytes_after(rows) for column in columns)

    def _refresh(self, inputs: FusionInputs, rows: Tensor, sum_bytes: int) -> None:
        always = torch.full((len(rows),), -torch.inf, dtype=torch.float64, device=rows.device)
        self._current_evidence[rows] = fuse_instances(inputs, rows, always, self._current, sum_bytes)
        self._unstored[rows] = True
        inputs.instances.mark_fused(rows)
