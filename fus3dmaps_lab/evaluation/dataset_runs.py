"""Mapping of a published dataset's scene in every mode, and comparison with its labels."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from fus3dmaps_core.config.schema import Config
from fus3dmaps_core.encoders.registry import load_trio
from fus3dmaps_core.errors import RecordingError
from fus3dmaps_core.frame import PosedFrame
from fus3dmaps_core.geometry.projection import resize_frame
from fus3dmaps_core.pipeline import Pipeline
from fus3dmaps_core.runtimes.acceleration import accelerate
from fus3dmaps_core.segmenters.registry import load_segmenter
from fus3dmaps_lab.datasets.protocols import LabelledDataset
from fus3dmaps_lab.evaluation.evaluate_map import INSTANCE_LAYERS, evaluate_map
from fus3dmaps_lab.evaluation.ground_truth import (
    LabelledDepth,
    VoxelTruth,
    labelled_depth,
    voxel_truth,
    voxel_truth_from_frames,
)
from fus3dmaps_lab.evaluation.records import LAYERS, MODES, Record
from fus3dmaps_lab.evaluation.shared_models import shared_segmenter, shared_trio

PUBLISHED_WINDOW_M = 6.0
"""Radius of the sliding window if the configuration has none."""


def evaluate_dataset(
    dataset: LabelledDataset, config: Config, on_progress: Callable[[int, int], object] | None = None
) -> list[Record]:
    """Map a scene in every mode, with one pass of the segmenter and of each encoder for all modes, and evaluate the maps.

    Args:
        dataset: The scene.
        config: Configuration of the mapping. ``fusion.window_radius_m`` is used in the modes with a window; 0 becomes 6 m.
        on_progress: Called with the number of frames mapped and of all frames.

    Raises:
        RecordingError: The scene has no frame, or no voxel with a label.
        EncoderError: A model cannot be loaded.
    """
    window = {"fusion.window_radius_m": config.fusion.window_radius_m or PUBLISHED_WINDOW_M}
    settings = {
        "full": {"fusion.window_radius_m": 0.0},
        "window": window,
        "window_no_evidence": {**window, "fusion.keep_most_evidence": False},
    }
    encoder = config.encoder
    trio = load_trio(encoder.name, encoder.device, config.segmenter.crop_padding, encoder.weights)
    trio = shared_trio(accelerate(trio, encoder, config.image))
    segmenter = shared_segmenter(load_segmenter(config.segmenter.name, encoder, config.segmenter.weights))
    pipelines = {mode: Pipeline(config.with_values(settings[mode]), trio, segmenter) for mode in MODES}
    for done, frame in enumerate(dataset, start=1):
        working = _at_working_resolution(frame, config)
        for pipeline in pipelines.values():
            pipeline.process(working)
        if on_progress is not None:
            on_progress(done, len(dataset))
    for pipeline in pipelines.values():
        pipeline.semantic_map.fuse()
    everything, objects = _truths(dataset, config)
    if not everything.classes.any():
        raise RecordingError(f"scene '{dataset.scene}' has no voxel with a label")
    texts = trio.text.encode_text(dataset.class_names[1:])
    return [
        Record(dataset.scene, 0, layer, mode, metric, value)
        for mode, pipeline in pipelines.items()
        for layer, metrics in evaluate_map(
            pipeline.semantic_map,
            texts,
            everything,
            dataset.class_names,
            dataset.background,
            LAYERS if mode == "full" else INSTANCE_LAYERS,
            trio.logit_scale,
            truth_without_background=objects,
        ).items()
        for metric, value in metrics.items()
    ]


def _at_working_resolution(frame: PosedFrame, config: Config) -> PosedFrame:
    """Resize a frame once, so that all pipelines pass on the same image."""
    working = resize_frame(frame, config.image)
    return PosedFrame(frame.stamp_ns, working.rgb, working.depth_m, working.intrinsics, frame.T_world_camera)


def _truths(dataset: LabelledDataset, config: Config) -> tuple[VoxelTruth, VoxelTruth | None]:
    """Return the truth of all classes, and that without background if a voxel's class depends on the classes kept."""
    size_m = config.map.voxel_size_m
    points = dataset.ground_truth_points()
    if points is not None:
        return voxel_truth(*points, size_m), None

    def frames() -> Iterator[LabelledDepth]:
        for index, frame in enumerate(dataset):
            yield labelled_depth(frame, dataset.label_image(index), dataset.instance_image(index), config.image)

    return voxel_truth_from_frames(frames(), size_m), voxel_truth_from_frames(frames(), size_m, dataset.background)
