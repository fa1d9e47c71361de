"""Verdicts on whether the paper's claims hold in the data, in words with the deciding numbers.

A claim about two maps holds if it is true in all of at least five pairs, or by a paired t-test at p < 0.01. Claims about
means over seeds need five seeds too; claims about memory do not.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from fus3dmaps_lab.evaluation.curves import (
    DENSE_MAP,
    PREDICTED,
    bytes_at_the_end,
    lambda_optima,
    line_of,
    metric_words,
    option_of,
)
from fus3dmaps_lab.evaluation.effects import FUSED_DENSE, FUSED_INSTANCES, NO_EVIDENCE, WINDOW, Effect, compare_effect
from fus3dmaps_lab.evaluation.records import CurvePoint, Record
from fus3dmaps_lab.evaluation.statistics import ComparisonError, PairedComparison, kept, spread

LEAST_PAIRS = 5
"""Least number of pairs for a decision."""

SIGNIFICANT_P = 0.01
"""A paired t-test decides if its p is below this."""

LEAST_KEPT_PERCENT = 98.0
"""Share of full fusion's mIoU that a sliding window must keep."""

SLOPE_TOLERANCE = 0.05
"""Greatest relative difference between measured and predicted bytes per volume."""

LEAST_LINEARITY = 0.99
"""Least coefficient of determination for memory to be called linear in volume."""

FAR_BELOW = 0.5
"""Greatest share of the dense map's memory, at the largest volume, that counts as far below it."""

GREATER_IS_BETTER = ("mIoU", "f-mIoU", "accuracy", "mean_accuracy", "AP25", "AP50", "precision@1", "localised")
"""Metrics by which ways to associate are ranked."""

_WORDS = {True: "holds", False: "does not hold", None: "undecided"}


@dataclass(frozen=True)
class Verdict:
    """The verdict of the data on one claim.

    Attributes:
        claim: The claim in words.
        holds: True, False, or None if the data do not decide.
        numbers: The deciding numbers, in words.
    """

    claim: str
    holds: bool | None
    numbers: str

    def __str__(self) -> str:
        return f"{_WORDS[self.holds]}: {self.claim}. {self.numbers}"


def effect_verdicts(records: Sequence[Record], metric: str = "mIoU") -> list[Verdict]:
    """Judge the four claims that compare two maps; leave out those without data.

    Args:
        records: Records of one group, so that simulated and recorded scenes are never averaged.
        metric: Compared metric.
    """
    claims: tuple[tuple[Effect, str], ...] = (
        (FUSED_INSTANCES, f"fused instances beat unfused instances in {metric}"),
        (FUSED_DENSE, f"the fused dense layer beats the unfused one in {metric}"),
        (WINDOW, f"the sliding window keeps at least {LEAST_KEPT_PERCENT:g} % of full fusion's {metric}"),
        (NO_EVIDENCE, f"without the evidence score the sliding window is worse in {metric}"),
    )
    verdicts = []
    for effect, claim in claims:
        try:
            found = compare_effect(records, effect, metric)
        except ComparisonError as error:
            verdicts.append(Verdict(claim, None, f"Not compared: {error}."))
            continue
        if found is not None:
            verdicts.append(_effect_verdict(effect, claim, found))
    return verdicts


def lambda_verdict(points: Sequence[CurvePoint], metric: str = "mIoU") -> Verdict | None:
    """Judge whether the best lambda brackets R^D / R^I at all of at least three noise ratios; None without a sweep."""
    optima = lambda_optima(points, metric)
    if not optima:
        return None
    said = [
        f"At {o.ratio:g} the best lambda is {o.best:g}, between {o.low:g} and {o.high:g}; the predicted one loses "
        f"{o.loss_percent:.2f} %; brackets it in {o.seeds[0]} of {o.seeds[1]} seeds taken alone."
        for o in optima
    ]
    seeds = min(optimum.seeds[1] for optimum in optima)
    every = all(optimum.brackets for optimum in optima)
    claim = f"the best lambda brackets R^D / R^I ({metric_words(metric)})"
    if seeds < LEAST_PAIRS:
        return Verdict(claim, None, " ".join([*said, _few(seeds)]))
    return Verdict(claim, False if not every else True if len(optima) >= 3 else None, " ".join(said))


def memory_verdicts(points: Sequence[CurvePoint]) -> list[Verdict]:
    """Judge whether the dense map's memory is linear in volume with the predicted slope, and the window's far below it.

    Args:
        points: Points of the experiment ``memory``.
    """
    verdicts = []
    dense, predicted = line_of(points, DENSE_MAP), line_of(points, PREDICTED)
    if dense and dense.volumes >= 3:  # Two points always lie on a line.
        said = f"{dense.slope:,.0f} bytes per m³ up to {dense.largest_x:,.0f} m³, R² = {dense.linearity:.4f}"
        holds = None if dense.linearity >= LEAST_LINEARITY else False
        if predicted:
            off = dense.slope / predicted.slope - 1 if predicted.slope else math.inf
            said += f"; predicted {predicted.slope:,.0f} bytes per m³ ({100 * off:+.1f} %)"
            holds = dense.linearity >= LEAST_LINEARITY and abs(off) <= SLOPE_TOLERANCE
        claim = "the dense map's memory is linear in the mapped volume, with the predicted slope"
        verdicts.append(Verdict(claim, holds, f"{said}."))
    share = spread(window / dense for _, dense, window in bytes_at_the_end(points).values() if dense)
    if share.count:
        said = f"At the largest volume it takes {100 * share.mean:.1f} % of it, at most {100 * share.maximum:.1f} %"
        verdicts.append(
            Verdict(
                "the sliding window's memory is far below the dense map's",
                share.maximum <= FAR_BELOW,
                f"{said}; {share.count} {'seed' if share.count == 1 else 'seeds'}.",
            )
        )
    return verdicts


def association_verdict(points: Sequence[CurvePoint]) -> Verdict | None:
    """Judge whether one way to associate is best by every metric, fused and unfused; None with fewer than two ways.

    Args:
        points: Points of the experiment ``association``.
    """
    winners, said = set(), []
    for fused in (True, False):
        curves = [curve for curve in dict.fromkeys(point.curve for point in points) if option_of(curve)[1] == fused]
        for metric in GREATER_IS_BETTER if len(curves) > 1 else ():
            means = {c: spread(p.value for p in points if (p.curve, p.metric) == (c, metric)).mean for c in curves}
            defined = {curve: mean for curve, mean in means.items() if not math.isnan(mean)}
            if defined:
                best = max(defined, key=lambda curve: defined[curve])
                winners.add(option_of(best)[0])
                said.append(f"{'' if fused else 'unfused '}{metric}: {option_of(best)[0]} ({defined[best]:.4f})")
    if not winners:
        return None
    claim = f"{min(winners) if len(winners) == 1 else 'one way to associate'} is the best by every metric"
    numbers = f"Best on average over seeds by {', by '.join(said)}."
    seeds = len({point.seed for point in points})
    if seeds < LEAST_PAIRS:
        return Verdict(claim, None, f"{numbers} {_few(seeds)}")
    return Verdict(claim, len(winners) == 1, numbers)


def _effect_verdict(effect: Effect, claim: str, found: PairedComparison) -> Verdict:
    pairs = "pair" if found.count == 1 else "pairs"
    if effect == WINDOW:
        share = kept(found)
        said = f"It keeps {share:.2f} %"
        true: bool = share >= LEAST_KEPT_PERCENT
    else:
        down = effect == NO_EVIDENCE
        agreeing = found.worse if down else found.better
        said = f"{'Worse' if down else 'Better'} in {agreeing} of {found.count} {pairs}"
        sign = -1 if down else 1
        true = agreeing == found.count or (sign * found.difference.mean > 0 and found.t_p < SIGNIFICANT_P)
    std = "" if math.isnan(found.difference.std) else f" ± {found.difference.std:.4f}"
    said += f", mean {found.first.mean:.4f} → {found.second.mean:.4f}, difference {found.difference.mean:+.4f}{std}"
    said += f"; p = {_p(found.t_p)} (t-test), {_p(found.wilcoxon_p)} (signed rank), {_p(found.sign_p)} (sign test)"
    if found.count < LEAST_PAIRS:
        return Verdict(claim, None, f"{said}; {found.count} {pairs}, at least {LEAST_PAIRS} decide.")
    return Verdict(claim, true, f"{said}; {found.count} pairs.")


def _few(seeds: int) -> str:
    return f"{seeds} {'seed' if seeds == 1 else 'seeds'}, at least {LEAST_PAIRS} decide."


def _p(p: float) -> str:
    return "undefined" if math.isnan(p) else f"{p:.2g}"
