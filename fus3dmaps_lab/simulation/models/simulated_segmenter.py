"""A simulated class-agnostic segmenter: masks made from the ground truth, with stated rates of error.

Random numbers are seeded by the statistics' seed and the frame's stamp: the same frame gives the same masks bit for bit.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import cv2
import numpy as np
from numpy.typing import NDArray

from fus3dmaps_core.errors import ConfigError
from fus3dmaps_core.masks import Masks
from fus3dmaps_lab.simulation.models.encoder_statistics import REFERENCE_WIDTH_PX
from fus3dmaps_lab.simulation.models.oracle import Oracle
from fus3dmaps_lab.simulation.truth import NOTHING, Truth

_KIND_SEGMENT = 31
_CROSS = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))


@dataclass(frozen=True)
class SegmenterStatistics:
    """The errors of the simulated segmenter.

    In every frame, each visible instance (also a background surface) is treated in one of four ways: it is missed, or else
    split into its parts, or else merged with a neighbour, or else masked whole. Each probability holds if none of the
    earlier cases happened. Lengths and areas in pixels are those of an image 640 wide and scale with the actual image.

    Attributes:
        miss_probability: Probability that a large instance is missed.
        small_miss_probability: The same for an instance whose area goes to 0. In between, the difference to
            ``miss_probability`` halves with every ``small_area_px`` of area.
        small_area_px: See above, square pixels.
        split_probability: Probability that an instance of at least two visible parts is split at a mean depth up to
            ``split_near_m``. It falls linearly to 0 at ``split_far_m``.
        split_near_m: Metres.
        split_far_m: Metres.
        merge_probability: Probability that an instance is merged with its neighbour: the instance with the longest common
            border whose pixels touch its own with a depth step below ``touch_m``. Neither of the two is background. If both
            choose each other, the frame has one mask of the two.
        touch_m: Metres.
        keep_whole_probability: Probability that a split or merged instance has its whole mask as well; masks then overlap.
        cut_probability: Probability that a mask of several unconnected pieces, caused by occlusion, becomes one mask each.
        jitter_px: A mask is eroded or dilated by a whole number of pixels, drawn evenly between plus and minus the scaled
            and rounded value of this.
        min_area_px: Least area of a mask, square pixels.
        seed: Seed of all random numbers.
    """

    miss_probability: float = 0.05
    small_miss_probability: float = 0.5
    small_area_px: float = 1000.0
    split_probability: float = 0.5
    split_near_m: float = 1.0
    split_far_m: float = 3.0
    merge_probability: float = 0.1
    touch_m: float = 0.1
    keep_whole_probability: float = 0.3
    cut_probability: float = 0.8
    jitter_px: float = 2.0
    min_area_px: float = 100.0
    seed: int = 0

    def __post_init__(self) -> None:
        """Raise ConfigError, which names the field, if a number is out of range."""
        for field in fields(self):
            value = getattr(self, field.name)
            most = 1.0 if field.name.endswith("probability") else float("inf")
            if not 0 <= value <= most or value == float("inf"):
                raise ConfigError(f"segmenter statistics: {field.name} must be finite and lie in [0, {most:g}], got {value}")
        if self.split_near_m >= self.split_far_m:
            raise ConfigError(
                "segmenter statistics: split_near_m must be less than split_far_m, "
                f"got {self.split_near_m} and {self.split_far_m}"
            )
        if self.small_area_px == 0:
            raise ConfigError("segmenter statistics: small_area_px must be positive, got 0")

    def miss_at(self, area_px: NDArray[np.floating]) -> NDArray[np.float64]:
        """Compute the probability of a miss from visible areas, in pixels of an image 640 wide."""
        excess = self.small_miss_probability - self.miss_probability
        return np.asarray(self.miss_probability + excess * 0.5 ** (area_px / self.small_area_px), np.float64)

    def split_at(self, distance_m: NDArray[np.floating]) -> NDArray[np.float64]:
        """Compute the probability of a split from distances in metres, for instances with several visible parts."""
        share = (self.split_far_m - distance_m) / (self.split_far_m - self.split_near_m)
        return np.asarray(self.split_probability * np.clip(share, 0.0, 1.0), np.float64)


class SimulatedSegmenter:
    """Simulated segmenter: it sees the truth through the oracle and returns masks with the stated errors."""

    def __init__(self, oracle: Oracle, truth: Truth, statistics: SegmenterStatistics) -> None:
        """Store the truth; the oracle must look at a frame before it is segmented."""
        self._oracle, self._truth, self._statistics = oracle, truth, statistics
        self._background = np.isin(truth.class_of_instance, sorted(truth.background))

    def segment(self, rgb: NDArray[np.uint8], depth_m: NDArray[np.float32]) -> Masks:
        """Make the masks of the frame that the oracle looks at, by instance; the measured depth is ignored.

        Args:
            rgb: (H, W, 3) uint8.
            depth_m: (H, W) float32 metres.

        Raises:
            EncoderError: The oracle looks at another frame or at none.
        """
        stated = self._statistics
        scale = rgb.shape[1] / REFERENCE_WIDTH_PX
        min_area = max(1, round(stated.min_area_px * scale**2))
        view = _View(self._oracle.parts_of(rgb), self._oracle.depth_of(rgb), self._truth, stated.touch_m)
        stamp = self._oracle.current.frame.stamp_ns % 2**64
        rng = np.random.default_rng((stated.seed, _KIND_SEGMENT, stamp))
        chance = rng.random((4, len(view.instances)))
        missed = chance[0] < stated.miss_at(view.areas / scale**2)
        split = chance[1] < stated.split_at(view.distances_m)
        merged = chance[2] < stated.merge_probability
        kept = chance[3] < stated.keep_whole_probability
        neighbours = view.neighbours(self._background[view.instances])
        groups: set[frozenset[int]] = set()
        found = _Found(rgb.shape[:2], min_area, stated.cut_probability, round(stated.jitter_px * scale), rng)
        for row, instance in enumerate(view.instances):
            if instance == NOTHING or missed[row]:
                continue
            window, own = view.mask([row])
            whole = False
            parts = view.parts_in(window, own, min_area) if split[row] else []
            if len(parts) > 1:
                for part in parts:
                    found.add(window, part)
            elif merged[row] and neighbours[row] >= 0:
                group = frozenset((row, int(neighbours[row])))
                if group not in groups:  # The other instance may have added it already.
                    found.add(*view.mask(sorted(group)))
                groups.add(group)
            else:
                whole = True
            if whole or kept[row]:
                found.add(window, own)
        return found.masks()


class _View:
    """The ground truth of an image, by instance.

    Attributes:
        instances: (n,) int64 instances in view, ascending, including 0 (nothing).
        areas: (n,) int64 pixels.
        distances_m: (n,) mean true depth.
    """

    def __init__(self, parts: NDArray[np.int32], depth_m: NDArray[np.float32], truth: Truth, touch_m: float) -> None:
        self._parts, self._depth_m, self._touch_m = parts, depth_m, touch_m
        instances = truth.instance_of_part[parts]
        pixels = np.bincount(instances.reshape(-1))
        self.instances = np.flatnonzero(pixels)
        self.areas = pixels[self.instances]
        self._rows = (np.cumsum(pixels > 0) - 1)[instances]
        depth_sums = np.bincount(self._rows.reshape(-1), depth_m.reshape(-1))
        self.distances_m = depth_sums / self.areas
        n = len(self.instances)
        lines = np.bincount((np.arange(parts.shape[0])[:, None] * n + self._rows).reshape(-1), minlength=parts.shape[0] * n)
        columns = np.bincount((np.arange(parts.shape[1]) * n + self._rows).reshape(-1), minlength=parts.shape[1] * n)
        self._spans_y = [_span(line) for line in lines.reshape(-1, n).T > 0]
        self._spans_x = [_span(column) for column in columns.reshape(-1, n).T > 0]

    def mask(self, rows: list[int]) -> tuple[tuple[slice, slice], NDArray[np.bool_]]:
        """Return the window of the image that holds some instances, and their mask in it."""
        y, x = (
            slice(min(spans[row].start for row in rows), max(spans[row].stop for row in rows))
            for spans in (self._spans_y, self._spans_x)
        )
        here = self._rows[y, x]
        mask = here == rows[0]
        for row in rows[1:]:
            mask |= here == row
        return (y, x), mask

    def parts_in(self, window: tuple[slice, slice], mask: NDArray[np.bool_], min_area: int) -> list[NDArray[np.bool_]]:
        """Return a mask for each part of an instance with at least ``min_area`` visible pixels."""
        here = self._parts[window]
        numbers, areas = np.unique(here[mask], return_counts=True)
        return [here == number for number in numbers[areas >= min_area]]

    def neighbours(self, background: NDArray[np.bool_]) -> NDArray[np.int64]:
        """Return for each instance the one with the longest common border, (n,); -1 if none touches it."""
        n = len(self.instances)
        borders = np.zeros((n, n), np.int64)
        for one, other in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
            step = np.abs(self._depth_m[one] - self._depth_m[other])
            touching = (self._rows[one] != self._rows[other]) & (step < self._touch_m)
            pairs = self._rows[one][touching] * n + self._rows[other][touching]
            borders += np.bincount(pairs, minlength=n * n).reshape(n, n)
        borders += borders.T
        out = background | (self.instances == NOTHING)
        borders[out], borders[:, out] = 0, 0
        return np.where(borders.max(axis=1) > 0, borders.argmax(axis=1), -1)


class _Found:
    """The masks of a frame: each may be cut into its pieces, gets its border shifted, and is dropped if too small."""

    def __init__(
        self, shape: tuple[int, ...], min_area: int, cut_probability: float, jitter: int, rng: np.random.Generator
    ) -> None:
        self._shape, self._min_area, self._cut_probability = shape, min_area, cut_probability
        self._jitter, self._rng = jitter, rng
        self._pieces: list[tuple[tuple[slice, slice], NDArray[np.bool_]]] = []

    def add(self, window: tuple[slice, slice], mask: NDArray[np.bool_]) -> None:
        """Add the mask of a window of the image."""
        cut = self._rng.random() < self._cut_probability
        count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.view(np.uint8), connectivity=8)
        if not cut or count == 2:
            self._shift(window, mask)
            return
        for number in range(1, count):
            x, y, width, height, area = (int(value) for value in stats[number])
            if area >= self._min_area:
                top, left = window[0].start + y, window[1].start + x
                piece = labels[y : y + height, x : x + width] == number
                self._shift((slice(top, top + height), slice(left, left + width)), piece)

    def masks(self) -> Masks:
        """Return all masks, in the order in which they were added."""
        masks = np.zeros((len(self._pieces), *self._shape), bool)
        for target, (window, piece) in zip(masks, self._pieces, strict=True):
            target[window] = piece
        return Masks.from_masks(masks)

    def _shift(self, window: tuple[slice, slice], mask: NDArray[np.bool_]) -> None:
        by = int(self._rng.integers(-self._jitter, self._jitter + 1))
        if by > 0:
            (top, bottom), (left, right) = (
                (max(0, side.start - by), min(size, side.stop + by)) for side, size in zip(window, self._shape, strict=True)
            )
            y, x = window
            padded = cv2.copyMakeBorder(
                mask.view(np.uint8), y.start - top, bottom - y.stop, x.start - left, right - x.stop, cv2.BORDER_CONSTANT
            )
            window = (slice(top, bottom), slice(left, right))
            mask = cv2.dilate(padded, _CROSS, iterations=by).view(bool)
        elif by < 0:
            # Erode from the border of the window, but not from that of the image: the object may go on beyond it.
            mask = _eroded(mask, window, self._shape, -by)
        if np.count_nonzero(mask) >= self._min_area:
            self._pieces.append((window, mask))


def _eroded(mask: NDArray[np.bool_], window: tuple[slice, slice], shape: tuple[int, ...], by: int) -> NDArray[np.bool_]:
    y, x = window
    outside = [int(y.start > 0), int(y.stop < shape[0]), int(x.start > 0), int(x.stop < shape[1])]
    padded = cv2.copyMakeBorder(mask.view(np.uint8), *outside, cv2.BORDER_CONSTANT)
    eroded = cv2.erode(padded, _CROSS, iterations=by)  # OpenCV counts everything outside the array as part of the mask.
    return np.asarray(eroded[outside[0] : outside[0] + mask.shape[0], outside[2] : outside[2] + mask.shape[1]], bool)


def _span(occupied: NDArray[np.bool_]) -> slice:
    """Return the slice from the first to the last occupied place."""
    places = np.flatnonzero(occupied)
    return slice(int(places[0]), int(places[-1]) + 1)
