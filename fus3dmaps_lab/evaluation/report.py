"""The report of an evaluation: one page of Markdown with verdicts, tables and plots, and the same tables as CSV."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from matplotlib.figure import Figure

from fus3dmaps_core.errors import StorageError
from fus3dmaps_lab.evaluation import plots
from fus3dmaps_lab.evaluation.beside_paper import effect_table, lambda_table, memory_table, results_table
from fus3dmaps_lab.evaluation.curves import metric_words
from fus3dmaps_lab.evaluation.effects import EFFECTS, HEADLINE_METRICS, OTHER, SIMULATION, grouped, metrics_in
from fus3dmaps_lab.evaluation.paper_tables import SCENES
from fus3dmaps_lab.evaluation.records import CurvePoint, Record
from fus3dmaps_lab.evaluation.tables import (
    Table,
    comparison_table,
    curve_table,
    metrics_table,
    options_table,
    options_tests_table,
    points_table,
    records_table,
    scores_table,
    summary_table,
)
from fus3dmaps_lab.evaluation.verdicts import (
    Verdict,
    association_verdict,
    effect_verdicts,
    lambda_verdict,
    memory_verdicts,
)

PAGE = "report.md"
"""File name of the page."""

_TEMPORARY_SUFFIX = ".writing"
_MOST_ROWS = 80
_LAMBDA_METRICS = ("mIoU", "fused_dense/mIoU", "cosine", "fused_dense/cosine")
_OPTION_METRICS = (
    *("mIoU", "f-mIoU", "accuracy", "mean_accuracy", "AP25", "AP50", "over_segmentation", "under_segmentation"),
    *("precision@1", "localised", "instances"),
)
_WARNING = (
    "Every number of this section is from a simulation, whose encoders and segmenter have stated statistics. It shows how "
    "the map behaves under them. It is no result on any dataset and cannot be compared with the paper's scores. What the "
    "paper found a change to do, on its datasets, stands beside what the same change does here."
)


@dataclass(frozen=True)
class _Experiment:
    """The section of the report on one experiment.

    Attributes:
        name: Name in the curve points and of its note.
        title: Title of the section.
        x_name: Name of x with its unit.
        shows: Caption of the plot.
        plot: Draws the plot.
        verdicts: Computes the verdicts.
        beside: Makes the table with the paper's numbers, if the paper has any.
        options: Whether its curves are options, each compared with the first one.
        more: Draws plots of other metrics.
    """

    name: str
    title: str
    x_name: str
    shows: str
    plot: Callable[[Sequence[CurvePoint]], Figure | None]
    verdicts: Callable[[Sequence[CurvePoint]], list[Verdict]]
    beside: Callable[[Sequence[CurvePoint]], Table] | None = None
    options: bool = False
    more: Mapping[str, Callable[[Sequence[CurvePoint]], Figure | None]] = field(default_factory=dict)


def _of_one(verdict: Verdict | None) -> list[Verdict]:
    return [verdict] if verdict else []


def _lambda_experiment(
    name: str, title: str, model: str, beside: Callable[[Sequence[CurvePoint]], Table] | None = None
) -> _Experiment:
    return _Experiment(
        name,
        title,
        "lambda",
        f"{model} A panel for every ratio of the encoders' noise variances. Theory predicts the best lambda at that ratio "
        "(dashed); the star marks the best one of those evaluated.",
        plots.lambda_plot,
        lambda points: [verdict for metric in _LAMBDA_METRICS for verdict in _of_one(lambda_verdict(points, metric))],
        beside,
        more={metric: partial(plots.lambda_plot, metric=metric) for metric in _LAMBDA_METRICS[1:]},
    )


_EXPERIMENTS = (
    _lambda_experiment(
        "lambda",
        "Lambda",
        "Every counted observation has noise of its own, as the fusion formula assumes: the more points of a mask are "
        "counted, the less noise its crop has.",
        lambda_table,
    ),
    _lambda_experiment(
        "lambda_per_embedding",
        "Lambda, noise of every embedding",
        "Every patch and every crop has noise of its own, however often the map counts it, which the formula does not know.",
    ),
    _Experiment(
        "memory",
        "Memory",
        "mapped volume, m³",
        "Bytes of the map against the volume of its voxels. The dashed line is what bytes per voxel predict of a dense map.",
        plots.memory_plot,
        memory_verdicts,
        memory_table,
    ),
    _Experiment(
        "window_radius",
        "Radius of the sliding window",
        "radius, m",
        "Accuracy against the radius within which dense embeddings are kept.",
        plots.window_plot,
        lambda points: [],
    ),
    _Experiment(
        "association",
        "Association of proposals with instances",
        "x",
        "Accuracy, quality of instances and their number for every way to associate.",
        plots.association_plot,
        lambda points: _of_one(association_verdict(points)),
        options=True,
    ),
)


@dataclass
class _Report:
    """The report before it is written: lines of the page, and the files that it refers to."""

    page: list[str] = field(default_factory=list)
    verdicts: list[str] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)
    files: dict[str, bytes] = field(default_factory=dict)

    def say(self, *paragraphs: str) -> None:
        for paragraph in paragraphs:
            self.page += [paragraph, ""]

    def note(self, notes: Mapping[str, str], name: str) -> None:
        if notes.get(name):
            self.say(notes[name].strip())

    def table(self, name: str, table: Table) -> None:
        """Add a table as CSV file, and show it on the page if it is short enough."""
        self.files[f"{name}.csv"] = table.csv().encode()
        if len(table.rows) > _MOST_ROWS:
            self.say(f"{len(table.rows)} rows in [{name}.csv]({name}.csv).")
        else:
            self.say(table.markdown().rstrip("\n"), f"The same as [{name}.csv]({name}.csv).")

    def plot(self, name: str, figure: Figure | None, shows: str) -> bool:
        """Add a plot; return False if there is nothing to draw."""
        if figure is None:
            return False
        self.files[f"{name}.png"] = plots.image_bytes(figure)
        self.say(f"![{shows}]({name}.png)", f"*{shows}*")
        return True


def write_report(directory: Path, records: Sequence[Record], points: Sequence[CurvePoint], notes: Mapping[str, str]) -> Path:
    """Write report.md with the CSV tables and PNG plots that it shows.

    Every file is written under another name and then renamed, so it is complete or missing. The page comes last. Other files
    in the directory stay.

    Args:
        directory: Where to write; made if missing.
        records: Results of maps.
        points: Curve points of the experiments.
        notes: Notes by name. ``command`` is the command that made the results, ``encoders`` the name of the encoders. A note
            with the name of a group (``simulation``, ``other recordings``, a dataset), an effect (``instances``, ``dense``,
            ``window``, ``evidence``) or an experiment is shown there; any other is shown with its name at the top.

    Returns:
        Path of the page.

    Raises:
        ComparisonError: Two records have the same scene, seed, layer, mode and metric.
        StorageError: The directory cannot be made or written to, for example because the disk is full.
    """
    report = _Report()
    groups = grouped(records)
    for group, members in groups.items():
        _add_group(report, group, members, notes)
    if not records:
        report.left_out.append("Scores of maps: there are no records.")
    elif SIMULATION not in groups:
        report.left_out.append("Simulation: no record is of a simulated scene.")
    report.left_out += [f"{dataset}: no record is of one of its scenes." for dataset in SCENES if dataset not in groups]
    for experiment in _EXPERIMENTS:
        _add_experiment(report, experiment, [p for p in points if p.experiment == experiment.name], notes)
    known = {experiment.name for experiment in _EXPERIMENTS}
    report.left_out += [
        f"{name}: no such experiment is known here; its points are in points.csv."
        for name in sorted({point.experiment for point in points} - known)
    ]
    if records:
        report.files["records.csv"] = records_table(records).csv().encode()
    if points:
        report.files["points.csv"] = points_table(points).csv().encode()
    page = "\n".join([*_head(report, notes), *report.page, *_tail(report)])
    _write(directory, {**report.files, PAGE: f"{page.rstrip()}\n".encode()})
    return directory / PAGE


def _head(report: _Report, notes: Mapping[str, str]) -> list[str]:
    sections = {*SCENES, SIMULATION, OTHER, *(effect.name for effect in EFFECTS), *(one.name for one in _EXPERIMENTS)}
    lines = ["# Evaluation", ""]
    if notes.get("command"):
        lines += ["Made by", "", "```sh", notes["command"].strip(), "```", ""]
    others = [f"- {name}: {text.strip()}" for name, text in notes.items() if name != "command" and name not in sections]
    lines += [*others, *([""] if others else [])]
    lines += ["## What the data say", ""]
    lines += report.verdicts or ["Nothing here decides any claim."]
    return [*lines, ""]


def _tail(report: _Report) -> list[str]:
    lines = ["## Left out", "", *(f"- {line}" for line in report.left_out), ""] if report.left_out else []
    files = [name for name in ("records.csv", "points.csv") if name in report.files]
    if files:
        lines += ["Every number: " + ", ".join(f"[{name}]({name})" for name in files) + ".", ""]
    return lines


def _add_group(report: _Report, group: str, records: Sequence[Record], notes: Mapping[str, str]) -> None:
    prefix = group.lower().replace(" ", "_")
    simulated = group == SIMULATION
    encoders = "simulated" if simulated else notes.get("encoders", "not stated")
    headline = [metric for metric in metrics_in(records) if metric in HEADLINE_METRICS]
    others = [metric for metric in metrics_in(records) if metric not in HEADLINE_METRICS]
    report.verdicts += [f"- {group.capitalize() if simulated else group}, {verdict}" for verdict in effect_verdicts(records)]
    report.say(f"## {'Simulation' if simulated else group}")
    if simulated:
        report.say(_WARNING)
    report.note(notes, group)
    report.say("### Scores", "Mean and standard deviation over seeds and scenes.")
    report.table(f"{prefix}_scores", summary_table(records, headline))
    if others:
        report.say("### Beyond the paper's metrics")
        report.table(f"{prefix}_other_metrics", metrics_table(records, others))
    tests, refusals = comparison_table(records, headline)
    if tests.rows:
        report.say("### Paired tests", "Pairs are of equal scene and seed; tests are two-sided.")
        report.table(f"{prefix}_tests", tests)
    report.left_out += [f"{group}: {refusal}." for refusal in refusals]
    if group in SCENES:
        report.say("### Beside the paper")
        report.table(f"{prefix}_beside_paper", results_table(records, group, encoders))
    for effect in EFFECTS:
        table = effect_table(records, effect, encoders)
        if not any(str(row[0]).startswith("ours") for row in table.rows):
            report.left_out.append(f"{group}, {effect.title}: not measured.")
            continue
        report.say(f"### {effect.title.capitalize()}")
        report.note(notes, effect.name)
        report.table(f"{prefix}_{effect.name}", table)
        shows = f"IoU of every class, {effect.title}{' (simulation)' if simulated else ''}; lines are standard deviations."
        if not report.plot(f"{prefix}_{effect.name}_classes", plots.class_plot(records, effect), shows):
            report.left_out.append(f"{group}, {effect.title}: no IoU of a class under both conditions, so none is drawn.")
    report.say("### Every scene and seed")
    report.table(f"{prefix}_every", scores_table(records, headline))


def _add_experiment(
    report: _Report, experiment: _Experiment, points: Sequence[CurvePoint], notes: Mapping[str, str]
) -> None:
    if not points:
        report.left_out.append(f"{experiment.title}: there are no points of this experiment.")
        return
    report.verdicts += [f"- {experiment.title} (simulation), {verdict}" for verdict in experiment.verdicts(points)]
    report.say(f"## {experiment.title} (simulation)")
    report.note(notes, experiment.name)
    if not report.plot(experiment.name, experiment.plot(points), experiment.shows):
        report.left_out.append(f"{experiment.title}: none of its metrics is one that is drawn.")
    for metric, plot in experiment.more.items():
        report.plot(f"{experiment.name}_{metric.replace('/', '_')}", plot(points), f"The same for {metric_words(metric)}.")
    report.table(experiment.name, options_table(points) if experiment.options else curve_table(points, experiment.x_name))
    if experiment.options:
        tests, refusals = options_tests_table(points, _OPTION_METRICS)
        report.left_out += [f"{experiment.title}: {refusal}." for refusal in refusals]
        if tests.rows:
            report.say("### Paired tests against the first one", "Pairs are of equal seed; tests are two-sided.")
            report.table(f"{experiment.name}_tests", tests)
    if experiment.beside:
        report.say("Beside what the paper found on its datasets:")
        report.table(f"{experiment.name}_beside_paper", experiment.beside(points))


def _write(directory: Path, files: Mapping[str, bytes]) -> None:
    path = directory
    try:
        directory.mkdir(parents=True, exist_ok=True)
        for name, content in files.items():
            path = directory / name
            temporary = directory / f".{name}{_TEMPORARY_SUFFIX}"
            try:
                with temporary.open("wb") as file:
                    file.write(content)
                    file.flush()
                    os.fsync(file.fileno())
                temporary.replace(path)
            except OSError:
                with suppress(OSError):
                    temporary.unlink()
                raise
    except OSError as error:
        raise StorageError(f"the report cannot be written to {path}: {error.strerror or error}") from error
