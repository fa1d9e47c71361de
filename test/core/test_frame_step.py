"""One step maps a keyframe, skips a frame without motion, or drops what cannot be used."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest

from fus3dmaps_core.config.schema import Config
from fus3dmaps_core.errors import EncoderError, FrameError
from fus3dmaps_core.frame_step import FrameStep
from fus3dmaps_core.ledger import FrameCounts, Ledger
from fus3dmaps_core.pipeline import FrameReport


@dataclass
class Paired:
    stamp_ns: int = 1
    error: Exception | None = None
    T_world_camera: np.ndarray = field(default_factory=lambda: np.eye(4))

    def decode(self, image: Any) -> Paired:
        if self.error is not None:
            raise self.error
        return self


class StandInPipeline:
    config = Config()

    def __init__(self, wanted: bool = True, error: Exception | None = None) -> None:
        self.wanted, self.error = wanted, error

    def wants(self, T_world_camera: np.ndarray) -> bool:
        return self.wanted

    def process(self, frame: Paired) -> FrameReport:
        if self.error is not None:
            raise self.error
        return FrameReport(frame.stamp_ns, dense=True, instances=True, proposals=3, durations_s={"fusion": 0.5})


def test_a_keyframe_is_mapped_and_counted():
    ledger, decoded = Ledger(), []
    report = FrameStep(StandInPipeline(), ledger, lambda *frames: decoded.append(frames)).run(paired := Paired())
    assert report is not None
    assert list(report.durations_s) == ["decode", "fusion"]
    assert decoded == [(paired, paired)]
    assert ledger.counts() == FrameCounts(dense_keyframes=1, instance_keyframes=1, proposals=3)
    assert ledger.stages_s() == report.durations_s


def test_a_frame_without_motion_is_not_decoded():
    ledger = Ledger()
    step = FrameStep(StandInPipeline(wanted=False), ledger)
    assert step.run(Paired(error=FrameError("must not be decoded"))) is None
    assert ledger.counts() == FrameCounts(not_keyframes=1)
    assert not ledger.drops.counts()


def test_a_frame_that_cannot_be_used_is_a_drop():
    ledger = Ledger()
    assert FrameStep(StandInPipeline(), ledger).run(Paired(error=FrameError("rgb: cut", reason="bad_image"))) is None
    assert ledger.drops.latest() == {"bad_image": "rgb: cut"}
    assert ledger.counts() == FrameCounts()


def test_other_errors_are_the_callers():
    ledger = Ledger()
    with pytest.raises(EncoderError, match="no memory"):
        FrameStep(StandInPipeline(error=EncoderError("no memory")), ledger).run(Paired())
    assert ledger.counts() == FrameCounts()
    assert not ledger.drops.counts()
