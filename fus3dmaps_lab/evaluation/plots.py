"""Plots of an evaluation, drawn without a display and without changing matplotlib's global state.

Colours are those of Okabe and Ito, which can be distinguished with any colour vision; no curve differs from another by
colour alone. Plots of simulations say so in their titles.
"""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import wraps
from typing import Any, ParamSpec, TypeVar

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from fus3dmaps_lab.evaluation.curves import PREDICTED, lambda_optima, metric_words, predicted_ratio
from fus3dmaps_lab.evaluation.effects import CLASS_PREFIX, Condition, Effect, is_simulated, values_of
from fus3dmaps_lab.evaluation.records import CurvePoint, Record
from fus3dmaps_lab.evaluation.statistics import Spread, spread

BLUE, ORANGE, GREEN = "#0072B2", "#E69F00", "#009E73"
PURPLE, SKY, VERMILION, BLACK = "#CC79A7", "#56B4E9", "#D55E00", "#222222"
COLORS = (BLUE, VERMILION, GREEN, PURPLE, ORANGE, SKY, BLACK)
MARKERS = ("o", "s", "^", "D", "v", "P", "X")
GREY = "#8A8A8A"

ASSOCIATION_METRICS = ("mIoU", "AP25", "AP50", "instances")
"""Metrics of the experiment ``association`` that are drawn if they were measured."""

_GIB, _MIB = 2.0**30, 2.0**20
_DPI = 160
_LEGEND_IN = 0.34
_STYLE = {
    "axes.axisbelow": True,
    "axes.edgecolor": "#555555",
    "axes.grid": True,
    "axes.labelsize": 10,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlesize": 11,
    "figure.facecolor": "white",
    "font.family": "DejaVu Sans",  # Comes with matplotlib, so it is the same on every machine.
    "font.size": 9,
    "grid.color": "#E3E3E3",
    "legend.frameon": False,
    "lines.linewidth": 1.8,
    "lines.markersize": 5,
    "savefig.dpi": _DPI,
    "svg.hashsalt": "fus3dmaps",
}

_P = ParamSpec("_P")
_R = TypeVar("_R")


@contextmanager
def _style() -> Iterator[None]:
    """Use our settings over matplotlib's defaults inside the ``with`` block; restore the user's settings afterwards."""
    with mpl.rc_context():
        mpl.rcdefaults()
        parameters: Any = mpl.rcParams
        parameters.update(_STYLE)
        yield


def _styled(draw: Callable[_P, _R]) -> Callable[_P, _R]:
    @wraps(draw)
    def drawn(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        with _style():
            return draw(*args, **kwargs)

    return drawn


def image_bytes(figure: Figure, form: str = "png") -> bytes:
    """Render a figure as a PNG or SVG file: the same bytes for the same data and release of matplotlib.

    Args:
        figure: Figure drawn by a function of this module.
        form: ``png`` or ``svg``.
    """
    stream = io.BytesIO()
    metadata = {"png": {"Software": None}, "svg": {"Date": None, "Creator": None}}[form]
    with _style():
        figure.savefig(stream, format=form, metadata=metadata)
    return stream.getvalue()


@_styled
def class_plot(records: Sequence[Record], effect: Effect) -> Figure | None:
    """Draw the IoU of every class under both conditions of an effect, classes ordered by the change.

    Points are means over the scenes and seeds that have both values; lines are standard deviations.

    Args:
        records: Records of one group.
        effect: Effect whose conditions are drawn.

    Returns:
        The figure; None without a class that both conditions have.
    """
    pairs = {name: both for name in _classes(records) if (both := _class_pair(records, effect, name))}
    if not pairs:
        return None
    names = sorted(pairs, key=lambda name: (pairs[name][1].mean - pairs[name][0].mean, name))
    figure, (axes,) = _figure(7.0, 1.4 + 0.24 * len(names), legend_below=True)
    rows = np.arange(len(names))
    for which, color, marker, offset in ((0, ORANGE, "s", -0.13), (1, BLUE, "o", 0.13)):
        spreads = [pairs[name][which] for name in names]
        condition = (effect.first, effect.second)[which]
        axes.errorbar(
            [one.mean for one in spreads],
            rows + offset,
            xerr=[_std(one) for one in spreads],
            fmt=marker,
            color=color,
            elinewidth=1.0,
            capsize=2,
            label=_words(condition),
        )
    for row, name in zip(rows, names, strict=True):
        axes.plot([one.mean for one in pairs[name]], [row - 0.13, row + 0.13], color=GREY, linewidth=0.8, zorder=1)
    axes.set_yticks(rows, names)
    axes.set_ylim(-0.8, len(names) - 0.2)
    axes.set_xlim(-0.02, 1.02)
    axes.set_xlabel("IoU")
    better = sum(second.mean > first.mean for first, second in pairs.values())
    title = f"{effect.title.capitalize()}:\nIoU is greater for {better} of {len(names)} classes"
    axes.set_title(_titled(title, _simulated(records)), loc="left")
    _legend_below(figure, [axes])
    return figure


@_styled
def lambda_plot(points: Sequence[CurvePoint], metric: str = "mIoU") -> Figure | None:
    """Draw the lambda sweep: a panel per noise ratio, seeds in grey, their mean with a band of one standard deviation.

    Args:
        points: Points of the experiment ``lambda``.
        metric: One of its metrics.

    Returns:
        The figure; None without points of that metric.
    """
    chosen = [point for point in points if point.metric == metric and point.x > 0]
    curves = sorted(dict.fromkeys(p.curve for p in chosen), key=lambda curve: predicted_ratio(curve) or math.inf)
    if not curves:
        return None
    optima = {optimum.ratio: optimum for optimum in lambda_optima(chosen, metric)}
    figure, panels = _figure(max(5.2, 3.5 * len(curves)), 3.7, len(curves), legend_below=True)
    for i, (axes, curve) in enumerate(zip(panels, curves, strict=True)):
        color, own = COLORS[i % len(COLORS)], [point for point in chosen if point.curve == curve]
        for seed in sorted({point.seed for point in own}):
            xy = sorted((point.x, point.value) for point in own if point.seed == seed)
            axes.plot(
                *zip(*xy, strict=True), color="#BBBBBB", linewidth=0.8, label="one seed" if seed == own[0].seed else None
            )
        xs, spreads = _by_x(own)
        _band(axes, xs, spreads, color, MARKERS[i % len(MARKERS)], "mean ± std")
        ratio = predicted_ratio(curve)
        if ratio is not None:
            axes.axvline(ratio, color=BLACK, linestyle="--", linewidth=1.2, label="predicted: R$^D$ / R$^I$")
        if ratio in optima:
            best = optima[ratio].best
            axes.plot(
                [best],
                [spreads[xs.index(best)].mean],
                marker="*",
                markersize=14,
                color=ORANGE,
                markeredgecolor=BLACK,
                linestyle="none",
                label="best lambda",
            )
        axes.set_xscale("log")
        axes.set_xlabel("lambda")
        axes.set_title(curve.replace("R^D / R^I", "R$^D$ / R$^I$"))
    panels[0].set_ylabel(metric_words(metric))
    figure.suptitle(_titled("Accuracy against lambda", True))
    _legend_below(figure, panels)
    return figure


@_styled
def memory_plot(points: Sequence[CurvePoint]) -> Figure | None:
    """Draw memory against mapped volume: every measurement, and the predicted line.

    Args:
        points: Points of the experiment ``memory``.

    Returns:
        The figure; None without bytes.
    """
    chosen = [point for point in points if point.metric == "bytes"]
    if not chosen:
        return None
    unit, name = (_GIB, "GiB") if max(point.value for point in chosen) >= _GIB else (_MIB, "MiB")
    figure, (axes,) = _figure(6.4, 4.2)
    measured = [curve for curve in dict.fromkeys(point.curve for point in chosen) if curve != PREDICTED]
    for i, curve in enumerate(measured):
        own = [point for point in chosen if point.curve == curve]
        for seed in sorted({point.seed for point in own}):
            xy = sorted((point.x, point.value / unit) for point in own if point.seed == seed)
            axes.plot(
                *zip(*xy, strict=True),
                color=COLORS[i % len(COLORS)],
                marker=MARKERS[i % len(MARKERS)],
                linewidth=1.0,
                markersize=4,
                alpha=0.85,
                label=curve if seed == own[0].seed else None,
            )
    predicted = sorted((point.x, point.value / unit) for point in chosen if point.curve == PREDICTED)
    if predicted:
        axes.plot(
            *zip(*predicted, strict=True), color=BLACK, linestyle="--", linewidth=1.4, label="predicted by bytes per voxel"
        )
    axes.set_xlim(left=0)
    axes.set_ylim(bottom=0)
    axes.set_xlabel("mapped volume, m³")
    axes.set_ylabel(f"memory, {name}")
    axes.set_title(_titled("Memory against mapped volume", True), loc="left")
    axes.legend(loc="upper left")
    return figure


@_styled
def window_plot(points: Sequence[CurvePoint], metric: str = "mIoU") -> Figure | None:
    """Draw accuracy against the window's radius: a curve per layer, the mean with a band of one standard deviation.

    Args:
        points: Points of the experiment ``window_radius``. A radius of 0 or infinity stands for the whole dense layer and is
            drawn as a horizontal line.
        metric: One of its metrics.

    Returns:
        The figure; None without points of that metric.
    """
    chosen = [point for point in points if point.metric == metric]
    if not chosen:
        return None
    figure, (axes,) = _figure(6.4, 4.0)
    for i, curve in enumerate(dict.fromkeys(point.curve for point in chosen)):
        own = [point for point in chosen if point.curve == curve]
        color, label = COLORS[i % len(COLORS)], curve.replace("_", " ")
        xs, spreads = _by_x([point for point in own if _is_radius(point.x)])
        if xs:
            _band(axes, xs, spreads, color, MARKERS[i % len(MARKERS)], label)
        whole = spread(point.value for point in own if not _is_radius(point.x))
        if whole.count:
            axes.axhline(whole.mean, color=color, linestyle="--", linewidth=1.2, label=f"{label}, whole dense layer")
    axes.set_xlabel("radius of the window, m")
    axes.set_ylabel(metric)
    axes.set_title(_titled("Accuracy against the radius of the sliding window", True), loc="left")
    axes.legend(loc="best")
    return figure


@_styled
def association_plot(points: Sequence[CurvePoint]) -> Figure | None:
    """Draw the ways to associate proposals with instances: a panel of bars per metric; lines are one standard deviation.

    Args:
        points: Points of the experiment ``association``.

    Returns:
        The figure; None without any of ASSOCIATION_METRICS.
    """
    metrics = [metric for metric in ASSOCIATION_METRICS if any(point.metric == metric for point in points)]
    if not metrics:
        return None
    ways = list(dict.fromkeys(point.curve for point in points))
    figure, panels = _figure(1.8 + 2.3 * len(metrics), 1.5 + 0.42 * len(ways), len(metrics))
    rows = np.arange(len(ways))[::-1]
    for i, (axes, metric) in enumerate(zip(panels, metrics, strict=True)):
        spreads = [spread(p.value for p in points if (p.curve, p.metric) == (way, metric)) for way in ways]
        axes.barh(
            rows,
            [one.mean for one in spreads],
            xerr=[_std(one) for one in spreads],
            color=GREY if metric == "instances" else BLUE,
            height=0.62,
            error_kw={"elinewidth": 1.1, "capsize": 3, "ecolor": BLACK},
        )
        for row, one in zip(rows, spreads, strict=True):
            if one.count:
                text = f"{one.mean:,.0f}" if metric == "instances" else f"{one.mean:.3f}"
                axes.annotate(
                    text,
                    (0, row),
                    xytext=(4, 0),
                    textcoords="offset points",
                    va="center",
                    color="white",
                    weight="bold",
                )
        axes.set_yticks(rows, ways if i == 0 else [""] * len(ways))
        axes.set_xlabel("number of instances" if metric == "instances" else metric)
        axes.grid(visible=False, axis="y")
    figure.suptitle(_titled("Association of proposals with instances", True))
    return figure


def _figure(width_in: float, height_in: float, panels: int = 1, legend_below: bool = False) -> tuple[Figure, list[Axes]]:
    """Make a figure with panels side by side and, if wanted, room for a legend under them."""
    share = _LEGEND_IN / height_in if legend_below else 0.0
    figure = Figure(figsize=(width_in, height_in), layout=ConstrainedLayoutEngine(rect=(0, share, 1, 1 - share)))
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, panels, squeeze=False)
    return figure, list(axes.ravel())


def _legend_below(figure: Figure, panels: Sequence[Axes]) -> None:
    """Add one legend for panels whose curves have the same labels."""
    handles: dict[str, Any] = {}
    for axes in panels:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            handles.setdefault(label, handle)
    figure.legend(list(handles.values()), list(handles), loc="lower center", ncols=len(handles))


def _band(axes: Axes, xs: Sequence[float], spreads: Sequence[Spread], color: str, marker: str, label: str) -> None:
    means, stds = np.array([one.mean for one in spreads]), np.array([_std(one) for one in spreads])
    axes.plot(xs, means, color=color, marker=marker, label=label)
    axes.fill_between(xs, means - stds, means + stds, color=color, alpha=0.18, linewidth=0)


def _by_x(points: Sequence[CurvePoint]) -> tuple[list[float], list[Spread]]:
    values: dict[float, list[float]] = {}
    for point in points:
        if not math.isnan(point.value):
            values.setdefault(point.x, []).append(point.value)
    xs = sorted(values)
    return xs, [spread(values[x]) for x in xs]


def _classes(records: Sequence[Record]) -> list[str]:
    return sorted({r.metric.removeprefix(CLASS_PREFIX) for r in records if r.metric.startswith(CLASS_PREFIX)})


def _class_pair(records: Sequence[Record], effect: Effect, name: str) -> tuple[Spread, Spread] | None:
    """Compute the spread of a class's IoU under both conditions, over the scenes and seeds that have both."""
    first, second = (values_of(records, condition, CLASS_PREFIX + name) for condition in (effect.first, effect.second))
    both = [unit for unit in first if not math.isnan(first[unit] + second.get(unit, math.nan))]
    return (spread(first[unit] for unit in both), spread(second[unit] for unit in both)) if both else None


def _is_radius(x: float) -> bool:
    return 0 < x < math.inf


def _simulated(records: Sequence[Record]) -> bool:
    return any(is_simulated(record.scene) for record in records)


def _std(one: Spread) -> float:
    return 0.0 if math.isnan(one.std) else one.std


def _titled(title: str, simulated: bool) -> str:
    return f"{title} (simulation)" if simulated else title


def _words(condition: Condition) -> str:
    mode = {"full": "", "window": ", sliding window", "window_no_evidence": ", sliding window without evidence score"}
    return condition.layer.replace("_", " ") + mode.get(condition.mode, f", {condition.mode}")
