"""The content of a map: its parts, and their state as plain arrays by name."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from fus3dmaps_core.config.schema import MapConfig
from fus3dmaps_core.voxel_map.budget import KeyframeBound, MemoryUse
from fus3dmaps_core.voxel_map.kernels.keys import pack
from fus3dmaps_core.voxel_map.kernels.protocols import GroupedCounts, Kernels
from fus3dmaps_core.voxel_map.layers.dense import DenseLayer
from fus3dmaps_core.voxel_map.layers.fused_instances import FusedInstances
from fus3dmaps_core.voxel_map.layers.instances import InstanceLayer
from fus3dmaps_core.voxel_map.layers.merging import merge_overlapping
from fus3dmaps_core.voxel_map.rows.columns import Column
from fus3dmaps_core.voxel_map.rows.rounding import seeds_of
from fus3dmaps_core.voxel_map.voxel_hash import VoxelHash

_UNSEEN_COLOR = 128  # Voxels that only proposals have touched carry no colour of their own.


class MapState:
    """One voxel hash and everything known of its voxels and of the instances.

    Attributes:
        hash: Voxel keys to slots.
        colors: (slots, 3) uint8.
        dense: The dense layer.
        instances: The instance layer.
        fused: Fused embeddings of the instances.
    """

    def __init__(
        self, dimension: int, config: MapConfig, windowed: bool, kernels: Kernels, keep_most_evidence: bool = True
    ) -> None:
        """Start empty."""
        device = torch.device(config.device)
        self._device = device
        self._windowed = windowed
        self._kernels = kernels
        self._merge_rule = (config.merge_overlap, config.merge_cosine)
        self.hash = VoxelHash(kernels, device)
        self.colors = Column(torch.uint8, _UNSEEN_COLOR, device, width=3)
        self.dense = DenseLayer(dimension, getattr(torch, config.dtype), kernels, device)
        self.instances = InstanceLayer(dimension, config.max_hypotheses, config.iou_threshold, kernels, device)
        self.fused = FusedInstances(dimension, windowed, device, keep_most_evidence)

    def slots(self, keys: Tensor) -> Tensor:
        """Look up the slots of distinct keys, (n,) int64. Voxels that the map lacks are made."""
        slots = self.hash.find_or_insert(keys)
        count = self.hash.high_water
        self.colors.reserve(count)
        self.dense.reserve(count)
        self.instances.reserve(count)
        return slots

    def associate(self, slots: Tensor, proposals: GroupedCounts, embeddings: Tensor, visible_keys: Tensor | None) -> Tensor:
        """Give a keyframe's proposals to instances, then merge instances that have grown into one another, if configured.

        Args:
            slots: (n,) distinct slots of all proposals.
            proposals: m groups of slots and N_i.
            embeddings: (m, d) float32 unit vectors.
            visible_keys: Distinct keys of what the keyframe saw, the proposals' own included; None where all voxels of an
                instance count.

        Returns:
            Id that each proposal's instance has after that, (m,) int64, -1 for a proposal without points.
        """
        visible = None
        if visible_keys is not None:
            visible = self.hash.find(visible_keys)
            visible = visible.masked_select(visible >= 0)
        ids, created = self.instances.associate(proposals, embeddings, visible)
        self.fused.make_room(created)
        if self._merge_rule[0] > 0:
            for gone, into in merge_overlapping(self._kernels, self.instances, self.fused, slots, *self._merge_rule):
                ids.masked_fill_(ids == gone, into)
        return ids

    def remove(self, slots: Tensor) -> None:
        """Forget the voxels of distinct slots, and instances that are left without one."""
        rows = self.dense.rows(slots)
        self.dense.drop(rows[rows >= 0])
        self.instances.forget(slots)
        self.colors[slots] = _UNSEEN_COLOR
        self.hash.remove(slots)

    def nbytes(self) -> dict[str, int]:
        """Return the allocated bytes by part. The hash counts all that a voxel takes without evidence: key, cells, link."""
        return {
            "hash": self.hash.nbytes + self.dense.link_nbytes,
            "colors": self.colors.nbytes,
            "dense": self.dense.nbytes - self.dense.link_nbytes,
            "instances": self.instances.nbytes + self.fused.nbytes,
        }

    def memory_use(self, bound: KeyframeBound) -> MemoryUse:
        """Return the allocated bytes, and what a keyframe of at most this size can make of them."""
        allocated, pool = sum(self.nbytes().values()), self.dense.pool
        slots = self.hash.high_water_after(bound.voxels)
        lasting_next = (
            self.hash.nbytes_after(bound.voxels)
            + self.dense.link_nbytes_after(slots)
            + self.colors.nbytes_after(slots)
            + self.instances.nbytes_after(slots, bound.instances)
            + self.fused.nbytes_after(self.instances.pool.high_water_after(bound.instances))
        )
        return MemoryUse(
            allocated=allocated,
            lasting=allocated - (self.dense.nbytes - self.dense.link_nbytes),
            lasting_next=lasting_next,
            dense_voxels=len(self.dense),
            new_dense_voxels=bound.dense_voxels,
            dense_rows=len(pool.blocks) * pool.block_rows,
            block_rows=pool.block_rows,
            block_bytes=self.dense.block_nbytes,
        )

    def export(self) -> dict[str, NDArray[Any]]:
        """Return everything as arrays by name, voxels in the order of their slots.

        Returns:
            voxel_coordinates (n, 3) int32; voxel_colors (n, 3) uint8; dense_slot (m,) int32, places among the n;
            dense_weight (m,) float32; dense_embedding (m, d) in the storage type; for int8 dense_scale (m,) float32;
            hypothesis_id, hypothesis_count (n, K) int32; instance_id (i,) int64; instance_weight (i,) float64;
            instance_embedding (i, d) float32; fused_embedding (i, d) float32; fused_evidence (i,) float64, 0 before the
            first fusion; next_instance_id () int64.
        """
        slots = self.hash.live()
        rows = self.dense.rows(slots)
        has_dense = torch.nonzero(rows >= 0).squeeze(1)
        rows = rows[has_dense]
        stored, scales = self.dense.pool.read_stored(rows)
        ids, instance_rows = self.instances.live()
        held, counts = self.instances.hypotheses(slots)
        state = {
            "voxel_coordinates": self.hash.coordinates(slots).to(torch.int32),
            "voxel_colors": self.colors[slots],
            "dense_slot": has_dense.to(torch.int32),
            "dense_weight": self.dense.weights(rows),
            "dense_embedding": stored,
            "hypothesis_id": self.instances.ids(held).to(torch.int32),
            "hypothesis_count": counts.to(torch.int32),
            "instance_id": ids,
            "instance_weight": self.instances.weights(instance_rows),
            "instance_embedding": self.instances.pool.read(instance_rows),
            "fused_embedding": self.fused.stored(instance_rows, self.instances),
            "fused_evidence": self.fused.evidence(instance_rows),
            "next_instance_id": torch.tensor(self.instances.next_id),
        }
        if stored.dtype == torch.int8:
            state["dense_scale"] = scales
        return {name: tensor.cpu().numpy() for name, tensor in state.items()}

    def fill(self, state: dict[str, NDArray[Any]]) -> None:
        """Take over an exported and checked state; only for a map that is empty."""
        tensors = {name: torch.from_numpy(np.array(array)).to(self._device) for name, array in state.items()}
        keys = pack(tensors["voxel_coordinates"])
        slots = self.slots(keys)
        self.colors[slots] = tensors["voxel_colors"]
        self._fill_dense(tensors, slots, keys)
        rows = self.instances.restore(
            slots,
            tensors["hypothesis_id"],
            tensors["hypothesis_count"],
            int(tensors["next_instance_id"]),
            tensors["instance_id"],
            tensors["instance_weight"],
            tensors["instance_embedding"].to(torch.float32),
        )
        self.fused.restore(rows, tensors["fused_embedding"].to(torch.float32), tensors["fused_evidence"])

    def _fill_dense(self, tensors: dict[str, Tensor], slots: Tensor, keys: Tensor) -> None:
        place, weights = tensors["dense_slot"].to(torch.int64), tensors["dense_weight"].to(torch.float32)
        stored = tensors["dense_embedding"]
        rows = self.dense.add(slots[place], weights)
        if stored.dtype == self.dense.pool.dtype:
            self.dense.pool.write_stored(rows, stored, tensors.get("dense_scale"))
            return
        values = stored.to(torch.float32)
        if stored.dtype == torch.int8:
            values *= tensors["dense_scale"][:, None]
        self.dense.pool.write(rows, values, seeds_of(keys[place], weights))
