"""Rules that find problems of the map's inputs. Each describes symptom, likely cause and remedy in a sentence.

The rules are pure functions: they take numbers and return a :class:`Problem` or None. The numbers are kept by
:mod:`fus3dmaps_core.health.diagnosis`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from fus3dmaps_core.frame import Intrinsics
from fus3dmaps_core.sources.streams import Qos, Stream

Part = Literal["inputs", "mapping", "map", "memory"]

_MIN_PAIRS = 5
_FOCAL_RANGE = (0.2, 5.0)  # Shares of the width, for fields of view of 136 and 11 degrees.
_CENTER_RANGE = (0.25, 0.75)
_MIN_MEDIAN_16BIT_M = 0.05
_MAX_MEDIAN_32BIT_M = 100.0

_UP = 0.9
_MIN_POSES = 20
_MIN_SHARE_UP = 0.9
_MIN_TURN_RAD = math.radians(45.0)
_MIN_DEPTH_SPREAD = 0.15


class Level(IntEnum):
    """Severity, with the values of ``diagnostic_msgs/DiagnosticStatus``."""

    OK = 0
    WARN = 1
    ERROR = 2
    STALE = 3


@dataclass(frozen=True)
class Problem:
    """Something that is wrong.

    Attributes:
        part: The part of the system that it concerns.
        level: WARN if mapping goes on but worse than it could, ERROR if it cannot go on.
        kind: Machine-readable name, snake_case.
        sentence: Symptom, likely cause and remedy; names topics and parameters.
    """

    part: Part
    level: Level
    kind: str
    sentence: str


@dataclass(frozen=True)
class Offer:
    """A publisher of a topic.

    Attributes:
        node: Name of its node with namespace.
        reliability: ``RELIABLE`` or ``BEST_EFFORT``; any other value counts as a match.
        durability: ``TRANSIENT_LOCAL`` or ``VOLATILE``; any other value counts as a match.
    """

    node: str
    reliability: str
    durability: str


def unheard(asked: Qos, offer: Offer) -> str:
    """Say why a subscription does not hear a publisher, by the rules of DDS; empty if it does."""
    reasons = []
    if asked.reliability == "RELIABLE" and offer.reliability == "BEST_EFFORT":
        reasons.append("offers BEST_EFFORT, we ask RELIABLE")
    if asked.durability == "TRANSIENT_LOCAL" and offer.durability == "VOLATILE":
        reasons.append("offers VOLATILE, we ask TRANSIENT_LOCAL")
    return " and ".join(reasons)


def silence(stream: Stream, silent_s: float, offers: Sequence[Offer] | None) -> Problem:
    """Report that no messages come on a topic.

    Args:
        stream: The topic.
        silent_s: Time without a message, seconds.
        offers: Its publishers; None if they are not known.
    """
    symptom = f"no message on {stream.topic} for {silent_s:.0f} s"
    if offers is None:
        return Problem("inputs", Level.ERROR, "silence", symptom)
    if not offers:
        sentence = f"{symptom}: it has no publisher. Does the driver run, and is '{stream.parameter}' the right name?"
        return Problem("inputs", Level.ERROR, "no_publisher", sentence)
    reasons = [unheard(stream.qos, offer) for offer in offers]
    if all(reasons):
        who = "its publisher" if len(offers) == 1 else f"the first of its {len(offers)} publishers"
        sentence = f"{symptom}; {who} {reasons[0]}: set parameter '{stream.qos_parameter}' to best_available or sensor_data"
        return Problem("inputs", Level.ERROR, "qos_mismatch", sentence)
    number = "1 publisher" if len(offers) == 1 else f"{len(offers)} publishers"
    sentence = (
        f"{symptom}, though it has {number} ({', '.join(offer.node for offer in offers)}) whose QoS matches."
        " Does the sensor run, and does the network carry messages of this size?"
    )
    return Problem("inputs", Level.ERROR, "silence", sentence)


def partly_unheard(stream: Stream, offers: Sequence[Offer]) -> Problem | None:
    """Report publishers of a topic whose messages do not arrive, although those of others do."""
    deaf = [(offer, reason) for offer in offers if (reason := unheard(stream.qos, offer))]
    if not deaf:
        return None
    offer, reason = deaf[0]
    sentence = (
        f"{len(deaf)} of {len(offers)} publishers of {stream.topic} are not heard; {offer.node} {reason}:"
        f" set parameter '{stream.qos_parameter}' to best_available or sensor_data"
    )
    return Problem("inputs", Level.WARN, "qos_mismatch", sentence)


def stamp_difference(
    rgb: Stream, depth: Stream, rgb_ns: Sequence[int], depth_ns: Sequence[int], tolerance_s: float
) -> Problem | None:
    """Report that the median difference between colour and depth stamps is greater than the tolerance.

    Streams with a constant offset of whole frame periods look synchronous to any rule on stamps. An offset of seconds is
    found by :func:`lag`.

    Args:
        rgb: The colour stream.
        depth: The depth stream.
        rgb_ns: Latest stamps of colour, nanoseconds.
        depth_ns: Latest stamps of depth, nanoseconds.
        tolerance_s: ``input.sync_tolerance_s``.
    """
    apart_s = _apart_s(np.sort(np.array(rgb_ns)), np.sort(np.array(depth_ns)))
    if apart_s.size < _MIN_PAIRS:
        return None
    median_s = float(np.median(apart_s))
    if median_s <= tolerance_s:
        return None
    symptom = f"stamps of {depth.topic} and {rgb.topic} differ by {_duration(median_s)}"
    enough_s = math.ceil(float(np.quantile(apart_s, 0.95)) * 100.0) / 100.0
    sentence = (
        f"{symptom}, more than 'input.sync_tolerance_s' ({tolerance_s:g} s) allows: synchronise them in the driver, or set"
        f" it to {enough_s:g} s where the camera moves slowly"
    )
    return Problem("inputs", Level.ERROR, "stamp_difference", sentence)


def lag(rgb: Stream, other: Stream, rgb_ns: int, other_ns: int, max_wait_s: float) -> Problem | None:
    """Report that the newest colour image and the newest pose or depth image have stamps far apart.

    Args:
        rgb: The colour stream.
        other: The stream of poses or depth.
        rgb_ns: Newest stamp of colour, nanoseconds.
        other_ns: Newest stamp of the other, nanoseconds.
        max_wait_s: ``input.max_wait_s``. Images that wait longer are dropped; half of it gives a warning.
    """
    lag_s = (rgb_ns - other_ns) / 1e9
    if abs(lag_s) <= max_wait_s / 2.0:
        return None
    level = Level.ERROR if abs(lag_s) > max_wait_s else Level.WARN
    what, late = ("poses", "the localisation") if other.role == "pose" else ("depth images", "its driver")
    if lag_s < 0.0:
        sentence = (
            f"images on {rgb.topic} end {_duration(-lag_s)} before {what} on {other.topic}:"
            " the camera's stamps lag, or the two come from two clocks"
        )
        return Problem("inputs", level, "image_lag", sentence)
    sentence = (
        f"{what} on {other.topic} end {_duration(lag_s)} before images on {rgb.topic}: {late} lags"
        f" (raise 'input.max_wait_s', now {max_wait_s:g} s), or the two come from two clocks"
    )
    return Problem("inputs", level, f"{other.role}_lag", sentence)


def clock_mismatch(ages_s: Mapping[str, float], tolerance_s: float, use_sim_time: bool) -> Problem | None:
    """Report stamps that are far from the node's clock, which other nodes and RViz use.

    Args:
        ages_s: How far the stamps of each topic lie behind the node's clock, seconds; negative for the future.
        tolerance_s: Greatest difference that counts as a delay.
        use_sim_time: Whether the node's clock is ``/clock``.
    """
    far = {topic: age_s for topic, age_s in ages_s.items() if abs(age_s) > tolerance_s}
    if not far:
        return None
    what = ", ".join(
        f"{topic} {_duration(abs(age_s))} {'behind' if age_s > 0.0 else 'ahead of'}" for topic, age_s in far.items()
    )
    hint = (
        "the parameter use_sim_time is set: does /clock come, and from where the images come from?"
        if use_sim_time
        else "set use_sim_time for a recording or a simulation; otherwise synchronise the machines' clocks (NTP, PTP)"
    )
    return Problem("inputs", Level.WARN, "clock_mismatch", f"stamps are far from the node's clock: {what} it; {hint}")


def unlikely_intrinsics(topic: str, intrinsics: Intrinsics) -> Problem | None:
    """Report a camera model that does not fit its image: of another resolution or camera, or not calibrated.

    Args:
        topic: Where the model comes from.
        intrinsics: The model.
    """
    width, height = intrinsics.width, intrinsics.height
    symptoms = [
        f"{name} is {focal_px:.0f} px, {focal_px / width:.2g} of the width"
        for name, focal_px in (("fx", intrinsics.fx), ("fy", intrinsics.fy))
        if not _FOCAL_RANGE[0] <= focal_px / width <= _FOCAL_RANGE[1]
    ]
    symptoms += [
        f"{name} is {center_px:.0f} px, outside the middle half of {size} px"
        for name, center_px, size in (("cx", intrinsics.cx, width), ("cy", intrinsics.cy, height))
        if not _CENTER_RANGE[0] <= center_px / size <= _CENTER_RANGE[1]
    ]
    if not symptoms:
        return None
    sentence = (
        f"{topic} does not look like the camera model of a {width}x{height} image ({'; '.join(symptoms)}):"
        " is it of another resolution or another camera?"
    )
    return Problem("inputs", Level.WARN, "unlikely_intrinsics", sentence)


def unlikely_depth(topic: str, encoding: str, median_m: float) -> Problem | None:
    """Report depth that seems to have another unit than its encoding says (REP-118).

    Args:
        topic: Where depth comes from.
        encoding: ``16UC1``, ``mono16`` or ``32FC1``.
        median_m: Median of the valid readings as they were decoded, metres.
    """
    if encoding in ("16UC1", "mono16") and median_m < _MIN_MEDIAN_16BIT_M:
        sentence = (
            f"{topic} looks like metres or centimetres, not millimetres: half of its {encoding} readings are below"
            f" {median_m * 1000.0:.3g} mm. Set 'image.depth_unit_m' to the metres of one unit"
        )
        return Problem("inputs", Level.WARN, "unlikely_depth", sentence)
    if encoding == "32FC1" and median_m > _MAX_MEDIAN_32BIT_M:
        sentence = (
            f"{topic} looks like millimetres, not metres: half of its 32FC1 readings are beyond {median_m:.0f} m."
            " Have the driver publish metres, or millimetres as 16UC1"
        )
        return Problem("inputs", Level.WARN, "unlikely_depth", sentence)
    return None


def not_optical(T_world_camera: NDArray[np.float64], depth_spread: NDArray[np.float64], pose_topic: str) -> Problem | None:
    """Report poses that look like those of a body frame (x forward, z up) instead of an optical frame (z forward).

    A driving body turns while its z axis stays upright. An optical frame with an upright z axis would look at the ceiling,
    and would see nearly the same depth everywhere. So poses are reported if nearly all of the latest z axes point along the
    world's z, the poses turn about it, and depth is not flat.

    Limits: the world's z must point up (REP-103, 105). If the world is the first camera's optical frame, nothing is reported
    unless that camera rolls by 45 degrees while looking ahead. A robot that never turns, a body frame with z down and one
    tilted by more than 25 degrees are missed. A camera that really looks up at open beams is reported without cause.

    Args:
        T_world_camera: (n, 4, 4) float64, latest poses, with motion between them.
        depth_spread: (n,) float64, spread of the depth image of each, (p90 - p10) / median; nan if it has none.
        pose_topic: Where the poses come from.
    """
    if len(T_world_camera) < _MIN_POSES:
        return None
    upright = T_world_camera[:, 2, 2] > _UP
    if upright.mean() < _MIN_SHARE_UP:
        return None
    turned_rad = _widest_turn_rad(T_world_camera[upright, 0, 0], T_world_camera[upright, 1, 0])
    spread = depth_spread[upright]
    spread = spread[np.isfinite(spread)]
    if turned_rad < _MIN_TURN_RAD or spread.size == 0 or float(np.median(spread)) < _MIN_DEPTH_SPREAD:
        return None
    sentence = (
        f"camera looks along x, not z: is this an optical frame? The z axes of the poses on {pose_topic} point up, as a body"
        " frame's do. Publish poses of the optical frame, or set 'input.T_body_camera' or 'input.extrinsic_source'"
    )
    return Problem("inputs", Level.WARN, "not_optical", sentence)


def depth_statistics(depth_m: NDArray[np.float32]) -> tuple[float, float]:
    """Compute median (metres) and spread, (p90 - p10) / median, of a depth image's valid readings; nan if it has none.

    Args:
        depth_m: (H, W) float32 metres; 0 and non-finite values are not valid. Only every eighth row and column is used.
    """
    readings = depth_m[::8, ::8]
    readings = readings[np.isfinite(readings) & (readings > 0.0)]
    if readings.size == 0:
        return math.nan, math.nan
    low, median, high = (float(value) for value in np.quantile(readings, (0.1, 0.5, 0.9)))
    return median, (high - low) / median


def _apart_s(first_ns: NDArray[np.int64], second_ns: NDArray[np.int64]) -> NDArray[np.float64]:
    """Compute how far each stamp of the slower stream is from the nearest of the faster one, seconds; both are sorted."""
    if min(first_ns.size, second_ns.size) < 2:
        return np.empty(0)
    # A driver may give colour at 30 Hz and depth at 5 Hz. Most colour images have no depth then; the stamps are fine.
    slow_ns, fast_ns = sorted((first_ns, second_ns), key=lambda stamps: -float(stamps[-1] - stamps[0]) / (stamps.size - 1))
    # Only where both streams have stamps: outside, partners are missing, still to come, or on another clock.
    compared_ns = slow_ns[(slow_ns >= fast_ns[0]) & (slow_ns <= fast_ns[-1])]
    return np.asarray(np.abs(np.subtract.outer(compared_ns, fast_ns)).min(axis=1) / 1e9, dtype=np.float64)


def _widest_turn_rad(x: NDArray[np.float64], y: NDArray[np.float64]) -> float:
    """Compute the smallest arc that holds all headings, radians, from their components."""
    headings = np.sort(np.arctan2(y, x))
    gaps = np.diff(headings, append=headings[0] + 2.0 * math.pi)
    return 2.0 * math.pi - float(gaps.max())


def _duration(seconds: float) -> str:
    return f"{seconds * 1000.0:.0f} ms" if seconds < 1.0 else f"{seconds:.1f} s"
