"""Mean, spread and paired comparison of one metric over seeds and scenes.

The spread is the sample standard deviation (divisor n - 1). All tests are two-sided. With five pairs the signed-rank and the
sign test cannot go below p = 0.0625, whatever the data; the t-test can.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from scipy import stats

from fus3dmaps_core.errors import Fus3dmapsError

Unit = tuple[str, int]
"""What a comparison pairs by: scene and seed."""

_ROUNDING = 1e-12


class ComparisonError(Fus3dmapsError):
    """Results cannot be compared: some are missing, undefined or given twice."""


@dataclass(frozen=True)
class Spread:
    """How values are spread.

    Attributes:
        count: How many are defined.
        mean: Of those; NaN without any.
        std: Sample standard deviation; NaN with fewer than two.
        minimum: Smallest; NaN without any.
        maximum: Largest; NaN without any.
        undefined: How many were NaN and are left out of all the others.
    """

    count: int
    mean: float
    std: float
    minimum: float
    maximum: float
    undefined: int = 0


@dataclass(frozen=True)
class PairedComparison:
    """A second condition against a first one, pair by pair.

    Attributes:
        differences: Second minus first by unit, in the units' order.
        first: Spread of the first condition's values.
        second: Spread of the second condition's values.
        difference: Spread of the differences.
        better: In how many pairs the second is greater.
        worse: In how many it is smaller.
        t_p: p of the paired t-test; NaN with fewer than two pairs or where all differences are equal.
        wilcoxon_p: p of the signed-rank test, pairs without a difference left out; 1 where none has one.
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
    """Mean, standard deviation and range of the values that are defined."""
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
        first: Value by scene and seed.
        second: The same for the other condition.
        names: What the two are called in a refusal.

    Raises:
        ComparisonError: A unit is in one of them only, a value is NaN or infinite, or there is none.
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
    # What differs by rounding alone is equal: a sum in another order must not decide a sign.
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
    """Share of the first condition's mean that the second keeps, in percent; NaN where the first mean is 0."""
    return 100.0 * comparison.second.mean / comparison.first.mean if comparison.first.mean else math.nan


def named(units: Iterable[Unit]) -> str:
    """Scenes with their seeds, for a message: ``building seeds 1, 3; room0 seed 0``."""
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
