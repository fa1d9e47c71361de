"""State of the running mapping: rates, delays, drops, and sentences about what is wrong."""

from __future__ import annotations

import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from fus3dmaps_core.frame import Intrinsics
from fus3dmaps_core.health import input_problems, mapping_problems
from fus3dmaps_core.health.input_problems import Level, Offer, Part, Problem
from fus3dmaps_core.health.mapping_problems import MIB, Latency, MemoryState, Pace
from fus3dmaps_core.health.recent_numbers import RecentNumbers
from fus3dmaps_core.sources.streams import Stream

_STAMPS = 500  # Ten seconds of images at 50 Hz.
_POSES = 100


@dataclass(frozen=True)
class MapSizes:
    """Size of the map.

    Attributes:
        voxels: Number of voxels.
        instances: Number of instances.
        bytes_by_part: Allocated bytes of each part, by its name.
    """

    voxels: int
    instances: int
    bytes_by_part: Mapping[str, int]


@dataclass(frozen=True)
class PartReport:
    """The state of one part.

    Attributes:
        part: The part.
        level: The highest level of its problems.
        message: Its problems in words, or a line about its state.
        values: Figures in readable form, by name.
    """

    part: Part
    level: Level
    message: str
    values: dict[str, str]


@dataclass
class _Arrivals:
    recent: RecentNumbers
    last_s: float | None = None
    stamps_ns: deque[int] = field(default_factory=lambda: deque(maxlen=_STAMPS))
    ages_s: deque[float] = field(default_factory=lambda: deque(maxlen=20))


class Diagnosis:
    """Collects events while the node maps and reports the state on request. Thread-safe; an event costs microseconds.

    Rates, latencies and shares are those of the last ``recent_s`` seconds of a steady clock, because a paused or jumping
    ``/clock`` must not hide problems. Stamps alone are compared with the node's own clock.
    """

    def __init__(
        self,
        streams: Sequence[Stream],
        *,
        sync_tolerance_s: float,
        max_wait_s: float,
        use_sim_time: bool = False,
        silence_s: float = 5.0,
        recent_s: float = 10.0,
        clock_tolerance_s: float = 10.0,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Start without events.

        Args:
            streams: The inputs whose messages are reported by :meth:`arrived`.
            sync_tolerance_s: ``input.sync_tolerance_s``.
            max_wait_s: ``input.max_wait_s``.
            use_sim_time: Whether the node's clock is ``/clock``.
            silence_s: Time without a message after which a topic is reported, seconds.
            recent_s: Time over which rates, latencies and shares are computed, seconds.
            clock_tolerance_s: Greatest difference between stamps and the node's clock, seconds.
            clock: Clock that never goes back, seconds.
        """
        self._streams = {stream.topic: stream for stream in streams}
        self._sync_tolerance_s = sync_tolerance_s
        self._max_wait_s = max_wait_s
        self._use_sim_time = use_sim_time
        self._silence_s = silence_s
        self._recent_s = recent_s
        self._clock_tolerance_s = clock_tolerance_s
        self._clock = clock
        self._lock = threading.Lock()
        self._started_s = self._last_offered_s = self._waiting_since_s = self._clock()
        self._arrivals = {topic: _Arrivals(RecentNumbers(self._recent_s)) for topic in self._streams}
        self._offered = RecentNumbers(self._recent_s)
        self._mapped = RecentNumbers(self._recent_s)
        self._waiting = 0
        self._stages: dict[str, RecentNumbers] = {}
        self._drops: Counter[str] = Counter()
        self._last_drop: dict[str, str] = {}
        self._recent_drops: dict[str, RecentNumbers] = {}
        self._camera_problems: dict[str, Problem | None] = {}
        self._depth_problems: dict[str, Problem | None] = {}
        self._poses: deque[tuple[NDArray[np.float64], float]] = deque(maxlen=_POSES)
        self._pose_topic = ""

    def arrived(self, topic: str, stamp_ns: int, now_ns: int) -> None:
        """Note that a message came.

        Args:
            topic: Name of one of the streams.
            stamp_ns: Stamp of its header, nanoseconds.
            now_ns: The node's clock, nanoseconds.
        """
        now_s = self._clock()
        with self._lock:
            arrivals = self._arrivals[topic]
            arrivals.recent.add(now_s)
            arrivals.last_s = now_s
            arrivals.stamps_ns.append(stamp_ns)
            arrivals.ages_s.append((now_ns - stamp_ns) / 1e9)

    def offered(self, waiting: int) -> None:
        """Note that a complete frame was handed to mapping.

        Args:
            waiting: Frames that wait now.
        """
        now_s = self._clock()
        with self._lock:
            self._offered.add(now_s)
            self._last_offered_s = now_s
            if not self._waiting:
                self._waiting_since_s = now_s
            self._waiting = waiting

    def finished(self, durations_s: Mapping[str, float], waiting: int) -> None:
        """Note that the work on a frame has ended, whether it was mapped or not.

        Args:
            durations_s: Time of each stage, seconds; empty for a frame that failed or was no keyframe.
            waiting: Frames that wait now.
        """
        now_s = self._clock()
        with self._lock:
            self._waiting_since_s = now_s
            self._waiting = waiting
            for stage, duration_s in durations_s.items():
                self._stages.setdefault(stage, RecentNumbers(self._recent_s)).add(now_s, duration_s)
            if durations_s:
                self._mapped.add(now_s, sum(durations_s.values()))

    def dropped(self, reason: str, sentence: str, number: int = 1) -> None:
        """Note that messages or frames were dropped.

        Args:
            reason: Machine-readable cause, snake_case; ``queue_full`` means that mapping is too slow.
            sentence: Explanation of the latest of them.
            number: Number of drops.
        """
        now_s = self._clock()
        with self._lock:
            self._drops[reason] += number
            self._last_drop[reason] = sentence
            self._recent_drops.setdefault(reason, RecentNumbers(self._recent_s)).add(now_s, number)

    def camera(self, topic: str, intrinsics: Intrinsics) -> None:
        """Note that a camera model came or changed."""
        problem = input_problems.unlikely_intrinsics(topic, intrinsics)
        with self._lock:
            self._camera_problems[topic] = problem

    def frame(
        self,
        T_world_camera: NDArray[np.float64],
        depth_m: NDArray[np.float32],
        *,
        depth_topic: str,
        encoding: str,
        pose_topic: str,
    ) -> None:
        """Note that a keyframe was decoded.

        Args:
            T_world_camera: (4, 4) float64, its pose.
            depth_m: (H, W) float32 metres, not valid if 0 or not finite.
            depth_topic: Topic of depth.
            encoding: Encoding of the depth message.
            pose_topic: Topic of the pose.
        """
        median_m, spread = input_problems.depth_statistics(depth_m)
        problem = input_problems.unlikely_depth(depth_topic, encoding, median_m)
        with self._lock:
            self._depth_problems[depth_topic] = problem
            self._poses.append((T_world_camera, spread))
            self._pose_topic = pose_topic

    def rates_hz(self) -> dict[str, float]:
        """Compute the messages per second of each topic."""
        with self._lock:
            now_s = self._clock()
            return {topic: self._rate_hz(arrivals.recent, now_s) for topic, arrivals in self._arrivals.items()}

    def latencies(self) -> dict[str, Latency]:
        """Compute the times of each stage."""
        with self._lock:
            return self._latencies(self._clock())

    def drops(self) -> Counter[str]:
        """Count the drops since the start, by reason."""
        with self._lock:
            return Counter(self._drops)

    def problems(
        self, offers: Mapping[str, Sequence[Offer]] | None = None, memory: Sequence[MemoryState] = ()
    ) -> list[Problem]:
        """List what is wrong now, inputs first.

        Args:
            offers: Publishers of each topic; None if they are not known.
            memory: Use of each memory.
        """
        with self._lock:
            now_s = self._clock()
            found = self._input_problems(offers, now_s) + self._drop_problems(now_s)
            slow = mapping_problems.too_slow(self._pace(now_s), self._latencies(now_s))
        return found + ([slow] if slow else []) + mapping_problems.near_budget(memory)

    def report(
        self, sizes: MapSizes, memory: Sequence[MemoryState] = (), offers: Mapping[str, Sequence[Offer]] | None = None
    ) -> list[PartReport]:
        """Report the state of inputs, mapping, map and memory, in that order.

        Args:
            sizes: Size of the map.
            memory: Use of each memory.
            offers: Publishers of each topic; None if they are not known.
        """
        found = self.problems(offers, memory)
        rates_hz, latencies, drops = self.rates_hz(), self.latencies(), self.drops()
        with self._lock:
            now_s = self._clock()
            idle_s = now_s - self._last_offered_s
            pace = self._pace(now_s)
        inputs = {f"{topic} (Hz)": f"{rate_hz:.1f}" for topic, rate_hz in rates_hz.items()}
        inputs |= {f"dropped {reason}": str(count) for reason, count in sorted(drops.items())}
        mapping = {
            "frames (Hz)": f"{pace.offered_hz:.1f}",
            "keyframes (Hz)": f"{pace.mapped_hz:.1f}",
            "waiting": str(pace.waiting),
            "busy (%)": f"{100.0 * pace.busy:.0f}",
        }
        for stage, latency in latencies.items():
            mapping[f"{stage} mean, max (ms)"] = f"{1e3 * latency.mean_s:.1f}, {1e3 * latency.max_s:.1f}"
        total = sum(sizes.bytes_by_part.values())
        bytes_by_part = {f"{part} (MiB)": f"{count / MIB:.1f}" for part, count in sizes.bytes_by_part.items()}
        reports = [
            _part("inputs", found, "all inputs arrive", inputs),
            _part("mapping", found, f"{pace.mapped_hz:.1f} keyframes/s, {pace.waiting} waiting", mapping),
            _part(
                "map",
                found,
                f"{sizes.voxels} voxels, {sizes.instances} instances, {total / MIB:.1f} MiB",
                {"voxels": str(sizes.voxels), "instances": str(sizes.instances)} | bytes_by_part,
            ),
            _part("memory", found, "within budget", {state.name: _fill(state) for state in memory}),
        ]
        if idle_s > self._silence_s and reports[1].level == Level.OK:
            reports[1] = PartReport("mapping", Level.STALE, f"no complete frame for {idle_s:.0f} s", mapping)
        return reports

    def _seen_s(self, now_s: float) -> float:
        """Return the time over which recent numbers came, seconds: less than ``recent_s`` after the start, never zero."""
        return max(min(self._recent_s, now_s - self._started_s), 1e-9)

    def _rate_hz(self, recent: RecentNumbers, now_s: float) -> float:
        return len(recent.numbers(now_s)) / self._seen_s(now_s)

    def _latencies(self, now_s: float) -> dict[str, Latency]:
        durations_s = {stage: recent.numbers(now_s) for stage, recent in self._stages.items()}
        return {stage: Latency(len(s), sum(s) / len(s), max(s)) for stage, s in durations_s.items() if s}

    def _recent_drop(self, reason: str, now_s: float) -> int:
        recent = self._recent_drops.get(reason)
        return round(sum(recent.numbers(now_s))) if recent else 0

    def _pace(self, now_s: float) -> Pace:
        offered, unmapped = len(self._offered.numbers(now_s)), self._recent_drop("queue_full", now_s)
        return Pace(
            offered_hz=self._rate_hz(self._offered, now_s),
            mapped_hz=self._rate_hz(self._mapped, now_s),
            unmapped=min(unmapped / max(offered, 1), 1.0),
            busy=min(sum(self._mapped.numbers(now_s)) / self._seen_s(now_s), 1.0),
            waiting=self._waiting,
            waiting_s=now_s - self._waiting_since_s,
        )

    def _input_problems(self, offers: Mapping[str, Sequence[Offer]] | None, now_s: float) -> list[Problem]:
        found: list[Problem | None] = []
        live: dict[str, _Arrivals] = {}
        for topic, stream in self._streams.items():
            arrivals = self._arrivals[topic]
            silent_s = now_s - (self._started_s if arrivals.last_s is None else arrivals.last_s)
            offered = None if offers is None else offers.get(topic, ())
            if silent_s >= self._silence_s and not (stream.once and arrivals.last_s is not None):
                found.append(input_problems.silence(stream, silent_s, offered))
                continue
            if offered and arrivals.last_s is not None:
                found.append(input_problems.partly_unheard(stream, offered))
            if arrivals.last_s is not None and not stream.once:
                live[topic] = arrivals
        found += self._stamp_problems(live)
        ages_s = {topic: float(np.median(arrivals.ages_s)) for topic, arrivals in live.items()}
        found.append(input_problems.clock_mismatch(ages_s, self._clock_tolerance_s, self._use_sim_time))
        found += [*self._camera_problems.values(), *self._depth_problems.values()]
        if self._poses:
            poses_4x4, spread = zip(*self._poses, strict=True)
            found.append(input_problems.not_optical(np.stack(poses_4x4), np.array(spread), self._pose_topic))
        return [problem for problem in found if problem is not None]

    def _stamp_problems(self, live: Mapping[str, _Arrivals]) -> list[Problem | None]:
        """Compare the stamps of streams that belong together; the n-th colour and n-th depth stream share a camera."""
        roles = {role: [s for s in self._streams.values() if s.role == role] for role in ("rgb", "depth", "pose")}
        pairs = [*zip(roles["rgb"], roles["depth"], strict=False)]
        pairs += [(rgb, pose) for rgb in roles["rgb"] for pose in roles["pose"]]
        found: list[Problem | None] = []
        for rgb, other in pairs:
            if rgb.topic not in live or other.topic not in live:
                continue
            rgb_ns, other_ns = live[rgb.topic].stamps_ns, live[other.topic].stamps_ns
            if other.role == "depth":
                found.append(input_problems.stamp_difference(rgb, other, rgb_ns, other_ns, self._sync_tolerance_s))
            found.append(input_problems.lag(rgb, other, rgb_ns[-1], other_ns[-1], self._max_wait_s))
        return found

    def _drop_problems(self, now_s: float) -> list[Problem]:
        span = f"{self._seen_s(now_s):.0f} s"
        return [
            Problem("inputs", Level.WARN, "dropped", f"dropped {count} in {span} ({reason}): {self._last_drop[reason]}")
            for reason in sorted(self._recent_drops)
            if reason != "queue_full" and (count := self._recent_drop(reason, now_s))
        ]


def _fill(state: MemoryState) -> str:
    used = f"{state.used_bytes / MIB:.1f} MiB"
    return f"{used} of {state.budget_bytes / MIB:.1f} MiB" if state.budget_bytes else used


def _part(part: Part, found: Sequence[Problem], fine: str, values: dict[str, str]) -> PartReport:
    own = [problem for problem in found if problem.part == part]
    level = max((problem.level for problem in own), default=Level.OK)
    worst_first = sorted(own, key=lambda problem: -problem.level)
    return PartReport(part, level, "; ".join(problem.sentence for problem in worst_first) or fine, values)
