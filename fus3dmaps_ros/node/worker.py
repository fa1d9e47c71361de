"""The mapping thread and its bounded queue, so that no callback ever waits for a network."""

from __future__ import annotations

import threading
import traceback
from collections import deque
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from fus3dmaps_core.frame import PosedFrame
from fus3dmaps_core.frame_step import FrameStep
from fus3dmaps_core.ledger import Ledger
from fus3dmaps_core.pipeline import Pipeline
from fus3dmaps_core.sources.pairing import PairedMessages
from fus3dmaps_core.voxel_map.semantic_map import SemanticMap

T = TypeVar("T")


class FrameObserver(Protocol):
    """Someone who follows frames on their way to the map; each method must return at once."""

    def offered(self, waiting: int) -> None:
        """Note that a frame was queued; ``waiting`` frames wait now."""

    def decoded(self, paired: PairedMessages, frame: PosedFrame) -> None:
        """Note that a keyframe was decoded and is about to be mapped."""

    def finished(self, durations_s: Mapping[str, float], waiting: int) -> None:
        """Note that a frame is done: seconds by stage (none if it was no keyframe or failed), and how many frames wait."""


class FrameWorker:
    """Maps paired messages in order of arrival; when the queue is full the oldest one is dropped.

    A frame that fails is counted under its reason (``processing_failed`` for anything but a FrameError), and the thread
    continues with the next one.

    Attributes:
        observer: Follows every frame; None for nobody. May be changed at any time.
        ledger: Counts what was offered, mapped and dropped.
    """

    def __init__(self, pipeline: Pipeline, queue_size: int, ledger: Ledger) -> None:
        """Start with an empty queue; :meth:`start` runs the thread.

        Args:
            pipeline: Maps the frames.
            queue_size: Frames that can wait.
            ledger: Counts them.
        """
        self._pipeline = pipeline
        self._queue_size = queue_size
        self.ledger = ledger
        self._step = FrameStep(pipeline, ledger, self._begin)
        self.observer: FrameObserver | None = None
        self._frames: deque[PairedMessages] = deque()
        self._calls: deque[tuple[Future[Any], Callable[[], Any], bool]] = deque()
        self._wake = threading.Condition()
        self._closing = False
        self._stamp_ns = 0
        self._revision = 0
        # Daemon: an inference that cannot be interrupted must not keep the process from ending.
        self._thread = threading.Thread(target=self._run, name="mapping", daemon=True)

    @property
    def stamp_ns(self) -> int:
        """Stamp of the latest frame in the map, nanoseconds; that of the first frame from its start on, and 0 before."""
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

    def start(self) -> None:
        """Run the thread."""
        self._thread.start()

    def offer(self, paired: PairedMessages) -> None:
        """Queue a frame, without blocking; do nothing once the worker is stopping."""
        with self._wake:
            if self._closing:
                return
            self.ledger.add_frame()
            dropped = self._frames.popleft() if len(self._frames) >= self._queue_size else None
            self._frames.append(paired)
            waiting = len(self._frames)
            self._wake.notify()
        observer = self.observer
        if observer is not None:
            observer.offered(waiting)
        if dropped is not None:
            self.ledger.drops.add(
                "queue_full", f"mapping is slower than the keyframes come; the image at {dropped.stamp_ns} ns went unmapped"
            )

    def between_frames(self, function: Callable[[], T], changes: bool = True) -> Future[T]:
        """Call a function in the mapping thread before the next frame, when nothing else touches the pipeline.

        Args:
            function: What to call.
            changes: Whether it may change the map.

        Returns:
            A future with the function's result or exception; cancelled if the worker stops first.
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
        """Drop the frames that wait, without counting them."""
        with self._wake:
            self._frames.clear()

    def reset(self) -> Future[None]:
        """Drop the frames that wait, and empty the pipeline before the next one."""

        def empty() -> None:
            self._pipeline.reset()
            with self._wake:
                self._stamp_ns = 0

        self.drop_waiting()
        return self.between_frames(empty)

    def restore(self, semantic_map: SemanticMap, stamp_ns: int, camera_poses: NDArray[np.float64]) -> Future[None]:
        """Replace the map before the next frame, see :meth:`Pipeline.restore`; frames that wait stay."""

        def swap() -> None:
            self._pipeline.restore(semantic_map, stamp_ns, camera_poses)
            with self._wake:
                self._stamp_ns = stamp_ns

        return self.between_frames(swap)

    def stop(self, timeout_s: float) -> bool:
        """End the thread after the frame that is being mapped; drop those that wait.

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
        report = None
        try:
            report = self._step.run(paired)
        except Exception:
            # An exception of a network or a driver must not end a day of mapping. One layer may already have the frame.
            self._revise(True)
            self.ledger.drops.add(
                "processing_failed", f"the image at {paired.stamp_ns} ns could not be mapped\n{traceback.format_exc()}"
            )
        if report is not None:
            with self._wake:
                self._stamp_ns = paired.stamp_ns
                self._revision += 1
        observer = self.observer
        if observer is not None:
            observer.finished({} if report is None else report.durations_s, self.waiting)

    def _begin(self, paired: PairedMessages, frame: PosedFrame) -> None:
        observer = self.observer
        if observer is not None:
            observer.decoded(paired, frame)
        with self._wake:
            # The first layer of the first frame can be queried before the second layer has it.
            self._stamp_ns = self._stamp_ns or paired.stamp_ns
