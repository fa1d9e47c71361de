"""The command ``scripts/bench --encoders``: what each vision model costs, one process after the other."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated, Any, cast, get_args

import typer
from rich.console import Console
from typer.exceptions import TyperException

from benchmarks.encoder_tables import print_models, with_ratios
from benchmarks.model_figures import EXPORTING, Job
from benchmarks.timing import usable_cores
from fus3dmaps_core.config.schema import Precision, Runtime
from fus3dmaps_core.encoders import registry as encoders
from fus3dmaps_core.encoders.devices import check_device
from fus3dmaps_core.errors import ConfigError, EncoderError
from fus3dmaps_core.segmenters import registry as segmenters

_NONE = "none"
_RANDOM, _INSTALLED = "random", "installed"

_log = Console(stderr=True, highlight=False)
app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command; a refusal is one line on stderr and exit code 2, a model that failed is exit code 1."""
    try:
        sys.exit(app(arguments, prog_name="bench --encoders", standalone_mode=False) or 0)
    except (ConfigError, EncoderError) as error:
        _refuse(str(error))
    except TyperException as error:  # Whatever the parser refuses, an unknown option among it.
        _refuse(" ".join(error.format_message().split()))
    except (KeyboardInterrupt, typer.Abort):
        sys.exit(130)


@app.command()
def bench(
    trios: Annotated[str, typer.Option(help="Encoder trios, comma-separated, or none.")] = ",".join(encoders.names()),
    segmenter_names: Annotated[
        str, typer.Option("--segmenters", help="Segmenters without a file, comma-separated, or none.")
    ] = "lite,sam2",
    fastsam: Annotated[
        list[Path] | None, typer.Option(help="FastSAM's exported network; may be given more than once.")
    ] = None,
    weights: Annotated[
        str, typer.Option(help="random, of the true size; installed; or a directory with a folder for each model's name.")
    ] = _RANDOM,
    device: Annotated[str, typer.Option(help="Torch device, e.g. cpu or cuda:0.")] = "cpu",
    runtime: Annotated[str, typer.Option(help=f"What runs the image networks: {', '.join(get_args(Runtime))}.")] = "torch",
    precision: Annotated[str, typer.Option(help=f"Of TensorRT engines: {', '.join(get_args(Precision))}.")] = "fp16",
    height: Annotated[int, typer.Option(help="Of a frame, pixels.")] = 480,
    width: Annotated[int, typer.Option(help="Of a frame, pixels.")] = 640,
    repeats: Annotated[int, typer.Option(help="Samples of a figure, at most.")] = 5,
    budget_s: Annotated[float, typer.Option(help="What these samples may take together, about, seconds.")] = 12.0,
    threads: Annotated[int, typer.Option(help="Threads; 0 takes one for each usable core.")] = 0,
    json_file: Annotated[Path | None, typer.Option("--json", help="File that the figures are written to.")] = None,
) -> int:
    """Measure size, work, time and memory of each vision model at a frame's size; one table, JSON beside it on request.

    Random weights are made in a scratch directory (TMPDIR), up to 3 GB at once, and are gone afterwards.
    """
    known_segmenters = [name for name in segmenters.names() if name != "fastsam"]  # Which --fastsam is for.
    models = [("trio", name, "") for name in _names("--trios", trios, encoders.names())]
    models += [("segmenter", name, "") for name in _names("--segmenters", segmenter_names, known_segmenters)]
    models += [("segmenter", "fastsam", str(path.resolve())) for path in fastsam or ()]
    cores = usable_cores()
    if not 0 <= threads <= cores:
        raise ConfigError(f"--threads: must lie in [1, {cores}], the usable cores, or be 0, got {threads}")
    for option, value, least in (("--repeats", repeats, 1), ("--height", height, 32), ("--width", width, 32)):
        if value < least:
            raise ConfigError(f"{option}: must be at least {least}, got {value}")
    if not budget_s > 0:
        raise ConfigError(f"--budget-s: must be above 0, got {budget_s:g}")
    _check_choice("--runtime", runtime, get_args(Runtime))
    _check_choice("--precision", precision, get_args(Precision))
    if weights not in (_RANDOM, _INSTALLED) and not Path(weights).is_dir():
        raise ConfigError(f"--weights {weights}: is neither random, installed nor a directory")
    if json_file is not None and not json_file.parent.is_dir():
        raise ConfigError(f"--json {json_file}: there is no folder {json_file.parent}")
    check_device(device)

    figures = []
    for kind, name, file in models:
        job = Job(
            kind=kind,
            name=name,
            device=device,
            runtime=cast(Runtime, runtime),
            precision=cast(Precision, precision),
            threads=threads or cores,
            height=height,
            width=width,
            repeats=repeats,
            budget_s=budget_s,
            weights=file or _weights_of(name, weights),
            random=weights == _RANDOM and not file,
            folder="",
        )
        figures.append(measure_apart(job))
    figures = with_ratios(figures)
    print_models(figures, Console(highlight=False))
    if json_file is not None:
        try:
            json_file.write_text(json.dumps(figures, indent=1) + "\n")
        except OSError as error:
            raise ConfigError(f"--json {json_file}: {error.strerror or error}") from None
    return int(any("problem" in model for model in figures))


def measure_apart(job: Job) -> dict[str, Any]:
    """Prepare and measure a model in two processes.

    Args:
        job: What is measured; its folder is made here.

    Returns:
        Figures by name, see :class:`benchmarks.model_figures.ModelFigures`; or kind, name and problem.
    """
    with tempfile.TemporaryDirectory(prefix="fus3dmaps-bench-") as folder:
        job = replace(job, folder=folder)
        prepared: dict[str, Any] = {}
        if _needs_preparing(job):
            _say(f"{job.kind} {job.name}: preparing")
            prepared = _run("prepare", job)
        if "problem" not in prepared:
            _say(f"{job.kind} {job.name}: measuring")
            prepared = _run("measure", replace(job, **prepared))
    return {"kind": job.kind, "name": job.name} | prepared


def _needs_preparing(job: Job) -> bool:
    """Tell whether there are weights to be made or looked for, or graphs to be exported."""
    if job.kind == "segmenter":
        return job.random and job.name == "sam2"
    return job.name != "lite" or job.runtime in EXPORTING


def _run(task: str, job: Job) -> dict[str, Any]:
    job_file, result = (Path(job.folder) / f"{task}.{what}.json" for what in ("job", "result"))
    job_file.write_text(json.dumps(asdict(job)))
    command = [sys.executable, "-P", "-m", "benchmarks.model_process", task, str(job_file), str(result)]
    code = subprocess.run(command, check=False).returncode
    if result.is_file():
        return dict(json.loads(result.read_text()))
    how = (
        f"ended by {signal.Signals(-code).name}, which is what happens for want of memory"
        if code < 0
        else f"exit code {code}"
    )
    return {"problem": f"its process failed to {task} it: {how}"}


def _weights_of(name: str, weights: str) -> str:
    """Return the value of ``encoder.weights`` or ``segmenter.weights`` for a model."""
    if weights in (_RANDOM, _INSTALLED) or name == "lite":  # Which pip brings.
        return ""
    folder = Path(weights).resolve()
    return str(folder / name if (folder / name).is_dir() else folder)


def _names(option: str, text: str, known: Sequence[str]) -> list[str]:
    names = [part.strip() for part in text.split(",") if part.strip() and part.strip() != _NONE]
    for name in names:
        _check_choice(option, name, known)
    return list(dict.fromkeys(names))


def _check_choice(option: str, value: str, known: Sequence[str]) -> None:
    if value not in known:
        raise ConfigError(f"{option}: unknown '{value}', known are {', '.join(known)}")


def _say(text: str) -> None:
    _log.print(f"bench: {text}", markup=False, soft_wrap=True)


def _refuse(text: str) -> None:
    _log.print(f"bench: {text}", markup=False, style="red", soft_wrap=True)
    sys.exit(2)


if __name__ == "__main__":
    main()
