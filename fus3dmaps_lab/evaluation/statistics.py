"""Mean, spread and paired comparison of one metric over seeds and scenes.

The spread is the sample standard deviation (divisor n - 1). All tests are two-sided. With five pairs, the signed-rank test
and the sign test never give less than p = 0.0625; the t-test can.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from scipy import stats

from fus3dmaps_core.errors import Fus3dmapsError

Unit = tuple[str, int]
"""The unit by which comparisons are paired: scene and seed."""

_ROUNDING = 1e-12


class ComparisonError(Fus3dmapsError):
    """Results that cannot be compared: some are missing, undefined or given twice."""


@dataclass(frozen=True)
class Spread:
    """Mean and spread of values.

    Attributes:
        count: Number of defined values.
        mean: Their mean; NaN without any.
        std: Sample standard deviation; NaN with fewer than two.
        minimum: Smallest value; NaN without any.
        maximum: Largest value; NaN without any.
        undefined: Number of NaNs, which are left out of everything else.
    """

    count: int
    mean: float
    std: float
    minimum: float
    maximum: float
    undefined: int = 0


@dataclass(frozen=True)
class PairedComparison:
    """Comparison of a second condition with a first one, pair by pair.

    Attributes:
        differences: Second minus first, by unit in ascending order.
        first: Spread of the first condition's values.
        second: Spread of the second condition's values.
        difference: Spread of the differences.
        better: Number of pairs in which the second is greater.
        worse: Number of pairs in which it is smaller.
        t_p: p of the paired t-test; NaN with fewer than two pairs or if all differences are equal.
        wilcoxon_p: p of the signed-rank test without pairs of equal values; 1 if all are equal.
        sign_p: p of the sign test, likewise.
    """

    differences: dict[Unit, float]
    first: Spread
    second: Spread
    difference: Spread
    better: int
    worse: int
    t_p: float
    wilcoxon_p: float
    sign_p: float

    @property
    def count(self) -> int:
        """Number of pairs."""
        return self.difference.count


def spread(values: Iterable[float]) -> Spread:
    """Compute mean, standard deviation and range of the values that are not NaN."""
    everything = np.fromiter(values, np.float64)
    defined = everything[~np.isnan(everything)]
    if not defined.size:
        return Spread(0, math.nan, math.nan, math.nan, math.nan, everything.size)
    return Spread(
        count=defined.size,
        mean=float(defined.mean()),
        std=float(defined.std(ddof=1)) if defined.size > 1 else math.nan,
        minimum=float(defined.min()),
        maximum=float(defined.max()),
        undefined=everything.size - defined.size,
    )


def compare(
    first: Mapping[Unit, float], second: Mapping[Unit, float], names: tuple[str, str] = ("the first", "the second")
) -> PairedComparison:
    """Compare two conditions that were measured on the same scenes and seeds.

    Args:
        first: Values of the first condition by scene and seed.
        second: Values of the second condition by scene and seed.
        names: Names of the two in error messages.

    Raises:
        ComparisonError: A unit is only in one of them, a value is NaN or infinite, or there is no value.
    """
    conditions = ((names[0], first, names[1], second), (names[1], second, names[0], first))
    for name, values, other, others in conditions:
        if lacking := sorted(others.keys() - values.keys()):
            raise ComparisonError(f"{name} lacks {named(lacking)}, which {other} has")
        if undefined := sorted(unit for unit, value in values.items() if not math.isfinite(value)):
            raise ComparisonError(f"{name} is undefined for {named(undefined)}")
    if not first:
        raise ComparisonError(f"neither {names[0]} nor {names[1]} has any result")
    units = sorted(first)
    differences = np.array([second[unit] - first[unit] for unit in units])
    # Values that differ only by rounding are equal: the order of a sum must not decide a sign.
    size = np.array([max(abs(first[unit]), abs(second[unit])) for unit in units])
    differences[np.abs(differences) <= _ROUNDING * size] = 0.0
    better, worse = int((differences > 0).sum()), int((differences < 0).sum())
    return PairedComparison(
        differences=dict(zip(units, differences.tolist(), strict=True)),
        first=spread(first.values()),
        second=spread(second.values()),
        difference=spread(differences.tolist()),
        better=better,
        worse=worse,
        t_p=_t_test(differences),
        wilcoxon_p=float(stats.wilcoxon(differences[differences != 0]).pvalue) if better + worse else 1.0,
        sign_p=float(stats.binomtest(better, better + worse).pvalue) if better + worse else 1.0,
    )


def kept(comparison: PairedComparison) -> float:
    """Compute the share of the first condition's mean that the second keeps, percent; NaN if the first mean is 0."""
    return 100.0 * comparison.second.mean / comparison.first.mean if comparison.first.mean else math.nan


def named(units: Iterable[Unit]) -> str:
    """Name scenes with their seeds for a message: ``building seeds 1, 3; room0 seed 0``."""
    by_scene: dict[str, list[int]] = {}
    for scene, seed in sorted(units):
        by_scene.setdefault(scene, []).append(seed)
    return "; ".join(
        f"{scene} {'seed' if len(seeds) == 1 else 'seeds'} {', '.join(map(str, seeds))}" for scene, seeds in by_scene.items()
    )


def _t_test(differences: np.ndarray) -> float:
    if differences.size < 2 or np.ptp(differences) <= _ROUNDING * np.abs(differences).max():
        return math.nan
    return float(stats.ttest_1samp(differences, 0.0).pvalue)
