"""``fus3dmaps evaluate``: quality figures of simulated buildings or a published dataset. Needs no ROS."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from fus3dmaps_core.config.schema import Config
from fus3dmaps_core.errors import ConfigError
from fus3dmaps_ros.commands.settings import DatasetOptions, ParamsFile, Settings, configuration, pairs
from fus3dmaps_ros.commands.terminal import OUT, progress

if TYPE_CHECKING:
    from fus3dmaps_lab.evaluation.records import CurvePoint, Record

SIMULATION = "simulation"
_SIMULATED = (
    "encoder.instance_embeddings",
    "segmenter.min_area_px",
    "segmenter.max_border_contact",
    "segmenter.max_masks",
    "keyframes.",
    "sampling.",
    "map.",
    "fusion.",
)
"""Keys, or their beginnings, of the parameters that have an effect on simulated buildings."""
_HEADLINE = ("mIoU", "f-mIoU", "accuracy")

Progress = Callable[[str], AbstractContextManager[Callable[[int, int], None]]]
"""Shows a progress bar with this label."""


@dataclass(frozen=True)
class Evaluation:
    """What to evaluate.

    Attributes:
        target: ``simulation``, or a dataset's layout.
        directory: The dataset's folder; None for the simulation.
        seeds: How many buildings are simulated.
        quick: Smaller buildings, and no sweeps in the report.
        jobs: How many buildings are studied at once; 0 for as many as there are processors.
        options: Options of the dataset, e.g. its scene.
    """

    target: str
    directory: Path | None
    seeds: int
    quick: bool
    jobs: int
    options: Mapping[str, str]


@dataclass(frozen=True)
class Destination:
    """Where the results go.

    Attributes:
        json_file: File of the records; None for no file.
        report: Directory of the report; None for no report.
        console: Shows the headline figures.
    """

    json_file: Path | None
    report: Path | None
    console: Console


def evaluate(
    target: Annotated[str, typer.Argument(help="simulation, or a dataset's layout as for convert.")] = "simulation",
    directory: Annotated[Path | None, typer.Argument(help="The dataset's folder.")] = None,
    seeds: Annotated[int, typer.Option("--seeds", min=1, help="How many buildings are simulated.")] = 5,
    quick: Annotated[bool, typer.Option("--quick", help="Smaller buildings, no sweeps.")] = False,
    jobs: Annotated[int, typer.Option("--jobs", min=0, help="Buildings at once; 0: one for each processor.")] = 0,
    json_file: Annotated[Path | None, typer.Option("--json", help="Write a JSON list of records to this file.")] = None,
    report: Annotated[Path | None, typer.Option("--report", help="Write tables and plots into this directory.")] = None,
    options: DatasetOptions = None,
    params_file: ParamsFile = None,
    settings: Settings = None,
) -> None:
    """Measure how good maps are: on simulated buildings, or on a labelled dataset."""
    request = Evaluation(target, directory, seeds, quick, jobs, pairs("--option", options))
    evaluate_target(request, configuration(params_file, settings), Destination(json_file, report, OUT), progress)


def evaluate_target(request: Evaluation, config: Config, destination: Destination, progress: Progress) -> None:
    """Evaluate, print the headline figures and write what was asked for.

    Args:
        request: What to evaluate.
        config: Parameters of the maps; simulated buildings bring their own models, images and topics.
        destination: Where the results go.
        progress: Shows progress bars.

    Raises:
        ConfigError: A dataset has no directory, the simulation has one or is given a parameter that has no effect on it, or
            the package for plots is missing.
        StorageError: A file cannot be written.
    """
    from fus3dmaps_lab.evaluation.records import write_records

    if (request.target == SIMULATION) != (request.directory is None):
        raise ConfigError(
            f"evaluate {request.target}: "
            + ("takes no directory, it makes its buildings" if request.directory else "the dataset's directory is missing")
        )
    if destination.report is not None and find_spec("matplotlib") is None:
        raise ConfigError("--report: plots need matplotlib; install the extra: pip install 'fus3dmaps_ros[evaluation]'")
    if request.directory is None:
        records, points = _simulate(request, _of_maps(config), destination.report is not None, progress)
        notes = {"encoders": "simulated"}
    else:
        records, points = _map_dataset(request, request.directory, config, progress), []
        notes = {"encoders": f"{config.encoder.name}, segmenter {config.segmenter.name}"}
    destination.console.print(_headline(records))
    if destination.json_file is not None:
        write_records(destination.json_file, records)
    if destination.report is not None:
        from fus3dmaps_lab.evaluation.report import write_report

        notes["command"] = shlex.join(["fus3dmaps", *sys.argv[1:]])
        page = write_report(destination.report, records, points, notes)
        destination.console.print(f"report: {page}", markup=False, soft_wrap=True)


def _of_maps(config: Config) -> dict[str, Any]:
    """Return the values that differ from their default; refuse those with no effect on simulated buildings."""
    defaults = Config().flat()
    changed = {key: value for key, value in config.flat().items() if value != defaults[key]}
    for key in changed:
        if not key.startswith(_SIMULATED):
            raise ConfigError(f"evaluate simulation: parameter '{key}' has no effect on simulated buildings")
    return changed


def _simulate(
    request: Evaluation, settings: Mapping[str, Any], with_sweeps: bool, progress: Progress
) -> tuple[list[Record], list[CurvePoint]]:
    from fus3dmaps_lab.evaluation import simulation_runs as runs
    from fus3dmaps_lab.evaluation.memory_study import MemoryStudy

    study = runs.QUICK if request.quick else runs.WHOLE if with_sweeps else runs.MODES_ONLY
    study = replace(study, settings=settings)
    with progress("studying buildings") as update:
        records, points = runs.study_seeds(study, range(request.seeds), request.jobs, update)
    if with_sweeps and not request.quick:
        with progress("measuring memory") as update:
            points = [*points, *runs.memory_of(MemoryStudy(), range(1), on_progress=update)]
    return records, points


def _map_dataset(request: Evaluation, directory: Path, config: Config, progress: Progress) -> list[Record]:
    from fus3dmaps_lab.datasets.registry import open_labelled
    from fus3dmaps_lab.evaluation.dataset_runs import evaluate_dataset

    dataset = open_labelled(request.target, directory, **request.options)
    with progress(f"mapping {dataset.scene}") as update:
        return evaluate_dataset(dataset, config, update)


def _headline(records: Sequence[Record]) -> Table:
    from fus3dmaps_lab.evaluation.statistics import spread

    scenes = sorted({record.scene for record in records})
    table = Table(
        title=f"{', '.join(scenes)}, without background classes", title_justify="left", padding=(0, 1, 0, 0), box=SIMPLE_HEAD
    )
    for heading in ("layer", "mode", *_HEADLINE):
        table.add_column(heading, no_wrap=True)
    for layer, mode in dict.fromkeys((record.layer, record.mode) for record in records):
        cells = []
        for metric in _HEADLINE:
            values = [r.value for r in records if (r.layer, r.mode, r.metric) == (layer, mode, metric)]
            found = spread(values)
            cells.append(f"{found.mean:.3f} ± {found.std:.3f}" if found.count > 1 else f"{found.mean:.3f}")
        table.add_row(layer, mode, *cells)
    return table
