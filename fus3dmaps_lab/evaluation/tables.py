"""Tables of an evaluation, written as Markdown for people and as CSV for programs.

In Markdown a cell with a spread reads ``mean ± standard deviation``; in CSV its column becomes five. In CSV, text is quoted,
numbers have full precision and no quotes, and missing numbers are ``nan``, so ``csv.QUOTE_NONNUMERIC`` reads it back.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import product

from fus3dmaps_lab.evaluation.curves import option_of
from fus3dmaps_lab.evaluation.effects import EFFECTS, Condition, compare_effect, metrics_in, values_of
from fus3dmaps_lab.evaluation.records import LAYERS, MODES, CurvePoint, Record
from fus3dmaps_lab.evaluation.statistics import ComparisonError, PairedComparison, Spread, compare, kept, spread

Cell = str | int | float | Spread

ALL_SCENES = "all scenes"
"""Name of the scene in averages over several scenes."""

_MISSING = "–"
_SPREAD_PARTS = ("mean", "std", "min", "max", "n")


@dataclass(frozen=True)
class Column:
    """A column of a table.

    Attributes:
        name: Heading, with the unit if there is one.
        form: Format of its numbers in Markdown.
    """

    name: str
    form: str = ".4f"


@dataclass(frozen=True)
class Table:
    """Rows under named columns.

    Attributes:
        columns: The columns.
        rows: Rows with one cell per column; missing numbers are NaN, missing spreads have count 0.
    """

    columns: tuple[Column, ...]
    rows: tuple[tuple[Cell, ...], ...]

    def __post_init__(self) -> None:
        for row in self.rows:
            if len(row) != len(self.columns):
                raise ValueError(f"a row of {len(row)} cells under {len(self.columns)} columns")

    def markdown(self) -> str:
        """Format the table as GitHub Markdown, numbers right-aligned; every line ends in a line break."""
        numeric = [any(not isinstance(row[i], str) for row in self.rows) for i in range(len(self.columns))]
        lines = [
            [_escaped(column.name) for column in self.columns],
            ["--:" if right else "---" for right in numeric],
            *([_shown(cell, column.form) for cell, column in zip(row, self.columns, strict=True)] for row in self.rows),
        ]
        return "".join(f"| {' | '.join(line)} |\n" for line in lines)

    def csv(self) -> str:
        """Format the table as CSV with a heading line; spreads become mean, std, min, max and n."""
        spreads = [any(isinstance(row[i], Spread) for row in self.rows) for i in range(len(self.columns))]
        stream = io.StringIO()
        writer = csv.writer(stream, quoting=csv.QUOTE_NONNUMERIC, lineterminator="\n")
        heading: list[str] = []
        for column, is_spread in zip(self.columns, spreads, strict=True):
            heading += [f"{column.name} {part}" for part in _SPREAD_PARTS] if is_spread else [column.name]
        writer.writerow(heading)
        for row in self.rows:
            line: list[str | int | float] = []
            for cell in row:
                line += _parts(cell) if isinstance(cell, Spread) else [cell]
            writer.writerow(line)
        return stream.getvalue()


_TEST_COLUMNS = (
    *(Column("first"), Column("second"), Column("second - first", "+.4f"), Column("second / first, %", ".1f")),
    *(Column("second greater"), Column("p, t-test", ".2g"), Column("p, signed rank", ".2g"), Column("p, sign test", ".2g")),
)


def records_table(records: Iterable[Record]) -> Table:
    """List every record in a row, with IoUs of classes, in a fixed order."""
    rows = sorted((r.scene, r.seed, _rank(LAYERS, r.layer), _rank(MODES, r.mode), r.metric, r.value) for r in records)
    columns = ("scene", "seed", "layer", "mode", "metric", "value")
    return Table(
        tuple(Column(name) for name in columns),
        tuple((scene, seed, layer[1], mode[1], metric, value) for scene, seed, layer, mode, metric, value in rows),
    )


def scores_table(records: Sequence[Record], metrics: Sequence[str] | None = None) -> Table:
    """List the scores: a row per scene, seed, layer and mode, a column per metric (default: all but classes')."""
    names = tuple(metrics if metrics is not None else metrics_in(records))
    rows: list[tuple[Cell, ...]] = []
    by_condition = {
        condition: {metric: values_of(records, condition, metric) for metric in names}
        for condition in conditions_in(records)
    }
    for unit in sorted({(record.scene, record.seed) for record in records}):
        for condition, by_metric in by_condition.items():
            values = [by_metric[metric].get(unit, math.nan) for metric in names]
            if not all(map(math.isnan, values)):
                rows.append((*unit, condition.layer, condition.mode, *values))
    return Table((*map(Column, ("scene", "seed", "layer", "mode")), *map(Column, names)), tuple(rows))


def summary_table(records: Sequence[Record], metrics: Sequence[str] | None = None) -> Table:
    """Summarise by scene, layer and mode: mean and spread over seeds, and over all scenes if there are several."""
    names = tuple(metrics if metrics is not None else metrics_in(records))
    scenes = sorted({record.scene for record in records})
    rows: list[tuple[Cell, ...]] = []
    for condition in conditions_in(records):
        by_metric = {metric: values_of(records, condition, metric) for metric in names}
        for scene in [*scenes, *([ALL_SCENES] if len(scenes) > 1 else [])]:
            spreads = [
                spread(value for (where, _), value in by_metric[metric].items() if scene in (where, ALL_SCENES))
                for metric in names
            ]
            if any(cell.count for cell in spreads):
                rows.append((scene, condition.layer, condition.mode, *spreads))
    return Table((*map(Column, ("scene", "layer", "mode")), *map(Column, names)), tuple(rows))


def metrics_table(records: Sequence[Record], metrics: Sequence[str]) -> Table:
    """Summarise over scenes and seeds: mean and spread, a row per metric, a column per layer and mode."""
    conditions = conditions_in(records)
    rows: list[tuple[Cell, ...]] = [
        (metric, *(spread(values_of(records, condition, metric).values()) for condition in conditions)) for metric in metrics
    ]
    return Table((Column("metric"), *(Column(str(condition)) for condition in conditions)), tuple(rows))


def comparison_table(records: Sequence[Record], metrics: Sequence[str]) -> tuple[Table, list[str]]:
    """Run the paired tests of every effect in every metric.

    Returns:
        The table, and the reasons for comparisons that were not possible.
    """
    rows: list[tuple[Cell, ...]] = []
    refusals: list[str] = []
    for effect in EFFECTS:
        for metric in metrics:
            try:
                found = compare_effect(records, effect, metric)
            except ComparisonError as error:
                refusals.append(f"{effect.title}: {error}")
                continue
            if found is not None:
                rows.append((effect.title, metric, *_tests(found)))
    return Table((Column("effect"), Column("metric"), *_TEST_COLUMNS), tuple(rows)), refusals


def options_table(points: Sequence[CurvePoint]) -> Table:
    """Summarise an experiment of options: mean and spread over seeds, a row per metric, a column per option."""
    curves = list(dict.fromkeys(point.curve for point in points))
    rows: list[tuple[Cell, ...]] = [
        (metric, *(spread(p.value for p in points if (p.curve, p.metric) == (curve, metric)) for curve in curves))
        for metric in sorted({point.metric for point in points}, key=_metric_rank)
    ]
    return Table((Column("metric"), *map(Column, curves)), tuple(rows))


def options_tests_table(points: Sequence[CurvePoint], metrics: Sequence[str]) -> tuple[Table, list[str]]:
    """Run paired tests of every option against the first one, fused against fused and unfused against unfused.

    Args:
        points: Points of one experiment whose curves are options, see :func:`fus3dmaps_lab.evaluation.curves.option_of`.
        metrics: Compared metrics, if they were measured.

    Returns:
        The table, and the reasons for comparisons that were not possible.
    """
    rows: list[tuple[Cell, ...]] = []
    refusals: list[str] = []
    curves = list(dict.fromkeys(point.curve for point in points))
    for fused in (True, False):
        first, *others = [curve for curve in curves if option_of(curve)[1] == fused] or [""]
        for option, metric in product(others, metrics):
            theirs, ours = (
                {(f"x = {p.x:g},", p.seed): p.value for p in points if (p.curve, p.metric) == (curve, metric)}
                for curve in (first, option)
            )
            if not theirs and not ours:
                continue
            try:
                found = compare(theirs, ours, (f"{metric} of {first}", f"{metric} of {option}"))
            except ComparisonError as error:
                refusals.append(str(error))
            else:
                rows.append((option, first, metric, *_tests(found)))
    columns = (Column("option"), Column("against"), Column("metric"), *_TEST_COLUMNS)
    return Table(columns, tuple(rows)), refusals


def curve_table(points: Sequence[CurvePoint], x_name: str) -> Table:
    """Summarise one experiment: mean and spread over seeds, a row per curve and x, a column per metric.

    Args:
        points: Points of one experiment.
        x_name: Heading of x, with its unit.
    """
    metrics = sorted({point.metric for point in points}, key=_metric_rank)
    cells: dict[tuple[str, float], dict[str, list[float]]] = {}
    order = {curve: i for i, curve in enumerate(dict.fromkeys(point.curve for point in points))}
    for point in points:
        cells.setdefault((point.curve, point.x), {}).setdefault(point.metric, []).append(point.value)
    rows: list[tuple[Cell, ...]] = [
        (curve, x, *(spread(by_metric.get(metric, ())) for metric in metrics))
        for (curve, x), by_metric in sorted(cells.items(), key=lambda item: (order[item[0][0]], item[0][1]))
    ]
    return Table(
        (Column("curve"), Column(x_name, "g"), *(Column(metric, metric_form(metric)) for metric in metrics)), tuple(rows)
    )


def points_table(points: Iterable[CurvePoint]) -> Table:
    """List every point of every curve in a row."""
    columns = ("experiment", "curve", "seed", "x", "metric", "value")
    rows = sorted((p.experiment, p.curve, p.seed, p.x, p.metric, p.value) for p in points)
    return Table(tuple(Column(name) for name in columns), tuple(rows))


def conditions_in(records: Iterable[Record]) -> list[Condition]:
    """List the layers and modes that occur, in the order of LAYERS, then of MODES."""
    present = {(record.layer, record.mode) for record in records}
    ordered = sorted((_rank(LAYERS, layer), _rank(MODES, mode)) for layer, mode in present)
    return [Condition(layer, mode) for (_, layer), (_, mode) in ordered]


def metric_form(metric: str) -> str:
    """Return the format of a metric's numbers: whole numbers for counts and bytes."""
    return ",.0f" if metric in ("bytes", "instances", "voxels") else ".4f"


def _tests(found: PairedComparison) -> tuple[Cell, ...]:
    """Make the cells under _TEST_COLUMNS."""
    return (
        *(found.first, found.second, found.difference, kept(found), f"{found.better} of {found.count}"),
        *(found.t_p, found.wilcoxon_p, found.sign_p),
    )


def _rank(order: Sequence[str], name: str) -> tuple[int, str]:
    return (order.index(name) if name in order else len(order), name)


def _metric_rank(metric: str) -> tuple[int, str]:
    return _rank(("mIoU", "f-mIoU", "accuracy", "mean_accuracy"), metric)


def _parts(cell: Spread) -> list[str | int | float]:
    return [cell.mean, cell.std, cell.minimum, cell.maximum, cell.count]


def _shown(cell: Cell, form: str) -> str:
    if isinstance(cell, str):
        return _escaped(cell)
    if isinstance(cell, Spread):
        if not cell.count:
            return _MISSING
        of = f" (n = {cell.count})" if cell.undefined else ""
        return format(cell.mean, form) + ("" if math.isnan(cell.std) else f" ± {format(cell.std, form.lstrip('+'))}") + of
    if isinstance(cell, int):
        return str(cell)
    return _MISSING if math.isnan(cell) else format(cell, form)


def _escaped(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ")
