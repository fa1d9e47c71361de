"""The map: one voxel hash, two layers over it, and the sliding window.

A method holds the map's lock only while it computes on the map, so that queries are answered while mapping goes on. A call
that is refused has changed nothing.
"""

from __future__ import annotations

import math
import threading
import time
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from fus3dmaps_core.config.schema import Config, MapConfig
from fus3dmaps_core.errors import MapError, QueryError
from fus3dmaps_core.voxel_map.budget import KeyframeBound, MemoryUse
from fus3dmaps_core.voxel_map.checks import check_state
from fus3dmaps_core.voxel_map.kernels.protocols import GroupedCounts, Texts
from fus3dmaps_core.voxel_map.kernels.selection import select_kernels
from fus3dmaps_core.voxel_map.layer_query import LayerQuery
from fus3dmaps_core.voxel_map.layers.fusion import FusionInputs
from fus3dmaps_core.voxel_map.layers.similarity import LAYERS
from fus3dmaps_core.voxel_map.map_scan import Finding, Labelling, MapScan
from fus3dmaps_core.voxel_map.observations import ObservationReader
from fus3dmaps_core.voxel_map.snapshots import FusionReport, InstanceSnapshot, VoxelSnapshot
from fus3dmaps_core.voxel_map.state import MapState


class SemanticMap:
    """A voxel map with a dense and an instance layer, thread-safe.

    Attributes:
        dimension: Embedding width d.
        space: Name of the encoder trio whose embeddings it holds, or "". Queries of another trio are refused.
    """

    def __init__(
        self,
        dimension: int,
        config: MapConfig,
        variance_ratio: float,
        window_radius_m: float = 0.0,
        keep_most_evidence: bool = True,
        space: str = "",
    ) -> None:
        """Start empty.

        Args:
            dimension: Embedding width d.
            config: Voxel size, hypotheses, rules of association and merging, storage type, device and kernels.
            variance_ratio: lambda = R^D / R^I.
            window_radius_m: Radius r_w of the sliding window, metres; 0 keeps the whole dense layer and makes fusion
                replace every fused embedding, where a window keeps those of more evidence.
            keep_most_evidence: If false, fusion replaces every fused embedding with a window, too.
            space: Name of the encoder trio whose embeddings will come.

        Raises:
            ConfigError: The kernels that the configuration names do not run here.
        """
        self.dimension, self.space = dimension, space
        self.config = config
        self.variance_ratio = variance_ratio
        self._given_radius_m = self._radius_m = window_radius_m
        self._keep_most_evidence = keep_most_evidence
        self._device = torch.device(config.device)
        self._kernels = select_kernels(config.backend, self._device)
        self._read = ObservationReader(dimension, config.voxel_size_m, self._kernels, self._device)
        self._lock = threading.RLock()
        self._state = self._empty_state()

    @classmethod
    def from_config(cls, config: Config, dimension: int, variance_ratio: float, space: str = "") -> SemanticMap:
        """Make an empty map as the configuration says.

        Args:
            config: Sections ``map`` and ``fusion`` are used.
            dimension: Embedding width d.
            variance_ratio: lambda of the encoders, which holds unless ``fusion.variance_ratio`` is set.
            space: Name of the encoder trio whose embeddings will come.

        Raises:
            ConfigError: The kernels that the configuration names do not run here.
        """
        fusion = config.fusion
        ratio = fusion.variance_ratio or variance_ratio
        return cls(dimension, config.map, ratio, fusion.window_radius_m, fusion.keep_most_evidence, space)

    def __repr__(self) -> str:
        """Say how much the map holds."""
        return (
            f"SemanticMap({self.voxel_count:,} voxels of {self.config.voxel_size_m:g} m, {self.dense_voxel_count:,} of them"
            f" dense, {self.instance_count:,} instances, d = {self.dimension}, encoder '{self.space}')"
        )

    @property
    def window_radius_m(self) -> float:
        """Effective radius of the sliding window, metres; 0 for a map without one."""
        with self._lock:
            return self._radius_m

    @property
    def voxel_count(self) -> int:
        """Voxels of the map."""
        with self._lock:
            return len(self._state.hash)

    @property
    def dense_voxel_count(self) -> int:
        """Voxels with a dense embedding."""
        with self._lock:
            return len(self._state.dense)

    @property
    def instance_count(self) -> int:
        """Instances alive."""
        with self._lock:
            return len(self._state.instances)

    def nbytes(self) -> dict[str, int]:
        """Return the allocated bytes by part."""
        with self._lock:
            return self._state.nbytes()

    def memory_use(self, bound: KeyframeBound) -> MemoryUse:
        """Return the allocated bytes, and what a keyframe of at most this size can make of them."""
        with self._lock:
            return self._state.memory_use(bound)

    def reset(self) -> None:
        """Empty the map. Instance ids start at 0 again, and the window gets its first radius back."""
        with self._lock:
            self._state = self._empty_state()
            self._radius_m = self._given_radius_m

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
        seen = self._read.dense(points_m, patches, embeddings, weights, colors)
        if not len(seen.keys):
            return
        with self._lock:
            slots = self._state.slots(seen.keys)
            self._state.colors[slots] = seen.colors
            changed = self._state.dense.accumulate(slots, seen.keys, seen.patches, seen.embeddings, seen.weights)
            self._state.instances.mark_changed(changed)

    def integrate_proposals(
        self,
        points_m: NDArray[np.floating],
        proposals: NDArray[np.integer],
        embeddings: NDArray[np.floating],
        visible_points_m: NDArray[np.floating] | None = None,
    ) -> NDArray[np.int64]:
        """Associate a keyframe's proposals with instances, in order [sec: Instance-Level Semantic Voxel Mapping].

        With ``map.merge_overlap`` those that have grown into one another then merge:
        :mod:`fus3dmaps_core.voxel_map.layers.merging`.

        Args:
            points_m: (n, 3) in the map frame, metres; a pixel that lies in several masks appears once for each.
            proposals: (n,) proposal of each point, in [0, m).
            embeddings: (m, d), one per proposal, any length but 0.
            visible_points_m: (q, 3) what the keyframe saw, in proposals or not, for association by ``visible_iou``; the
                proposals' own points need not be among them. Association by ``iou`` does not look at them.

        Returns:
            (m,) int64 id that each proposal was given, -1 for one without a point; of an instance that was merged, the id of
            the one that took it in. A later proposal of the same call may have displaced an earlier one's instance
            altogether.

        Raises:
            MapError: A shape, dtype, range or value is wrong.
        """
        needs_visible = self.config.association == "visible_iou"
        seen = self._read.proposals(points_m, proposals, embeddings, visible_points_m, needs_visible)
        if not len(seen.keys):
            return np.full(len(embeddings), -1, np.int64)
        with self._lock:
            self._state.instances.check_room(len(embeddings))
            slots = self._state.slots(seen.keys)
            groups = GroupedCounts(seen.voxels.offsets, slots.index_select(0, seen.voxels.partners), seen.voxels.counts)
            ids = self._state.associate(slots, groups, seen.embeddings, seen.visible_keys)
        return ids.cpu().numpy()

    def set_window_radius(self, radius_m: float) -> None:
        """Change the effective radius of the sliding window; what is farther is dropped by the next pruning.

        Args:
            radius_m: Metres, greater than 0.

        Raises:
            MapError: The map was made without a window, or the radius is not a finite number greater than 0.
        """
        if self._given_radius_m <= 0:
            raise MapError("radius_m: the map was made without a window")
        if not 0.0 < radius_m < math.inf:
            raise MapError(f"radius_m: must be a finite number greater than 0, got {radius_m}")
        with self._lock:
            self._radius_m = radius_m

    def prune_window(self, center_m: NDArray[np.floating]) -> int:
        """Drop the dense embeddings of voxels whose centre is farther than the window's radius [sec: Sliding Window].

        Args:
            center_m: (3,) camera position in the map frame, metres.

        Returns:
            Number of voxels that lost their dense embedding; 0 where the map has no window.

        Raises:
            MapError: The position is not three finite numbers.
        """
        center = self._read.position("center_m", center_m)
        if self._given_radius_m <= 0:
            return 0
        with self._lock:
            rows, slots = self._state.dense.live()
            keys = self._state.hash.keys(slots)
            gone = self._kernels.farther(keys, self.config.voxel_size_m, center, self._radius_m)
            if len(gone):
                self._state.instances.mark_changed(slots.index_select(0, gone))
                self._state.dense.drop(rows.index_select(0, gone))
            return len(gone)

    def drop_least_observed(self, count: int) -> int:
        """Drop the dense embeddings of the voxels of least weight w^D; of equal ones those of the lowest slots.

        Slots are given in the order in which voxels came, but those of removed voxels are given again. Voxels, hypotheses
        and instances stay.

        Args:
            count: How many, if there are as many.

        Returns:
            Number of voxels that lost their dense embedding.

        Raises:
            MapError: The count is less than 0.
        """
        if count < 0:
            raise MapError(f"count: must not be less than 0, got {count}")
        with self._lock:
            rows = self._state.dense.least_observed(count)
            if len(rows):
                self._state.instances.mark_changed(self._state.dense.slots(rows))
                self._state.dense.drop(rows)
            return len(rows)

    def release_unused(self) -> int:
        """Free memory that holds no dense embedding, in whole blocks. What the map holds and answers stays the same.

        Returns:
            Bytes that were freed.
        """
        with self._lock:
            before = self._state.dense.nbytes
            self._state.dense.compact()
            return before - self._state.dense.nbytes

    def remove_voxels(self, points_m: NDArray[np.floating]) -> int:
        """Remove the voxels that contain the points, with all that both layers know of them.

        Instances that are left without a voxel are deleted; others keep their embedding. What is stored of a removed voxel
        is given to new ones.

        Args:
            points_m: (n, 3) in the map frame, metres; points outside of all voxels are no fault.

        Returns:
            Number of voxels removed.

        Raises:
            MapError: A shape, dtype, range or value is wrong.
        """
        keys, _, _ = self._kernels.distinct(self._read.voxel_keys("points_m", points_m))
        with self._lock:
            slots = self._state.hash.find(keys)
            slots = slots.masked_select(slots >= 0)
            if len(slots):
                self._state.remove(slots)
            return len(slots)

    def fuse(self, full: bool = False) -> FusionReport:
        """Fuse the layers and store the instances' fused embeddings [sec: 3D Cross-Layer Semantic Fusion].

        Without a window every fused embedding becomes that of the map as it is. With one, only those are replaced whose new
        evidence is greater than the stored evidence, so that an object keeps what it had gathered when its dense voxels
        have left the window; unless the map was made to replace them always.

        Args:
            full: Compute every instance. Otherwise only those that have changed since are computed, with the same result.
        """
        started = time.perf_counter()
        with self._lock:
            state = self._state
            updated, recomputed = state.fused.fuse(self._fusion_inputs(), full)
            duration_s = time.perf_counter() - started
            return FusionReport(len(state.instances), updated, recomputed, len(state.hash), duration_s)

    def voxels(self) -> VoxelSnapshot:
        """Return a copy of all voxels."""
        with self._lock:
            state = self._state
            slots = state.hash.live()
            top_rows, top_counts = state.instances.top(slots)
            return VoxelSnapshot(
                self._kernels.centers(state.hash.keys(slots), self.config.voxel_size_m).cpu().numpy(),
                state.colors[slots].cpu().numpy(),
                state.instances.ids(top_rows).cpu().numpy(),
                top_counts.cpu().numpy(),
                state.dense.weights(state.dense.rows(slots)).cpu().numpy(),
            )

    def instances(self) -> InstanceSnapshot:
        """Return a copy of all instances alive."""
        with self._lock:
            return self._scan().instances()

    def search(self, query: LayerQuery) -> Finding:
        """Compare a layer with texts [sec: Implementation Details]. The map is not changed, and does not change meanwhile.

        Without a window, fusion is that of the map as it is. Memory beside the answer does not grow with the map.

        Raises:
            QueryError: The layer is unknown, or there is no prompt.
            MapError: The texts have the wrong shape or are not finite.
        """
        _check_asked(query.layer, "prompt", query.prompts)
        vectors = [self._read.unit_rows("prompts", query.prompts)]
        if query.negatives is not None:
            vectors.append(self._read.unit_rows("negatives", query.negatives))
        texts = Texts(torch.cat(vectors), len(query.prompts), query.logit_scale)
        with self._lock:
            return self._scan().search(query, texts)

    def label(self, layer: str, texts: NDArray[np.floating]) -> Labelling:
        """Find which of some texts fits each voxel of a layer best, and each instance; otherwise like :meth:`search`.

        Args:
            layer: One of LAYERS.
            texts: (p, d) text embeddings, any length but 0.

        Raises:
            QueryError: The layer is unknown, or there is no text.
            MapError: The texts have the wrong shape or are not finite.
        """
        _check_asked(layer, "text", texts)
        vectors = self._read.unit_rows("texts", texts)
        with self._lock:
            return self._scan().label(layer, vectors)

    def export_state(self) -> dict[str, NDArray[Any]]:
        """Return everything the map holds, as arrays by name: what a map file stores and :meth:`import_state` reads.

        Returns:
            What :meth:`MapState.export` says.
        """
        with self._lock:
            return self._state.export()

    def import_state(self, state: dict[str, NDArray[Any]]) -> None:
        """Replace the map's content by an exported state.

        Raises:
            MapError: An array is missing or its shape does not fit this map; the map keeps what it had.
        """
        check_state(state, self.dimension, self.config.max_hypotheses)
        fresh = self._empty_state()
        fresh.fill(state)
        with self._lock:
            self._state = fresh

    def _scan(self) -> MapScan:
        return MapScan(self._state, self._fusion_inputs(), self.config.voxel_size_m)

    def _empty_state(self) -> MapState:
        return MapState(self.dimension, self.config, self._given_radius_m > 0, self._kernels, self._keep_most_evidence)

    def _fusion_inputs(self) -> FusionInputs:
        return FusionInputs(self._kernels, self._state.dense, self._state.instances, self.variance_ratio)


def _check_asked(layer: str, what: str, texts: NDArray[np.floating]) -> None:
    if layer not in LAYERS:
        raise QueryError(f"unknown layer '{layer}', known are {', '.join(LAYERS)}")
    if texts.shape[:1] == (0,):
        raise QueryError(f"{what}s: at least one {what} is needed")
