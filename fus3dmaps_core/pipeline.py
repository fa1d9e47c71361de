"""From posed frames to the map: gates, encoders, segmentation, both layers, window and fusion. Live and offline alike."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fus3dmaps_core.answers.query import QueryAnswer, TextQuery, answer_query
from fus3dmaps_core.config.schema import Config
from fus3dmaps_core.encoders.batching import Batches, naming_out_of_memory
from fus3dmaps_core.encoders.mask_pooling import pool_masks
from fus3dmaps_core.encoders.protocols import EncoderTrio, PatchEmbeddings
from fus3dmaps_core.encoders.registry import load_trio
from fus3dmaps_core.encoders.text_cache import CachedTextEncoder
from fus3dmaps_core.frame import PosedFrame
from fus3dmaps_core.geometry.keyframe_gate import KeyframeGate
from fus3dmaps_core.geometry.projection import WorkingFrame, resize_frame, sample_pixels, unproject
from fus3dmaps_core.masks import Masks
from fus3dmaps_core.runtimes.acceleration import accelerate
from fus3dmaps_core.runtimes.image_memory import naming_image_size
from fus3dmaps_core.saved_maps.storage import MapInfo
from fus3dmaps_core.segmenters.filtering import filter_masks
from fus3dmaps_core.segmenters.protocols import Segmenter
from fus3dmaps_core.segmenters.registry import load_segmenter
from fus3dmaps_core.voxel_map.budget import KeyframeBound, MemoryBudget
from fus3dmaps_core.voxel_map.semantic_map import SemanticMap
from fus3dmaps_core.voxel_map.warm_up import warm_up


@dataclass
class FrameReport:
    """The result of processing a frame.

    Attributes:
        stamp_ns: Time of the frame, nanoseconds.
        dense: Whether it was a dense keyframe.
        instances: Whether it was an instance keyframe.
        proposals: Proposals integrated.
        dropped_dense_voxels: Voxels that lost their dense embedding so that the map keeps within its memory budget.
        window_radius_m: Effective radius of the sliding window, metres, which the budget may have made smaller; 0 for a map
            without a window.
        durations_s: Wall time by stage, seconds.
    """

    stamp_ns: int
    dense: bool = False
    instances: bool = False
    proposals: int = 0
    dropped_dense_voxels: int = 0
    window_radius_m: float = 0.0
    durations_s: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def timed(self, stage: str) -> Iterator[None]:
        """Add the time spent inside to a stage."""
        started = time.perf_counter()
        try:
            yield
        finally:
            self.durations_s[stage] = self.durations_s.get(stage, 0.0) + time.perf_counter() - started


class Pipeline:
    """Turns posed frames into a map. One thread feeds it; the map may be queried from others meanwhile.

    Attributes:
        config: What it was made with.
        trio: Encoders.
        semantic_map: The map.
        stamp_ns: Time of the newest keyframe, nanoseconds; 0 before the first.
    """

    def __init__(self, config: Config, trio: EncoderTrio, segmenter: Segmenter) -> None:
        """Start with an empty map; ``fusion.variance_ratio`` of 0 takes that of the encoders."""
        self.config = config
        self.trio = trio
        self._segmenter = segmenter
        self._crop_batches = Batches(f"crop encoder of '{trio.name}'")
        self.semantic_map = self.empty_map()
        self._make_gates()
        self._make_budget()
        self._processed = 0
        self.stamp_ns = 0
        self._camera_poses: list[NDArray[np.float64]] = []

    @classmethod
    def from_config(cls, config: Config | None = None) -> Pipeline:
        """Load the encoders and the segmenter that the configuration names, and warm up the map.

        Args:
            config: None takes the defaults.

        Raises:
            EncoderError: One of them is unknown, its packages or weights are missing or altered, or the runtime cannot be
                used.
        """
        config = config or Config()
        encoder = config.encoder
        segmenter = load_segmenter(config.segmenter.name, encoder, config.segmenter.weights)
        trio = load_trio(encoder.name, encoder.device, config.segmenter.crop_padding, encoder.weights)
        trio = accelerate(trio, encoder, config.image)
        trio = replace(trio, text=CachedTextEncoder(trio.text))
        warm_up(trio.dimension, config.map)
        return cls(config, trio, segmenter)

    def wants(self, T_world_camera: NDArray[np.float64]) -> bool:
        """Tell whether a frame with this pose would be a keyframe of either layer; changes nothing."""
        return self._dense_gate.wants(T_world_camera) or self._instance_gate.wants(T_world_camera)

    def ask(self, prompts: str | Sequence[str] | TextQuery, **options: Any) -> QueryAnswer:
        """Answer a query in words, e.g. ``pipeline.ask("a mug", top_k=3)``. The map is not changed.

        Args:
            prompts: What to look for: a prompt, several, or a whole query.
            **options: Other attributes of :class:`TextQuery`, by name.

        Raises:
            QueryError: The query is malformed, or the map or the layer is empty.
        """
        query = TextQuery.of(prompts, self.config.query, **options)
        return answer_query(self.semantic_map, self.trio.text, query, self.trio.logit_scale)

    @property
    def info(self) -> MapInfo:
        """What a saved map tells besides the map."""
        return MapInfo(
            self.trio.name,
            self.trio.logit_scale,
            self.config.input.map_frame,
            self.stamp_ns,
            self.config,
            self.camera_poses(),
        )

    def __repr__(self) -> str:
        """Say how much is mapped and by which encoders."""
        return f"Pipeline({len(self._camera_poses):,} keyframes, {self.semantic_map!r})"

    def process(self, frame: PosedFrame) -> FrameReport:
        """Integrate a frame, if it is a keyframe of one of the layers [sec: Implementation Details].

        A layer's inference runs before that layer is touched: what fails leaves the layer as it was. Room within the memory
        budget is made before the map grows, so that a frame that fails half-way cannot take more than was planned.

        Raises:
            EncoderError: There is not enough memory for a single image of the configured size.
        """
        T = frame.T_world_camera
        report = FrameReport(frame.stamp_ns, self._dense_gate.wants(T), self._instance_gate.wants(T))
        report.window_radius_m = self.semantic_map.window_radius_m
        if not (report.dense or report.instances):
            return report
        image = self.config.image
        with report.timed("resize"), naming_image_size(self.trio.name, image.height, image.width):
            working = resize_frame(frame, image)
        if self.config.map.memory_budget_mib > 0:
            with report.timed("memory"):
                report.dropped_dense_voxels = self._budget.make_room(self.semantic_map, T[:3, 3])
                report.window_radius_m = self.semantic_map.window_radius_m
        patches: PatchEmbeddings | None = None
        if report.dense:
            patches = self._encode_patches(working, report)
            self._integrate_dense(working, patches, T, report)
            self._dense_gate.accept(T)
        if report.instances:
            self._integrate_instances(working, patches, T, report)
            self._instance_gate.accept(T)
        self._processed += 1
        self.stamp_ns = frame.stamp_ns
        self._camera_poses.append(T.copy())
        if self.config.fusion.window_radius_m > 0:
            with report.timed("window"):
                self.semantic_map.prune_window(T[:3, 3])
            if self._processed % self.config.fusion.period_frames == 0:
                with report.timed("fusion"):
                    self.semantic_map.fuse()
        return report

    def reset(self) -> None:
        """Empty the map and forget the last keyframes."""
        self.semantic_map.reset()
        self._dense_gate.reset()
        self._instance_gate.reset()
        self._processed = self.stamp_ns = 0
        self._camera_poses.clear()

    def camera_poses(self) -> NDArray[np.float64]:
        """Return the poses T_world_camera of the keyframes so far: (n, 4, 4)."""
        return np.array(list(self._camera_poses), dtype=np.float64).reshape(-1, 4, 4)

    def _encode_patches(self, working: WorkingFrame, report: FrameReport) -> PatchEmbeddings:
        with report.timed("patch_encoder"), naming_out_of_memory(f"patch encoder of '{self.trio.name}'"):
            return self.trio.patch.encode_patches(working.rgb)

    def _integrate_dense(
        self, working: WorkingFrame, patches: PatchEmbeddings, T: NDArray[np.float64], report: FrameReport
    ) -> None:
        with report.timed("dense_update"):
            rows, columns, dimension = patches.embeddings.shape
            height, width = working.depth_m.shape
            pixels = sample_pixels(height, width, rows, columns, self.config.sampling.dense_per_patch)
            valid = working.depth_m[pixels.ys, pixels.xs] > 0
            ys, xs = pixels.ys[valid], pixels.xs[valid]
            self.semantic_map.integrate_dense(
                unproject(working.depth_m, ys, xs, working.intrinsics, T),
                pixels.patches[valid],
                patches.embeddings.reshape(-1, dimension),
                patches.weights.reshape(-1),
                working.rgb[ys, xs],
            )

    def _integrate_instances(
        self, working: WorkingFrame, patches: PatchEmbeddings | None, T: NDArray[np.float64], report: FrameReport
    ) -> None:
        with report.timed("segmentation"), naming_out_of_memory(f"segmenter '{self.config.segmenter.name}'"):
            masks = filter_masks(self._segmenter.segment(working.rgb, working.depth_m), self.config.segmenter)
            proposals, samples, ys, xs, masks = self._proposal_samples(working, masks)
        if not len(masks):
            return
        embeddings = self._describe(working, masks, patches, report)
        with report.timed("instance_update"):
            visible = unproject(working.depth_m, ys, xs, working.intrinsics, T)
            self.semantic_map.integrate_proposals(visible.take(samples, axis=0), proposals, embeddings, visible)
        report.proposals = len(masks)

    def _describe(
        self, working: WorkingFrame, masks: Masks, patches: PatchEmbeddings | None, report: FrameReport
    ) -> NDArray[np.float32]:
        """Embed masks by their crops, or by the patches of the frame, which the dense layer has had embedded or not."""
        if self.config.encoder.instance_embeddings == "patches":
            if patches is None:
                patches = self._encode_patches(working, report)
            with report.timed("mask_pooling"):
                return pool_masks(patches, masks)
        with report.timed("crop_encoder"):
            return self._crop_batches.run(
                lambda rows: self.trio.crop.encode_crops(working.rgb, Masks(masks.masks[rows], masks.boxes[rows])),
                len(masks),
            )

    def _proposal_samples(
        self, working: WorkingFrame, masks: Masks
    ) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], Masks]:
        """Find the sampled pixels with depth that lie inside each mask.

        Returns:
            Proposal and sample, two (n,) int64, of each sample inside a mask; row and column, two (q,) int64, of all
            samples; and the masks that have one: the others are left out before their crop is encoded.
        """
        height, width = working.depth_m.shape
        rows, columns = self.trio.patch.grid(height, width)
        pixels = sample_pixels(height, width, rows, columns, self.config.sampling.instance_per_patch)
        valid = working.depth_m[pixels.ys, pixels.xs] > 0
        ys, xs = pixels.ys[valid], pixels.xs[valid]
        inside = masks.masks[:, ys, xs]
        seen = np.flatnonzero(inside.any(axis=1))
        proposals, samples = np.nonzero(inside[seen])
        return proposals, samples, ys, xs, masks.take(seen)

    def empty_map(self) -> SemanticMap:
        """Make another map like this pipeline's, with nothing in it."""
        # Where patches describe both layers, the errors of both have the same variance.
        ratio = 1.0 if self.config.encoder.instance_embeddings == "patches" else self.trio.variance_ratio
        return SemanticMap.from_config(self.config, self.trio.dimension, ratio, self.trio.name)

    def restore(self, semantic_map: SemanticMap, stamp_ns: int, camera_poses: NDArray[np.float64]) -> None:
        """Go on from another map. The next frame is a keyframe of both layers.

        Args:
            semantic_map: Replaces the pipeline's; made by :meth:`empty_map` and filled since.
            stamp_ns: Time of its newest keyframe, nanoseconds.
            camera_poses: (n, 4, 4) T_world_camera of its keyframes.
        """
        self._dense_gate.reset()
        self._instance_gate.reset()
        self._processed = 0
        self.stamp_ns = stamp_ns
        self._camera_poses = [pose.copy() for pose in camera_poses]
        self.semantic_map = semantic_map

    def reconfigure(self, config: Config) -> None:
        """Take over the part of a configuration that a running pipeline can change; the map and the models stay.

        That part says how keyframes are chosen, masks filtered and windows fused, and how much memory there is. With other
        thresholds of motion the next frame is a keyframe.

        Args:
            config: Sections ``encoder`` and ``sampling``, and the map's own properties, must be those of the present one.
        """
        gates_changed = config.keyframes != self.config.keyframes
        self.config = config
        if gates_changed:
            self._make_gates()
        self._make_budget()
        if not config.map.memory_budget_mib and config.fusion.window_radius_m > 0:
            self.semantic_map.set_window_radius(config.fusion.window_radius_m)  # Nothing else would widen it again.

    def _make_gates(self) -> None:
        gates = self.config.keyframes
        self._dense_gate = KeyframeGate(gates.dense_translation_m, gates.dense_rotation_rad)
        self._instance_gate = KeyframeGate(gates.instance_translation_m, gates.instance_rotation_rad)

    def _make_budget(self) -> None:
        config = self.config
        rows, columns = self.trio.patch.grid(config.image.height, config.image.width)
        dense, instances = (
            rows * columns * samples for samples in (config.sampling.dense_per_patch, config.sampling.instance_per_patch)
        )
        # The most that a keyframe can add: each of its samples in a voxel of its own, each mask a new instance.
        bound = KeyframeBound(dense + instances, dense, config.segmenter.max_masks)
        self._budget = MemoryBudget(
            config.map.memory_budget_mib, config.fusion.window_radius_m, config.map.voxel_size_m, bound
        )
