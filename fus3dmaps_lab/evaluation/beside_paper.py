"""Tables with our numbers beside the paper's. Each row says whose it is and what it was measured on.

A simulation has no scene, sensor or model in common with the paper. So only effects (a difference, a share kept) are
compared with those of the paper; scores are compared only on the paper's own datasets.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from fus3dmaps_lab.evaluation.curves import bytes_at_the_end
from fus3dmaps_lab.evaluation.effects import (
    FUSED_DENSE,
    OTHER,
    SIMULATION,
    WITH_BACKGROUND,
    Effect,
    compare_effect,
    group_of,
    paper_scene,
    values_of,
)
from fus3dmaps_lab.evaluation.paper_tables import CLIP_DINOISER, NARADIO, PAPER_ROWS, SCENES, PaperRow
from fus3dmaps_lab.evaluation.records import CurvePoint, Record
from fus3dmaps_lab.evaluation.statistics import ComparisonError, kept, spread
from fus3dmaps_lab.evaluation.tables import Cell, Column, Table, conditions_in

PAPER_METRICS = ("mIoU", "f-mIoU", "accuracy")
"""Metrics that the paper reports, without background classes."""

_Key = tuple[str, str, str, str, str]


def effect_table(records: Sequence[Record], effect: Effect, encoders: str) -> Table:
    """Make the table of one effect here and in the paper: the difference, and the share of the first value that is kept.

    Both values are shown as well, except for a simulation.

    Args:
        records: Records of one group (see ``effects.group_of``).
        effect: The effect.
        encoders: Name of the encoders of the records.
    """
    metrics: tuple[str, ...] = PAPER_METRICS
    if effect == FUSED_DENSE:
        metrics = (*metrics, *(metric + WITH_BACKGROUND for metric in PAPER_METRICS))
    with_scores = not records or group_of(records[0].scene) != SIMULATION
    rows: list[tuple[Cell, ...]] = []
    for metric in metrics:
        try:
            ours = compare_effect(records, effect, metric)
        except ComparisonError:
            continue  # The table of paired tests says why.
        if ours is not None:
            scores = (ours.first, ours.second) if with_scores else ()
            rows.append((*_whose(records), encoders, metric, *scores, ours.difference, kept(ours)))
    for (dataset, method, metric), (first, second) in paper_effect(effect).items():
        scores = (spread([first]), spread([second])) if with_scores else ()
        difference = spread([second - first])
        rows.append(("paper", dataset, method.partition(", ")[2], metric, *scores, difference, 100 * second / first))
    rows.sort(key=lambda row: metrics.index(str(row[3])))
    conditions = (str(effect.first), str(effect.second)) if with_scores else ()
    return Table(
        (
            *map(Column, ("source", "data", "encoders", "metric", *conditions)),
            Column("difference", "+.4f"),
            Column("second / first, %", ".1f"),
        ),
        tuple(rows),
    )


def paper_effect(effect: Effect) -> dict[tuple[str, str, str], tuple[float, float]]:
    """Return the paper's values under both conditions of an effect, by dataset, method and our name of the metric."""
    values = {_key(row): row.value for row in PAPER_ROWS if row.method in (NARADIO, CLIP_DINOISER) and row.table != "lambda"}
    found = {}
    for (dataset, method, layer, mode, metric), first in values.items():
        if (layer, mode) == (effect.first.layer, effect.first.mode):
            second = values.get((dataset, method, effect.second.layer, effect.second.mode, metric))
            if second is not None and metric.removesuffix(WITH_BACKGROUND) in PAPER_METRICS:
                found[dataset, method, metric] = (first, second)
    return found


def results_table(records: Sequence[Record], dataset: str, encoders: str) -> Table:
    """Make the table of scores on one of the paper's datasets: ours, averaged over the scenes run, and all of the paper.

    Args:
        records: Records of that dataset.
        dataset: Its name in the paper's tables.
        encoders: Name of the encoders of the records.
    """
    metrics = (*PAPER_METRICS, *(metric + WITH_BACKGROUND for metric in PAPER_METRICS))
    source, data = _whose(records)
    rows: list[tuple[Cell, ...]] = []
    for condition in conditions_in(records):
        means = [spread(values_of(records, condition, metric).values()).mean for metric in metrics]
        rows.append((source, data, encoders, condition.layer, condition.mode, *means))
    theirs: dict[tuple[str, str, str], dict[str, float]] = {}
    for row in PAPER_ROWS:
        if row.dataset == dataset and row.metric in PAPER_METRICS:
            _, method, layer, mode, metric = _key(row)
            theirs.setdefault((method, layer, mode), {})[metric] = row.value
    for (method, layer, mode), values in theirs.items():
        rows.append(("paper", dataset, method, layer, mode, *(values.get(metric, math.nan) for metric in metrics)))
    return Table(tuple(map(Column, ("source", "data", "method", "layer", "mode", *metrics))), tuple(rows))


def lambda_table(points: Sequence[CurvePoint], metric: str = "mIoU") -> Table:
    """Make the table that shows how flat the optimum of lambda is: each value in percent of the best one of its row.

    Args:
        points: Points of the experiment ``lambda``.
        metric: One of its metrics.
    """
    sweeps: dict[tuple[str, str], dict[float, list[float]]] = {}
    for point in points:
        if point.metric == metric:
            sweeps.setdefault(("ours, simulation", point.curve), {}).setdefault(point.x, []).append(point.value)
    for row in PAPER_ROWS:
        if row.table == "lambda" and row.metric == metric and row.variance_ratio is not None:
            sweeps.setdefault((f"paper, {row.dataset}", row.method), {})[row.variance_ratio] = [row.value]
    lambdas = sorted({x for sweep in sweeps.values() for x in sweep})
    rows: list[tuple[Cell, ...]] = []
    for (source, curve), sweep in sweeps.items():
        means = {x: spread(values).mean for x, values in sweep.items()}
        best = max((mean for mean in means.values() if not math.isnan(mean)), default=math.nan)
        rows.append((source, curve, *(100 * means.get(x, math.nan) / best if best else math.nan for x in lambdas)))
    return Table(
        (Column("source"), Column("curve"), *(Column(f"lambda = {x:g}", ".1f") for x in lambdas)),
        tuple(rows),
    )


def memory_table(points: Sequence[CurvePoint]) -> Table:
    """Make the table of the window's share of the dense map's memory: ours at a seed's largest volume, the paper's by scene.

    Args:
        points: Points of the experiment ``memory``; curves other than ``dense map`` and ``sliding window`` are left out.
    """
    rows: list[tuple[Cell, ...]] = [
        ("ours, simulation", f"seed {seed}, {volume_m3:,.0f} m³", "simulated", 100 * window / dense if dense else math.nan)
        for seed, (volume_m3, dense, window) in bytes_at_the_end(points).items()
    ]
    sizes = {(row.dataset, row.method, row.mode): row.value for row in PAPER_ROWS if row.table == "memory"}
    rows += [
        ("paper", scene, method.partition(", ")[2], 100 * sizes[scene, method, "window"] / dense)
        for (scene, method, mode), dense in sizes.items()
        if mode == "full"
    ]
    return Table((*map(Column, ("source", "data", "encoders")), Column("window / dense map, %", ".1f")), tuple(rows))


def _key(row: PaperRow) -> _Key:
    """Return dataset, method, layer, mode and our name of the metric."""
    return row.dataset, row.method, row.layer, row.mode, row.metric + (WITH_BACKGROUND if row.background else "")


def _whose(records: Sequence[Record]) -> tuple[str, str]:
    """Return source and data of our own rows, named so that they cannot be mistaken for the paper's."""
    group = group_of(records[0].scene)
    scenes = sorted({record.scene for record in records})
    seeds = len({(record.scene, record.seed) for record in records})
    if group == SIMULATION:
        return "ours, simulation", f"{', '.join(scenes)}; {seeds} {'run' if seeds == 1 else 'runs'}"
    if group == OTHER:
        return "ours", ", ".join(scenes)
    ran = {paper_scene(scene) for scene in scenes}
    return "ours", group if len(ran) == len(SCENES[group]) else f"{group}, {len(ran)} of its {len(SCENES[group])} scenes"
