"""From posed frames to the map: gates, encoders, segmentation, both layers, window and fusion. Live and offline alike."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from fus3dmaps_core.config import Config
from fus3dmaps_core.encoders.protocols import EncoderTrio
from fus3dmaps_core.encoders.registry import load_trio
from fus3dmaps_core.frame import PosedFrame
from fus3dmaps_core.geometry.motion import KeyframeGate
from fus3dmaps_core.geometry.projection import WorkingFrame, resize_frame, sample_pixels, unproject
from fus3dmaps_core.masks import Masks
from fus3dmaps_core.segmenters.filtering import filter_masks
from fus3dmaps_core.segmenters.protocols import Segmenter
from fus3dmaps_core.segmenters.registry import load_segmenter
from fus3dmaps_core.semantic_map import SemanticMap
from fus3dmaps_core.warm_up import warm_up


@dataclass
class FrameReport:
    """What became of a frame.

    Attributes:
        stamp_ns: Time of the frame, nanoseconds.
        dense: Whether it was a dense keyframe.
        instances: Whether it was an instance keyframe.
        proposals: Proposals integrated.
        durations_s: Wall time by stage, seconds.
    """

    stamp_ns: int
    dense: bool = False
    instances: bool = False
    proposals: int = 0
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
        """Start with an empty map; ``fusion.variance_ratio`` of 0 takes the trio's own."""
        self.config = config
        self.trio = trio
        self._segmenter = segmenter
        self.semantic_map = SemanticMap(
            trio.dimension,
            config.map,
            config.fusion.variance_ratio or trio.variance_ratio,
            config.fusion.window_radius_m,
        )
        gates = config.keyframes
        self._dense_gate = KeyframeGate(gates.dense_translation_m, gates.dense_rotation_rad)
        self._instance_gate = KeyframeGate(gates.instance_translation_m, gates.instance_rotation_rad)
        self._processed = 0
        self.stamp_ns = 0
        self._camera_poses: list[NDArray[np.float64]] = []

    @classmethod
    def from_config(cls, config: Config) -> Pipeline:
        """Load the encoders and the segmenter that the configuration names, and warm up the map.

        Raises:
            EncoderError: One of them is unknown, or its packages or weights are missing or altered.
        """
        segmenter = load_segmenter(config.segmenter.name, config.encoder.device)
        trio = load_trio(config.encoder.name, config.encoder.device, config.segmenter.crop_padding)
        warm_up(trio.dimension, config.map)
        return cls(config, trio, segmenter)

    def wants(self, T_world_camera: NDArray[np.float64]) -> bool:
        """Whether a frame with this pose would be a keyframe of either layer; changes nothing."""
        return self._dense_gate.wants(T_world_camera) or self._instance_gate.wants(T_world_camera)

    def process(self, frame: PosedFrame) -> FrameReport:
        """Integrate a frame, if it is a keyframe of one of the layers [sec: Implementation Details].

        A layer's inference runs before that layer is touched: what fails leaves the layer as it was.
        """
        T = frame.T_world_camera
        report = FrameReport(frame.stamp_ns, self._dense_gate.wants(T), self._instance_gate.wants(T))
        if not (report.dense or report.instances):
            return report
        with report.timed("resize"):
            working = resize_frame(frame, self.config.image)
        if report.dense:
            self._integrate_dense(working, T, report)
            self._dense_gate.accept(T)
        if report.instances:
            self._integrate_instances(working, T, report)
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
        """Poses T_world_camera of the keyframes so far: (n, 4, 4)."""
        return np.array(list(self._camera_poses), dtype=np.float64).reshape(-1, 4, 4)

    def _integrate_dense(self, working: WorkingFrame, T: NDArray[np.float64], report: FrameReport) -> None:
        with report.timed("patch_encoder"):
            patches = self.trio.patch.encode_patches(working.rgb)
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

    def _integrate_instances(self, working: WorkingFrame, T: NDArray[np.float64], report: FrameReport) -> None:
        with report.timed("segmentation"):
            masks = filter_masks(self._segmenter.segment(working.rgb, working.depth_m), self.config.segmenter)
            proposals, ys, xs, masks = self._proposal_pixels(working, masks)
        if not len(masks):
            return
        with report.timed("crop_encoder"):
            embeddings = self.trio.crop.encode_crops(working.rgb, masks)
        with report.timed("instance_update"):
            points = unproject(working.depth_m, ys, xs, working.intrinsics, T)
            self.semantic_map.integrate_proposals(points, proposals, embeddings)
        report.proposals = len(masks)

    def _proposal_pixels(
        self, working: WorkingFrame, masks: Masks
    ) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], Masks]:
        """Sampled pixels with depth inside each mask; masks without one are left out before their crop is encoded."""
        height, width = working.depth_m.shape
        rows, columns = self.trio.patch.grid(height, width)
        pixels = sample_pixels(height, width, rows, columns, self.config.sampling.instance_per_patch)
        valid = working.depth_m[pixels.ys, pixels.xs] > 0
        ys, xs = pixels.ys[valid], pixels.xs[valid]
        inside = masks.masks[:, ys, xs]
        seen = np.flatnonzero(inside.any(axis=1))
        proposals, samples = np.nonzero(inside[seen])
        return proposals, ys[samples], xs[samples], masks.take(seen)
