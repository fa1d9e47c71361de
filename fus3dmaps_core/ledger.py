"""The counts of a run, live and offline alike: frames, keyframes, drops by reason, and the time of each stage."""

from __future__ import annotations

import threading
from collections import Counter, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

from fus3dmaps_core.errors import FrameError

_TIMED_KEYFRAMES = 100

DropObserver = Callable[[str, str, int], object]
"""Takes the reason of drops, the sentence that explains the latest of them, and their number."""


class Drops:
    """Counts of messages and frames that led to nothing, by reason. Thread-safe."""

    def __init__(self, *observers: DropObserver) -> None:
        """Start at zero.

        Args:
            observers: Called at once for all drops, in the thread that adds them.
        """
        self._lock = threading.Lock()
        self._counts: Counter[str] = Counter()
        self._latest: dict[str, str] = {}
        self._observers = observers

    def add(self, reason: str, sentence: str, number: int = 1) -> None:
        """Count drops.

        Args:
            reason: Machine-readable cause, snake_case.
            sentence: What happened to the latest of them; names the topic.
            number: How many.
        """
        with self._lock:
            self._counts[reason] += number
            self._latest[reason] = sentence
            observers = self._observers
        for observe in observers:
            observe(reason, sentence, number)

    def add_error(self, error: FrameError) -> None:
        """Count one drop, for the reason and with the sentence of an error."""
        self.add(error.reason, str(error))

    def counts(self) -> Counter[str]:
        """Return the number of drops by reason, in the order in which reasons first occurred."""
        with self._lock:
            return Counter(self._counts)

    def latest(self) -> dict[str, str]:
        """Return the sentence of the latest drop of each reason."""
        with self._lock:
            return dict(self._latest)

    def pour_into(self, other: Drops) -> None:
        """Move all counts to ``other``, one addition a reason, and start again at zero."""
        with self._lock:
            counts, latest = self._counts, self._latest
            self._counts, self._latest = Counter(), {}
        for reason, number in counts.items():
            other.add(reason, latest[reason], number)

    def tell(self, observer: DropObserver) -> None:
        """Call an observer for all drops from now on."""
        with self._lock:
            self._observers = (*self._observers, observer)

    def stop_telling(self, observer: DropObserver) -> None:
        """Call an observer no longer; do nothing if it is not called."""
        with self._lock:
            self._observers = tuple(each for each in self._observers if each != observer)


@dataclass
class FrameCounts:
    """Numbers of frames.

    Attributes:
        frames: Posed frames that came.
        not_keyframes: Frames with too little motion since the last keyframe.
        dense_keyframes: Frames integrated into the dense layer.
        instance_keyframes: Frames integrated into the instance layer.
        proposals: Proposals integrated.
    """

    frames: int = 0
    not_keyframes: int = 0
    dense_keyframes: int = 0
    instance_keyframes: int = 0
    proposals: int = 0


@dataclass(frozen=True)
class StageTime:
    """Time that a stage took in the latest keyframes.

    Attributes:
        mean_s: Mean, seconds.
        max_s: Longest, seconds.
    """

    mean_s: float
    max_s: float


class Ledger:
    """All counts of one run. Thread-safe.

    Attributes:
        drops: Messages and frames that led to nothing.
    """

    def __init__(self, drops: Drops | None = None) -> None:
        """Start at zero.

        Args:
            drops: Counts of drops that outlive this run; by default the run has its own.
        """
        self.drops = Drops() if drops is None else drops
        self._lock = threading.Lock()
        self._counts = FrameCounts()
        self._stages_s: dict[str, float] = {}
        self._latest_s: deque[Mapping[str, float]] = deque(maxlen=_TIMED_KEYFRAMES)

    def __repr__(self) -> str:
        """List the numbers of frames and of drops."""
        return f"Ledger({self.counts()}, drops={dict(self.drops.counts())})"

    def add_frame(self) -> None:
        """Count a posed frame, whatever happens to it next."""
        with self._lock:
            self._counts.frames += 1

    def add_not_keyframe(self) -> None:
        """Count a frame with too little motion."""
        with self._lock:
            self._counts.not_keyframes += 1

    def add_keyframe(self, dense: bool, instances: bool, proposals: int, durations_s: Mapping[str, float]) -> None:
        """Count a keyframe that is in the map.

        Args:
            dense: Whether it is in the dense layer.
            instances: Whether it is in the instance layer.
            proposals: Proposals integrated.
            durations_s: Time by stage, seconds.
        """
        with self._lock:
            self._counts.dense_keyframes += dense
            self._counts.instance_keyframes += instances
            self._counts.proposals += proposals
            self._latest_s.append(durations_s)
            for stage, duration_s in durations_s.items():
                self._stages_s[stage] = self._stages_s.get(stage, 0.0) + duration_s

    def counts(self) -> FrameCounts:
        """Return a copy of the numbers of frames."""
        with self._lock:
            return replace(self._counts)

    def stages_s(self) -> dict[str, float]:
        """Return the time that each stage took in all keyframes together, seconds."""
        with self._lock:
            return dict(self._stages_s)

    def stage_times(self) -> dict[str, StageTime]:
        """Return the time that each stage took in each of the latest 100 keyframes."""
        with self._lock:
            latest_s = list(self._latest_s)
        of_stage: dict[str, list[float]] = {}
        for durations_s in latest_s:
            for stage, duration_s in durations_s.items():
                of_stage.setdefault(stage, []).append(duration_s)
        return {stage: StageTime(sum(times) / len(times), max(times)) for stage, times in of_stage.items()}
