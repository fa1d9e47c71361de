"""One step of mapping, live and offline alike: a paired message becomes a keyframe, is skipped, or is dropped."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

from fus3dmaps_core.errors import FrameError
from fus3dmaps_core.frame import PosedFrame
from fus3dmaps_core.ledger import Ledger
from fus3dmaps_core.pipeline import FrameReport, Pipeline
from fus3dmaps_core.sources.paired import PairedMessages


@dataclass(frozen=True)
class FrameStep:
    """Gives paired messages to the pipeline one by one and counts what happens; only keyframes are decoded.

    Attributes:
        pipeline: Maps the frames.
        ledger: Counts them.
        on_decoded: Called with each keyframe before it is mapped.
    """

    pipeline: Pipeline
    ledger: Ledger
    on_decoded: Callable[[PairedMessages, PosedFrame], None] | None = None

    def run(self, paired: PairedMessages) -> FrameReport | None:
        """Map a frame if it is a keyframe.

        Returns:
            The pipeline's report, with the stage ``decode`` before its own; None for a frame that is not a keyframe, or that
            cannot be used and is counted as a drop.

        Raises:
            EncoderError: As :meth:`Pipeline.process`.
        """
        if not self.pipeline.wants(paired.T_world_camera):
            self.ledger.add_not_keyframe()
            return None
        try:
            report = self._map(paired)
        except FrameError as error:
            self.ledger.drops.add(error.reason, str(error))
            return None
        self.ledger.add_keyframe(report.dense, report.instances, report.proposals, report.durations_s)
        return report

    def _map(self, paired: PairedMessages) -> FrameReport:
        started_s = time.perf_counter()
        frame = paired.decode(self.pipeline.config.image)
        decode_s = time.perf_counter() - started_s
        if self.on_decoded is not None:
            self.on_decoded(paired, frame)
        report = self.pipeline.process(frame)
        return replace(report, durations_s={"decode": decode_s, **report.durations_s})
