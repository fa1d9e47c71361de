"""Mapping of one simulated building in several ways at once; each frame is rendered, segmented and embedded once."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from fus3dmaps_core.config.schema import Config
from fus3dmaps_core.encoders.protocols import EncoderTrio
from fus3dmaps_core.pipeline import Pipeline
from fus3dmaps_lab.evaluation.shared_models import shared_segmenter, shared_trio
from fus3dmaps_lab.simulation.models.encoder_statistics import EncoderStatistics
from fus3dmaps_lab.simulation.models.oracle import Oracle
from fus3dmaps_lab.simulation.models.simulated_encoders import simulated_trio
from fus3dmaps_lab.simulation.models.simulated_segmenter import SegmenterStatistics, SimulatedSegmenter
from fus3dmaps_lab.simulation.truth import LabelledFrame, Truth


@dataclass(frozen=True)
class Variant:
    """One way of mapping a building.

    Attributes:
        settings: Parameters that differ from the defaults, by dotted key.
        statistics: Statistics of the simulated encoders; variants with equal statistics get equal embeddings.
    """

    settings: Mapping[str, Any] = field(default_factory=dict)
    statistics: EncoderStatistics = field(default_factory=EncoderStatistics)


class BuildingRun:
    """Several maps of one building from the same frames.

    Attributes:
        pipelines: Pipelines by the name of their variant.
    """

    def __init__(
        self,
        truth: Truth,
        image_size: tuple[int, int],
        variants: Mapping[str, Variant],
        seed: int,
        segmenter_statistics: SegmenterStatistics | None = None,
    ) -> None:
        """Make the encoders and empty maps.

        Args:
            truth: Ground truth of the building.
            image_size: Width and height of its images, pixels.
            variants: The variants, by name.
            seed: Seed of the simulated models.
            segmenter_statistics: Statistics of the simulated segmenter; None takes the defaults.
        """
        width, height = image_size
        self._oracle = Oracle()
        statistics = segmenter_statistics or SegmenterStatistics()
        segmenter = shared_segmenter(SimulatedSegmenter(self._oracle, truth, replace(statistics, seed=seed)))
        trios: dict[EncoderStatistics, EncoderTrio] = {}
        self.pipelines: dict[str, Pipeline] = {}
        for name, variant in variants.items():
            seeded = replace(variant.statistics, seed=seed)
            if seeded not in trios:
                trios[seeded] = shared_trio(simulated_trio(self._oracle, truth, seeded))
            settings = {"image.width": width, "image.height": height, **variant.settings}
            self.pipelines[name] = Pipeline(Config.from_flat(settings), trios[seeded], segmenter)

    def feed(self, frames: Iterable[LabelledFrame], on_frame: Callable[[int], object] | None = None) -> None:
        """Map frames with every variant, and fuse at the end.

        Args:
            frames: Frames in order of time.
            on_frame: Called with the number of frames done.
        """
        for done, labelled in enumerate(frames, start=1):
            self._oracle.look(labelled)
            for pipeline in self.pipelines.values():
                pipeline.process(labelled.frame)
            if on_frame is not None:
                on_frame(done)
        for pipeline in self.pipelines.values():
            pipeline.semantic_map.fuse()
