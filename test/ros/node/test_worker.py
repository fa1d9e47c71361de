"""The queue is bounded, the thread survives what frames do to it, and it ends when told to."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
from robot import wait_until

from fus3dmaps_core.config.schema import Config
from fus3dmaps_core.errors import FrameError
from fus3dmaps_core.ledger import Drops, Ledger
from fus3dmaps_core.pipeline import FrameReport
from fus3dmaps_ros.node.drop_log import DropLog
from fus3dmaps_ros.node.worker import FrameWorker


@dataclass
class Frame:
    stamp_ns: int
    error: Exception | None = None
    T_world_camera: np.ndarray = field(default_factory=lambda: np.eye(4))

    def decode(self, image: Any) -> Frame:
        if isinstance(self.error, FrameError):
            raise self.error
        return self


class RecordingPipeline:
    """Notes what it is asked; holds still inside ``process`` while ``gate`` is closed."""

    def __init__(self) -> None:
        self.config = Config()
        self.events: list[Any] = []
        self.wanted = True
        self.entered = threading.Event()
        self.gate = threading.Event()
        self.gate.set()

    def wants(self, T_world_camera: np.ndarray) -> bool:
        return self.wanted

    def process(self, frame: Frame) -> FrameReport:
        self.entered.set()
        assert self.gate.wait(60)
        if frame.error is not None:
            raise frame.error
        self.events.append(frame.stamp_ns)
        return FrameReport(frame.stamp_ns, dense=True, instances=frame.stamp_ns % 2 == 0)

    def reset(self) -> None:
        self.events.append("reset")


class Bench:
    def __init__(self) -> None:
        self.lines: list[str] = []
        self.pipeline = RecordingPipeline()
        self.drops = Drops(DropLog(self.lines.append).report)
        self.worker = FrameWorker(self.pipeline, 3, Ledger(self.drops))

    def hold_in(self, stamp_ns: int) -> None:
        """Have the thread stop inside a frame."""
        self.pipeline.gate.clear()
        self.pipeline.entered.clear()
        self.worker.offer(Frame(stamp_ns))
        assert self.pipeline.entered.wait(60)


@pytest.fixture
def bench() -> Iterator[Bench]:
    bench = Bench()
    bench.worker.start()
    yield bench
    bench.pipeline.gate.set()
    assert bench.worker.stop(60)


def test_the_oldest_frame_goes_and_is_counted(bench) -> None:
    bench.hold_in(1)
    for stamp_ns in range(2, 8):
        bench.worker.offer(Frame(stamp_ns))
    assert bench.worker.waiting == 3
    bench.pipeline.gate.set()
    wait_until(lambda: bench.worker.stamp_ns == 7, "the newest frame mapped")
    assert bench.pipeline.events == [1, 5, 6, 7]
    assert bench.drops.counts() == {"queue_full": 3}
    counts = bench.worker.ledger.counts()
    assert (counts.frames, counts.dense_keyframes, counts.instance_keyframes) == (7, 4, 1)


def test_a_failing_frame_is_counted_and_the_next_one_mapped(bench) -> None:
    bench.worker.offer(Frame(1, FrameError("rgb/image: empty", reason="bad_image")))
    bench.worker.offer(Frame(2, RuntimeError("CUDA out of memory")))
    bench.worker.offer(Frame(3))
    wait_until(lambda: bench.worker.stamp_ns == 3, "the good frame mapped")
    assert bench.drops.counts() == {"bad_image": 1, "processing_failed": 1}
    assert any("rgb/image: empty" in line for line in bench.lines)
    assert any("CUDA out of memory" in line and "Traceback" in line for line in bench.lines)


def test_frames_without_motion_are_not_decoded(bench) -> None:
    bench.pipeline.wanted = False
    bench.worker.offer(Frame(1, FrameError("must not be decoded")))
    wait_until(lambda: bench.worker.ledger.counts().not_keyframes == 1, "frame skipped")
    assert not bench.drops.counts()
    assert bench.worker.stamp_ns == 0


def test_the_stamp_is_that_of_the_latest_mapped_frame_or_of_the_first_in_work(bench) -> None:
    assert bench.worker.stamp_ns == 0
    bench.hold_in(1)
    assert bench.worker.stamp_ns == 1
    bench.pipeline.gate.set()
    wait_until(lambda: bench.worker.ledger.counts().dense_keyframes == 1, "first frame mapped")
    bench.hold_in(2)
    assert bench.worker.stamp_ns == 1
    bench.pipeline.gate.set()
    wait_until(lambda: bench.worker.stamp_ns == 2, "second frame mapped")


def test_calls_run_between_frames_and_before_those_that_wait(bench) -> None:
    bench.hold_in(1)
    bench.worker.offer(Frame(2))
    done = bench.worker.between_frames(lambda: bench.pipeline.events.append("call"))
    assert not done.done()
    bench.pipeline.gate.set()
    done.result(60)
    wait_until(lambda: bench.worker.stamp_ns == 2, "frame 2 mapped")
    assert bench.pipeline.events == [1, "call", 2]


class Observer:
    def __init__(self) -> None:
        self.events: list[Any] = []

    def offered(self, waiting: int) -> None:
        self.events.append(("offered", waiting))

    def decoded(self, paired: Frame, frame: Frame) -> None:
        self.events.append(("decoded", paired.stamp_ns, frame.stamp_ns))

    def finished(self, durations_s: Mapping[str, float], waiting: int) -> None:
        self.events.append(("finished", sorted(durations_s), waiting))


def test_an_observer_is_told_of_every_frame(bench) -> None:
    bench.worker.observer = observer = Observer()
    for frame in (Frame(1), Frame(2, RuntimeError("odd")), Frame(3, FrameError("rgb/image: empty"))):
        count = len(observer.events)
        bench.worker.offer(frame)
        wait_until(lambda count=count: observer.events[count:][-1:] and observer.events[-1][0] == "finished", "finished")
    bench.pipeline.wanted = False
    bench.worker.offer(Frame(4))
    wait_until(lambda: bench.worker.ledger.counts().not_keyframes == 1, "no keyframe")
    wait_until(lambda: len(observer.events) == 10, "all told")
    failed = ("finished", [], 0)
    assert observer.events == [
        ("offered", 1),
        ("decoded", 1, 1),
        ("finished", ["decode"], 0),
        ("offered", 1),
        ("decoded", 2, 2),
        failed,
        ("offered", 1),
        failed,
        ("offered", 1),
        failed,
    ]


def test_the_latest_keyframes_tell_how_long_each_stage_takes(bench) -> None:
    assert bench.worker.ledger.stage_times() == {}
    for stamp_ns in (1, 2):
        bench.worker.offer(Frame(stamp_ns))
    wait_until(lambda: bench.worker.stamp_ns == 2, "mapped")
    (stage,) = bench.worker.ledger.stage_times().items()
    assert stage[0] == "decode"
    assert 0 <= stage[1].mean_s <= stage[1].max_s


def test_a_call_gives_its_result_and_one_that_only_looks_is_no_change(bench) -> None:
    before = bench.worker.revision
    assert bench.worker.between_frames(lambda: 7, changes=False).result(60) == 7
    assert bench.worker.revision == before
    assert bench.worker.between_frames(lambda: 8).result(60) == 8
    assert bench.worker.revision == before + 1


def test_waiting_frames_can_be_dropped(bench) -> None:
    bench.hold_in(1)
    bench.worker.offer(Frame(2))
    bench.worker.drop_waiting()
    assert bench.worker.waiting == 0
    bench.pipeline.gate.set()
    bench.worker.between_frames(lambda: None).result(60)
    assert bench.pipeline.events == [1]


def test_a_failing_call_reports_to_its_caller_only(bench) -> None:
    def fail() -> None:
        raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"):
        bench.worker.between_frames(fail).result(60)
    bench.worker.offer(Frame(1))
    wait_until(lambda: bench.worker.stamp_ns == 1, "frame mapped")


def test_reset_drops_what_waits_and_follows_the_frame_in_work(bench) -> None:
    bench.hold_in(1)
    bench.worker.offer(Frame(2))
    done = bench.worker.reset()
    bench.pipeline.gate.set()
    done.result(60)
    assert bench.pipeline.events == [1, "reset"]
    assert bench.worker.stamp_ns == 0
    assert bench.worker.waiting == 0


def test_the_revision_grows_with_every_change(bench) -> None:
    before = bench.worker.revision
    bench.worker.offer(Frame(1))
    wait_until(lambda: bench.worker.revision > before, "revision grown")
    after_frame = bench.worker.revision
    bench.worker.reset().result(60)
    wait_until(lambda: bench.worker.revision > after_frame, "revision grown again")


def test_stopping_does_not_wait_for_a_stuck_frame_and_cancels_calls(bench) -> None:
    bench.hold_in(1)
    bench.worker.offer(Frame(2))
    pending = bench.worker.between_frames(lambda: None)
    assert not bench.worker.stop(0.01)
    assert pending.cancelled()
    bench.worker.offer(Frame(3))
    assert bench.worker.between_frames(lambda: None).cancelled()
    bench.pipeline.gate.set()
    assert bench.worker.stop(60)
    assert bench.pipeline.events == [1]


def test_a_worker_that_never_started_stops() -> None:
    assert FrameWorker(RecordingPipeline(), 1, Ledger()).stop(0.01)
