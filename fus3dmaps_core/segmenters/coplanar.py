"""The union of neighbouring segments that lie in one plane.

Inverse depth is affine in pixel coordinates on a plane, 1/z = a u + b v + c, whatever the camera's focal length. Segments
are joined as long as one such fit explains both sides to within a relative depth error, the best-fitting pair first. All
sums that a fit needs are additive, so that a union costs no look at the pixels.
"""

from __future__ import annotations

import heapq
import math
from itertools import count

import numpy as np
from numpy.typing import NDArray

_MIN_READINGS = 30  # Below this a plane fits anything.


class _Moments:
    """Sums over the depth readings of a region, weighted so that residuals are relative depth errors."""

    def __init__(self, normal: NDArray[np.float64], right: NDArray[np.float64], readings: float) -> None:
        self.normal, self.right, self.readings = normal, right, readings

    def __add__(self, other: _Moments) -> _Moments:
        return _Moments(self.normal + other.normal, self.right + other.right, self.readings + other.readings)

    def plane(self) -> NDArray[np.float64]:
        # The ridge only matters for pixels in a line, through which many planes go.
        ridge = 1e-9 * float(np.trace(self.normal)) * np.eye(3)
        return np.asarray(np.linalg.solve(self.normal + ridge, self.right), np.float64)

    def error(self, plane: NDArray[np.float64]) -> float:
        """Compute the root mean square of the relative error of depth under a plane."""
        square = plane @ self.normal @ plane - 2 * plane @ self.right + self.readings
        return math.sqrt(max(float(square), 0.0) / self.readings)


def join_coplanar(
    labels: NDArray[np.integer], depth_m: NDArray[np.float32], max_relative_error: float
) -> list[NDArray[np.int64]]:
    """Group segments into planes.

    Args:
        labels: (h, w), segment of every pixel, 0 to n - 1.
        depth_m: (h, w) float32 metres, 0 where there is no reading.
        max_relative_error: Largest root mean square of the relative depth error of each side of a union.

    Returns:
        For every plane of two or more segments, their labels in ascending order; planes in order of their first label.
    """
    n = int(labels.max()) + 1
    regions = {
        label: moments for label, moments in enumerate(_moments(labels, depth_m, n)) if moments.readings >= _MIN_READINGS
    }
    members = {label: [label] for label in regions}
    neighbours: dict[int, set[int]] = {label: set() for label in regions}
    for a, b in adjacent_pairs(labels):
        if a in regions and b in regions:
            neighbours[a].add(b)
            neighbours[b].add(a)

    heap: list[tuple[float, int, int]] = []

    def consider(a: int, b: int) -> None:
        plane = (regions[a] + regions[b]).plane()
        error = max(regions[a].error(plane), regions[b].error(plane))
        if error <= max_relative_error:
            heapq.heappush(heap, (error, min(a, b), max(a, b)))

    for a in regions:
        for b in sorted(neighbours[a]):
            if a < b:
                consider(a, b)
    fresh = count(n)
    while heap:
        _, a, b = heapq.heappop(heap)
        if a not in regions or b not in regions:
            continue
        union = next(fresh)
        regions[union] = regions.pop(a) + regions.pop(b)
        members[union] = members.pop(a) + members.pop(b)
        neighbours[union] = (neighbours.pop(a) | neighbours.pop(b)) - {a, b}
        for other in sorted(neighbours[union]):
            neighbours[other] -= {a, b}
            neighbours[other].add(union)
            consider(other, union)
    groups = [np.array(sorted(group), np.int64) for group in members.values() if len(group) > 1]
    return sorted(groups, key=lambda group: int(group[0]))


def adjacent_pairs(labels: NDArray[np.integer]) -> NDArray[np.int64]:
    """List the pairs a < b of labels that touch along a pixel's edge, sorted: (m, 2) int64."""
    pairs = np.concatenate(
        [
            np.stack([labels[:, :-1].ravel(), labels[:, 1:].ravel()], axis=1),
            np.stack([labels[:-1].ravel(), labels[1:].ravel()], axis=1),
        ]
    ).astype(np.int64)
    pairs = pairs[pairs[:, 0] != pairs[:, 1]]
    return np.unique(np.sort(pairs, axis=1), axis=0)


def _moments(labels: NDArray[np.integer], depth_m: NDArray[np.float32], n: int) -> list[_Moments]:
    height, width = labels.shape
    rows, columns = np.nonzero(depth_m > 0)
    z = depth_m[rows, columns].astype(np.float64)
    # Coordinates of order one keep the normal equations well conditioned.
    pixels = np.stack([columns / width - 0.5, rows / height - 0.5, np.ones(len(z))])
    of = labels[rows, columns]

    def summed(values: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.bincount(of, values, minlength=n).astype(np.float64)

    # Residuals of 1/z weighted with z: ((1/z - p.x) z)^2 = (1 - z p.x)^2.
    normal = np.array([[summed(z * z * p * q) for q in pixels] for p in pixels])
    right = np.array([summed(z * p) for p in pixels])
    readings = np.bincount(of, minlength=n)
    return [_Moments(normal[:, :, row], right[:, row], float(readings[row])) for row in range(n)]
