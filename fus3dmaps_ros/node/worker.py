"""A bounded queue and the one thread that feeds the pipeline, so that no callback ever waits for a network."""

from __future__ import annotations

import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from dataclasses import dataclass, replace
from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from fus3dmaps_core.errors import FrameError
from fus3dmaps_core.frame import PosedFrame
from fus3dmaps_core.pipeline import Pipeline
from fus3dmaps_core.sources.pairing import PairedMessages
from fus3dmaps_core.voxel_map.semantic_map import SemanticMap
from fus3dmaps_ros.node.drops import DropLog

_TIMED_KEYFRAMES = 100

T = TypeVar("T")


class FrameObserver(Protocol):
    """Who is told what becomes of frames; must return at once."""

    def offered(self, waiting: int) -> None:
        """A frame was queued, and so many wait now."""
        ...

    def decoded(self, paired: PairedMessages, frame: PosedFrame) -> None:
        """A keyframe was decoded and is about to be mapped."""
        ...

    def finished(self, durations_s: Mapping[str, float], waiting: int) -> None:
        """A frame was dealt with in so many seconds by stage, none of them if it was no keyframe or failed."""
        ...


@dataclass(frozen=True)
class StageTime:
    """How long a stage took in the latest keyframes.

    Attributes:
        mean_s: Mean, seconds.
        max_s: Longest, seconds.
    """

    mean_s: float
    max_s: float


@dataclass
class WorkerCounts:
    """What became of the frames that were offered.

    Attributes:
        frames: Frames offered.
        not_keyframes: Frames with too little motion since the last keyframe.
        dense_keyframes: Frames integrated into the dense layer.
        instance_keyframes: Frames integrated into the instance layer.
    """

    frames: int = 0
    not_keyframes: int = 0
    dense_keyframes: int = 0
    instance_keyframes: int = 0


class FrameWorker:
    """Maps paired messages in order of arrival; when the queue is full the oldest one goes.

    A frame that fails is counted under its reason (``processing_failed`` for anything but a FrameError) and the thread
    goes on with the next one.

    Attributes:
        observer: Is told of every frame; None for nobody. May be changed at any time.
    """

    def __init__(self, pipeline: Pipeline, queue_size: int, drops: DropLog) -> None:
        """Start with an empty queue; :meth:`start` runs the thread.

        Args:
            pipeline: Maps the frames.
            queue_size: Frames that can wait.
            drops: Counts those that go unmapped.
        """
        self._pipeline = pipeline
        self._queue_size = queue_size
        self._drops = drops
        self.observer: FrameObserver | None = None
        self._frames: deque[PairedMessages] = deque()
        self._calls: deque[tuple[Future[Any], Callable[[], Any], bool]] = deque()
        self._wake = threading.Condition()
        self._closing = False
        self._counts = WorkerCounts()
        self._durations_s: deque[dict[str, float]] = deque(maxlen=_TIMED_KEYFRAMES)
        self._stamp_ns = 0
        self._revision = 0
        # Daemon: an inference that cannot be interrupted must not keep the process from ending.
        self._thread = threading.Thread(target=self._run, name="mapping", daemon=True)

    @property
    def stamp_ns(self) -> int:
        """Stamp of the latest frame that is in the map (the first one: from when it is begun), nanoseconds; 0 before."""
        with self._wake:
            return self._stamp_ns

    @property
    def revision(self) -> int:
        """A number that grows whenever the map may have changed."""
        with self._wake:
            return self._revision

    @property
    def waiting(self) -> int:
        """Frames in the queue."""
        with self._wake:
            return len(self._frames)

    def counts(self) -> WorkerCounts:
        """A copy of the counts."""
        with self._wake:
            return replace(self._counts)

    def stage_times(self) -> dict[str, StageTime]:
        """How long each stage took in the latest keyframes."""
        with self._wake:
            durations_s = list(self._durations_s)
        of_stage: dict[str, list[float]] = {}
        for keyframe in durations_s:
            for stage, duration_s in keyframe.items():
                of_stage.setdefault(stage, []).append(duration_s)
        return {stage: StageTime(sum(times) / len(times), max(times)) for stage, times in of_stage.items()}

    def start(self) -> None:
        """Run the thread."""
        self._thread.start()

    def offer(self, paired: PairedMessages) -> None:
        """Queue a frame; never blocks. Does nothing once the worker is stopping."""
        with self._wake:
            if self._closing:
                return
            self._counts.frames += 1
            dropped = self._frames.popleft() if len(self._frames) >= self._queue_size else None
            self._frames.append(paired)
            waiting = len(self._frames)
            self._wake.notify()
        observer = self.observer
        if observer is not None:
            observer.offered(waiting)
        if dropped is not None:
            self._drops.count(
                "queue_full", f"mapping is slower than the keyframes come; the image at {dropped.stamp_ns} ns went unmapped"
            )

    def between_frames(self, function: Callable[[], T], changes: bool = True) -> Future[T]:
        """Have a function run by the thread before the next frame, when nothing else touches the pipeline.

        Args:
            function: What to run.
            changes: Whether it may change the map.

        Returns:
            Done, or failed with the function's exception, once it has run; cancelled if the worker stops first.
        """
        future: Future[T] = Future()
        with self._wake:
            if self._closing:
                future.cancel()
            else:
                self._calls.append((future, function, changes))
                self._wake.notify()
        return future

    def drop_waiting(self) -> None:
        """Drop the frames that wait."""
        with self._wake:
            self._frames.clear()

    def reset(self) -> Future[None]:
        """Drop the frames that wait, and empty the pipeline between frames."""

        def empty() -> None:
            self._pipeline.reset()
            with self._wake:
                self._stamp_ns = 0

        self.drop_waiting()
        return self.between_frames(empty)

    def restore(self, semantic_map: SemanticMap, stamp_ns: int, camera_poses: NDArray[np.float64]) -> Future[None]:
        """Have the pipeline go on from another map between frames, see :meth:`Pipeline.restore`; frames that wait stay."""

        def swap() -> None:
            self._pipeline.restore(semantic_map, stamp_ns, camera_poses)
            with self._wake:
                self._stamp_ns = stamp_ns

        return self.between_frames(swap)

    def stop(self, timeout_s: float) -> bool:
        """Let the frame in work finish and end the thread; what waits is dropped.

        Returns:
            Whether the thread has ended within the time.
        """
        with self._wake:
            self._closing = True
            self._frames.clear()
            for future, *_ in self._calls:
                future.cancel()
            self._calls.clear()
            self._wake.notify()
        if self._thread.ident is not None:
            self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _run(self) -> None:
        while True:
            with self._wake:
                self._wake.wait_for(lambda: self._closing or self._calls or self._frames)
                if self._closing:
                    return
                call = self._calls.popleft() if self._calls else None
                frame = None if call else self._frames.popleft()
            if call is not None:
                self._call(*call)
            elif frame is not None:
                self._map(frame)

    def _call(self, future: Future[T], function: Callable[[], T], changes: bool) -> None:
        if not future.set_running_or_notify_cancel():
            return
        try:
            result = function()
        except Exception as error:
            self._revise(changes)
            future.set_exception(error)
        else:
            self._revise(changes)
            future.set_result(result)

    def _revise(self, changes: bool) -> None:
        with self._wake:
            self._revision += changes

    def _map(self, paired: PairedMessages) -> None:
        durations_s: dict[str, float] = {}
        try:
            durations_s = self._try_to_map(paired)
        except FrameError as error:
            self._drops.count(error.reason, str(error))
        except Exception:
            # Whatever a network or a driver throws at one frame must not end a day of mapping. One layer may have it.
            self._revise(True)
            self._drops.count(
                "processing_failed", f"the image at {paired.stamp_ns} ns could not be mapped\n{traceback.format_exc()}"
            )
        observer = self.observer
        if observer is not None:
            observer.finished(durations_s, self.waiting)

    def _try_to_map(self, paired: PairedMessages) -> dict[str, float]:
        """Seconds by stage, none for a frame that is no keyframe."""
        if not self._pipeline.wants(paired.T_world_camera):
            with self._wake:
                self._counts.not_keyframes += 1
            return {}
        started_s = time.perf_counter()
        frame = paired.decode(self._pipeline.config.image)
        decode_s = time.perf_counter() - started_s
        observer = self.observer
        if observer is not None:
            observer.decoded(paired, frame)
        with self._wake:
            # The first layer of the first frame can be asked for before its second is done.
            self._stamp_ns = self._stamp_ns or paired.stamp_ns
        report = self._pipeline.process(frame)
        durations_s = {"decode": decode_s, **report.durations_s}
        with self._wake:
            self._counts.dense_keyframes += report.dense
            self._counts.instance_keyframes += report.instances
            self._durations_s.append(durations_s)
            self._stamp_ns = paired.stamp_ns
            self._revision += 1
        return durations_s
