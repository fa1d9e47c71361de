"""Figures read off the curves of experiments: the optimum of a sweep, the slope of a line, its last values."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fus3dmaps_lab.evaluation.records import CurvePoint

RATIO = re.compile(r"R\^D / R\^I = (\d+(?:\.\d+)?(?:e[+-]?\d+)?)")
"""Name of a curve of the lambda sweep."""

DENSE_MAP, SLIDING_WINDOW, PREDICTED = "dense map", "sliding window", "predicted"
"""Curves of the memory experiment."""

UNFUSED = ", unfused"
"""Ending of an option's name if its unfused instances are evaluated."""


@dataclass(frozen=True)
class LambdaOptimum:
    """The optimum of one curve of the lambda sweep.

    Attributes:
        ratio: R^D / R^I, the lambda that theory predicts.
        best: Lambda with the greatest mean.
        low: Next lambda below the best one, or the best one itself at the end of the sweep.
        high: Next lambda above the best one, likewise.
        brackets: Whether ratio is within [low, high].
        loss_percent: Loss of the evaluated lambda nearest to ratio against the best one.
        seeds: Number of seeds whose own optimum brackets the ratio, and number of all seeds.
    """

    ratio: float
    best: float
    low: float
    high: float
    brackets: bool
    loss_percent: float
    seeds: tuple[int, int]


@dataclass(frozen=True)
class Line:
    """A straight line through the points of a curve, by least squares.

    Attributes:
        slope: Bytes per m^3.
        offset: Bytes at volume 0.
        linearity: Coefficient of determination, R^2.
        largest_x: Largest volume of its points, m^3.
        volumes: Number of different volumes.
    """

    slope: float
    offset: float
    linearity: float
    largest_x: float
    volumes: int


def metric_words(metric: str) -> str:
    """Name a metric of the lambda sweep with its layer: fused instances, unless it is named ``LAYER/METRIC``."""
    layer, _, name = metric.rpartition("/")
    return f"{name} of {'fused instances' if not layer else 'the ' + layer.replace('_', ' ') + ' layer'}"


def option_of(curve: str) -> tuple[str, bool]:
    """Split the name of a curve of the experiment ``association``: the option, and whether its instances are fused."""
    return curve.removesuffix(UNFUSED), not curve.endswith(UNFUSED)


def predicted_ratio(curve: str) -> float | None:
    """Read R^D / R^I from the name of a curve of the lambda sweep; None for other names."""
    named = RATIO.fullmatch(curve)
    return float(named[1]) if named and float(named[1]) > 0 else None


def lambda_optima(points: Sequence[CurvePoint], metric: str = "mIoU") -> list[LambdaOptimum]:
    """Find the optimum of every curve that is named after its noise ratio, in the order of the ratios."""
    optima = []
    for curve in dict.fromkeys(point.curve for point in points):
        ratio = predicted_ratio(curve)
        by_lambda: dict[float, list[float]] = {}
        by_seed: dict[int, dict[float, float]] = {}
        for point in points:
            if (point.curve, point.metric) == (curve, metric) and not math.isnan(point.value):
                by_lambda.setdefault(point.x, []).append(point.value)
                by_seed.setdefault(point.seed, {})[point.x] = point.value
        if ratio is None or not by_lambda:
            continue
        means = {x: float(np.mean(values)) for x, values in by_lambda.items()}
        best, low, high = _best_of(means)
        nearest = min(means, key=lambda x: abs(math.log(x / ratio)) if x > 0 else math.inf)
        own = [_best_of(values) for values in by_seed.values()]
        optima.append(
            LambdaOptimum(
                *(ratio, best, low, high, low <= ratio <= high, 100 * (1 - means[nearest] / means[best])),
                seeds=(sum(below <= ratio <= above for _, below, above in own), len(own)),
            )
        )
    return sorted(optima, key=lambda optimum: optimum.ratio)


def line_of(points: Sequence[CurvePoint], curve: str) -> Line | None:
    """Fit a line through one curve's bytes over all seeds; None with fewer than two different volumes."""
    xy = np.array([(p.x, p.value) for p in points if (p.curve, p.metric) == (curve, "bytes")], np.float64).reshape(-1, 2)
    x, y = xy[:, 0], xy[:, 1]
    if len(np.unique(x)) < 2:
        return None
    slope, offset = (float(value) for value in np.polyfit(x, y, 1))
    total = float(((y - y.mean()) ** 2).sum())
    residual = float(((y - (slope * x + offset)) ** 2).sum())
    return Line(slope, offset, 1 - residual / total if total else 0.0, float(x.max()), len(np.unique(x)))


def bytes_at_the_end(points: Sequence[CurvePoint]) -> dict[int, tuple[float, float, float]]:
    """Return by seed: the largest mapped volume (m^3), the dense map's bytes there, the sliding window's at its own end.

    Seeds without one of the two curves are left out.
    """
    ends: dict[int, tuple[float, float, float]] = {}
    for seed in sorted({point.seed for point in points}):
        dense, window = (
            max(((p.x, p.value) for p in points if (p.seed, p.curve, p.metric) == (seed, curve, "bytes")), default=None)
            for curve in (DENSE_MAP, SLIDING_WINDOW)
        )
        if dense and window:
            ends[seed] = (*dense, window[1])
    return ends


def _best_of(values: dict[float, float]) -> tuple[float, float, float]:
    """Find the x of the greatest value and its neighbours on the grid (itself at an end)."""
    grid = sorted(values)
    at = max(range(len(grid)), key=lambda i: values[grid[i]])
    return grid[at], grid[max(at - 1, 0)], grid[min(at + 1, len(grid) - 1)]
