"""The map: one voxel hash, two layers over it, and the sliding window. The only thing that changes.

Every method takes the map's lock for its maths alone, so that queries are answered while mapping goes on. A call that is
refused has changed nothing.
"""

from __future__ import annotations

import threading
import time
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from fus3dmaps_core.config import MapConfig
from fus3dmaps_core.errors import MapError, QueryError
from fus3dmaps_core.layers.dense import DenseLayer
from fus3dmaps_core.layers.fusion import fuse_instances
from fus3dmaps_core.layers.instances import InstanceLayer
from fus3dmaps_core.layers.similarity import dense_similarity, fused_dense_similarity, instance_similarity
from fus3dmaps_core.map_input import (
    check_state,
    float_tensor,
    index_tensor,
    unit_rows,
    voxel_coordinates,
    weight_tensor,
)
from fus3dmaps_core.snapshots import FusionReport, InstanceSnapshot, LayerSimilarity, VoxelSnapshot, snapshot_instances
from fus3dmaps_core.voxels.columns import Column
from fus3dmaps_core.voxels.hash import VoxelHash, pack

LAYERS = ("dense", "fused_dense", "instances", "fused_instances")
"""Names of the layers that can be queried."""

_UNSEEN_COLOR = 128  # Voxels that only proposals have touched carry no colour of their own.


class SemanticMap:
    """A voxel map with a dense and an instance layer, thread-safe."""

    def __init__(self, dimension: int, config: MapConfig, variance_ratio: float, window_radius_m: float = 0.0) -> None:
        """Start empty.

        Args:
            dimension: Embedding width d.
            config: Voxel size, hypotheses, association threshold, storage type and device.
            variance_ratio: lambda = R^D / R^I.
            window_radius_m: Radius r_w of the sliding window, metres; 0 keeps the whole dense layer and makes fusion
                replace every fused embedding, where a window keeps those of more evidence.
        """
        self.dimension = dimension
        self.config = config
        self.variance_ratio = variance_ratio
        self.window_radius_m = window_radius_m
        self._device = torch.device(config.device)
        self._lock = threading.RLock()
        self._clear()

    def _clear(self) -> None:
        self._hash = VoxelHash(self._device)
        self._colors = Column(torch.uint8, _UNSEEN_COLOR, self._device, width=3)
        self._dense = DenseLayer(self.dimension, getattr(torch, self.config.dtype), self._device)
        self._instances = InstanceLayer(self.dimension, self.config.max_hypotheses, self.config.iou_threshold, self._device)
        self._fresh_fusion: tuple[Tensor, Tensor, Tensor] | None = None

    @property
    def voxel_count(self) -> int:
        """Voxels of the map."""
        with self._lock:
            return len(self._hash)

    @property
    def dense_voxel_count(self) -> int:
        """Voxels with a dense embedding."""
        with self._lock:
            return len(self._dense)

    @property
    def instance_count(self) -> int:
        """Instances alive."""
        with self._lock:
            return len(self._instances)

    def nbytes(self) -> dict[str, int]:
        """Allocated bytes by part."""
        with self._lock:
            return {
                "hash": self._hash.nbytes,
                "colors": self._colors.nbytes,
                "dense": self._dense.nbytes,
                "instances": self._instances.nbytes,
            }

    def reset(self) -> None:
        """Empty the map; instance ids start at 0 again."""
        with self._lock:
            self._clear()

    def integrate_dense(
        self,
        points_m: NDArray[np.floating],
        patches: NDArray[np.integer],
        embeddings: NDArray[np.floating],
        weights: NDArray[np.floating],
        colors: NDArray[np.uint8],
    ) -> None:
        """Add a keyframe's points to the dense layer [sec: Dense Semantic Voxel Mapping].

        Args:
            points_m: (n, 3) in the map frame, metres.
            patches: (n,) patch of each point.
            embeddings: (p, d), one per patch, any length but 0.
            weights: (p,) weight of one observation of each patch, in [0, 1e6]; encoders keep to [0, 1].
            colors: (n, 3) uint8 colour of each point.

        Raises:
            MapError: A shape, dtype, range or value is wrong.
        """
        coordinates = voxel_coordinates(points_m, self.config.voxel_size_m, self._device)
        patch_index = index_tensor("patches", patches, len(points_m), len(embeddings), self._device)
        unit = unit_rows(embeddings, self.dimension, self._device)
        patch_weights = weight_tensor(weights, len(embeddings), self._device)
        if colors.shape != (len(points_m), 3) or colors.dtype != np.uint8:
            raise MapError(f"colors: must be ({len(points_m)}, 3) uint8, got {colors.shape} {colors.dtype}")
        if not len(coordinates):
            return
        keys, voxels, counts = torch.unique(pack(coordinates), return_inverse=True, return_counts=True)
        color_sums = torch.zeros((len(keys), 3), dtype=torch.int64, device=self._device)
        color_sums.index_add_(0, voxels, torch.from_numpy(colors.astype(np.int64)).to(self._device))
        with self._lock:
            slots = self._slots(keys)
            self._colors[slots] = ((2 * color_sums + counts[:, None]) // (2 * counts[:, None])).to(torch.uint8)
            self._dense.accumulate(slots, voxels, patch_index, unit, patch_weights)
            self._fresh_fusion = None

    def integrate_proposals(
        self, points_m: NDArray[np.floating], proposals: NDArray[np.integer], embeddings: NDArray[np.floating]
    ) -> NDArray[np.int64]:
        """Associate a keyframe's proposals with instances, in order [sec: Instance-Level Semantic Voxel Mapping].

        Args:
            points_m: (n, 3) in the map frame, metres; a pixel that lies in several masks appears once for each.
            proposals: (n,) proposal of each point, in [0, m).
            embeddings: (m, d), one per proposal, any length but 0.

        Returns:
            (m,) int64 id that each proposal was given, -1 for one without a point. A later proposal of the same call may
            have displaced an earlier one's instance altogether.

        Raises:
            MapError: A shape, dtype, range or value is wrong.
        """
        coordinates = voxel_coordinates(points_m, self.config.voxel_size_m, self._device)
        proposal_index = index_tensor("proposals", proposals, len(points_m), len(embeddings), self._device)
        unit = unit_rows(embeddings, self.dimension, self._device)
        ids = np.full(len(embeddings), -1, np.int64)
        if not len(coordinates):
            return ids
        keys, voxels = torch.unique(pack(coordinates), return_inverse=True)
        pairs, counts = torch.unique(proposal_index * len(keys) + voxels, return_counts=True)
        present, sizes = torch.unique_consecutive(pairs // len(keys), return_counts=True)
        with self._lock:
            slots = self._slots(keys)[pairs % len(keys)]
            end = 0
            for proposal, size in zip(present.tolist(), sizes.tolist(), strict=True):
                start, end = end, end + size
                ids[proposal] = self._instances.integrate(slots[start:end], counts[start:end], unit[proposal])
            self._fresh_fusion = None
        return ids

    def prune_window(self, center_m: NDArray[np.floating]) -> int:
        """Drop the dense embeddings of voxels whose centre is farther than the window's radius [sec: Sliding Window].

        Args:
            center_m: (3,) camera position in the map frame, metres.

        Returns:
            Number of voxels that lost their dense embedding; 0 where the map has no window.

        Raises:
            MapError: The position is not three finite numbers.
        """
        center = float_tensor("center_m", center_m, (3,), self._device, torch.float64)
        if self.window_radius_m <= 0:
            return 0
        with self._lock:
            rows, slots = self._dense.live()
            distance = torch.linalg.vector_norm(self._centers(slots) - center, dim=1)
            gone = rows[distance > self.window_radius_m]
            if len(gone):
                self._dense.drop(gone)
                self._fresh_fusion = None
            return len(gone)

    def fuse(self) -> FusionReport:
        """Fuse the layers and store the instances' fused embeddings [sec: 3D Cross-Layer Semantic Fusion].

        Without a window every fused embedding is replaced. With one, only those whose new evidence is greater than the
        stored evidence, so that an object keeps what it had gathered when its dense voxels have left the window.
        """
        started = time.perf_counter()
        with self._lock:
            ids, fused, evidence = self._fusion()
            if self.window_radius_m > 0:
                better = evidence > self._instances.evidence(ids)
                ids, fused, evidence = ids[better], fused[better], evidence[better]
            self._instances.store_fused(ids, fused, evidence)
            return FusionReport(len(self._instances), len(ids), len(self._hash), time.perf_counter() - started)

    def voxels(self) -> VoxelSnapshot:
        """A copy of all voxels."""
        with self._lock:
            count = len(self._hash)
            slots = slice(0, count)
            self._reserve()
            top, top_count = self._instances.top(slots)
            return VoxelSnapshot(
                self._centers(slots).to(torch.float32).cpu().numpy(),
                self._colors[slots].cpu().numpy().copy(),
                top.cpu().numpy(),
                top_count.cpu().numpy(),
                self._dense.weights(slots).cpu().numpy(),
            )

    def instances(self) -> InstanceSnapshot:
        """A copy of all instances alive."""
        with self._lock:
            return self._snapshot_instances(self.voxels())

    def similarity(self, layer: str, texts: NDArray[np.float32]) -> LayerSimilarity:
        """Cosines of a layer with texts. Without a window, fusion is computed for the map as it is.

        Args:
            layer: One of LAYERS.
            texts: (p, d) text embeddings, any length but 0.

        Raises:
            QueryError: The layer is unknown.
            MapError: The texts have the wrong shape or are not finite.
        """
        if layer not in LAYERS:
            raise QueryError(f"unknown layer '{layer}', known are {', '.join(LAYERS)}")
        unit = unit_rows(texts, self.dimension, self._device)
        with self._lock:
            self._reserve()
            count = len(self._hash)
            if layer == "dense":
                slots, cosines = dense_similarity(self._dense, unit)
            elif layer == "fused_dense":
                slots, cosines = fused_dense_similarity(self._dense, self._instances, count, self.variance_ratio, unit)
            else:
                ids = self._instances.ids()
                if layer == "instances":
                    embeddings = self._instances.embeddings(ids)
                elif self.window_radius_m > 0:
                    embeddings = self._instances.fused_embeddings(ids)
                else:
                    embeddings = self._fusion()[1]
                slots, cosines = instance_similarity(self._instances, embeddings, count, unit)
            voxels = self.voxels()
            return LayerSimilarity(slots.cpu().numpy(), cosines.cpu().numpy(), voxels, self._snapshot_instances(voxels))

    def export_state(self) -> dict[str, NDArray[Any]]:
        """Everything the map holds, as arrays by name; what a map file stores and what :meth:`from_state` reads.

        Returns:
            voxel_coordinates (n, 3) int32; voxel_colors (n, 3) uint8; dense_slot (m,) int32; dense_weight (m,) float32;
            dense_embedding (m, d) in the storage type; hypothesis_id, hypothesis_count (n, K) int32; instance_id (i,) int64;
            instance_weight (i,) float64; instance_embedding (i, d) float32; fused_embedding (i, d) float32;
            fused_evidence (i,) float64, 0 before the first fusion; next_instance_id () int64.
        """
        with self._lock:
            self._reserve()
            slots = slice(0, len(self._hash))
            rows, dense_slots = self._dense.live()
            dense_slots, order = torch.sort(dense_slots)
            ids = self._instances.ids()
            held, counts = self._instances.hypotheses(slots)
            state = {
                "voxel_coordinates": self._hash.coordinates().to(torch.int32),
                "voxel_colors": self._colors[slots].clone(),
                "dense_slot": dense_slots.to(torch.int32),
                "dense_weight": self._dense.weights(dense_slots),
                "dense_embedding": self._dense.pool.read(rows[order]).to(getattr(torch, self.config.dtype)),
                "hypothesis_id": held.to(torch.int32),
                "hypothesis_count": counts.to(torch.int32),
                "instance_id": ids,
                "instance_weight": self._instances.weights(ids),
                "instance_embedding": self._instances.embeddings(ids),
                "fused_embedding": self._instances.fused_embeddings(ids),
                "fused_evidence": self._instances.evidence(ids),
                "next_instance_id": torch.tensor(self._instances.next_id),
            }
            return {name: tensor.cpu().numpy() for name, tensor in state.items()}

    def import_state(self, state: dict[str, NDArray[Any]]) -> None:
        """Replace the map's content by an exported state.

        Raises:
            MapError: An array is missing or its shape does not fit this map; the map keeps what it had.
        """
        check_state(state, self.dimension, self.config.max_hypotheses)
        tensors = {name: torch.from_numpy(np.array(array)).to(self._device) for name, array in state.items()}
        with self._lock:
            self._clear()
            slots = self._slots(pack(tensors["voxel_coordinates"].to(torch.int64)))
            self._colors[slots] = tensors["voxel_colors"]
            self._dense.restore(
                tensors["dense_slot"].to(torch.int64), tensors["dense_weight"], tensors["dense_embedding"].to(torch.float32)
            )
            self._instances.restore(slots, tensors["hypothesis_id"], tensors["hypothesis_count"])
            self._instances.restore_instances(
                int(tensors["next_instance_id"]),
                tensors["instance_id"],
                tensors["instance_weight"],
                tensors["instance_embedding"],
                tensors["fused_embedding"],
                tensors["fused_evidence"],
                len(slots),
            )

    def _fusion(self) -> tuple[Tensor, Tensor, Tensor]:
        """Fusion of the map as it is, kept until the map changes."""
        if self._fresh_fusion is None:
            self._fresh_fusion = fuse_instances(self._dense, self._instances, self.variance_ratio)
        return self._fresh_fusion

    def _slots(self, keys: Tensor) -> Tensor:
        slots = self._hash.find_or_insert(keys)
        self._reserve()
        return slots

    def _reserve(self) -> None:
        count = len(self._hash)
        self._colors.reserve(count)
        self._dense.reserve(count)
        self._instances.reserve(count)

    def _centers(self, slots: Tensor | slice) -> Tensor:
        """Voxel centres, (n, 3) float64 metres."""
        return (self._hash.coordinates(slots).to(torch.float64) + 0.5) * self.config.voxel_size_m

    def _snapshot_instances(self, voxels: VoxelSnapshot) -> InstanceSnapshot:
        ids = self._instances.ids()
        weights, hypotheses = self._instances.weights(ids), self._instances.voxels(ids)
        arrays = (ids.cpu().numpy(), weights.cpu().numpy(), hypotheses.cpu().numpy())
        return snapshot_instances(*arrays, voxels, self.config.voxel_size_m)
