"""The command: which cases run, on what, and where the figures go."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import torch
import typer
from pydantic import ValidationError
from rich.console import Console
from typer.exceptions import TyperException

from benchmarks import corridor as corridor_case
from benchmarks import precision as precision_case
from benchmarks import rayfronts as peer
from benchmarks.engine import Run
from benchmarks.measurements import print_tables, write_json
from benchmarks.suite import QUICK_DIMENSIONS, QUICK_SIZES, SIZES, default_dtype, known_dtypes, measure_all, settings
from benchmarks.timing import set_threads, usable_cores
from benchmarks.workload import MIN_VOXELS, World
from fus3dmaps_core.config.schema import MapConfig
from fus3dmaps_core.errors import ConfigError

_SEED = 1

_log = Console(stderr=True, highlight=False)
app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command; a refusal is one line on stderr and exit code 2."""
    try:
        sys.exit(app(arguments, prog_name="bench", standalone_mode=False) or 0)
    except ConfigError as error:
        _refuse(str(error))
    except TyperException as error:  # Whatever the parser refuses, an unknown option among it.
        _refuse(" ".join(error.format_message().split()))
    except (KeyboardInterrupt, typer.Abort):
        sys.exit(130)


@app.command()
def bench(
    quick: Annotated[bool, typer.Option("--quick", help="Small maps and few repeats: within 90 s on 2 cores.")] = False,
    sizes: Annotated[str, typer.Option(help="Voxels of the maps, comma-separated, e.g. 10k,2M.")] = "",
    dimensions: Annotated[str, typer.Option(help="Embedding widths d, comma-separated.")] = "",
    dtypes: Annotated[str, typer.Option(help="Storage types, comma-separated, each at every width.")] = "",
    threads: Annotated[int, typer.Option(help="Threads; 0 takes one for each usable core.")] = 0,
    repeats: Annotated[int, typer.Option(help="Rounds over the keyframes; 0 takes 5, or 3 with --quick.")] = 0,
    device: Annotated[str, typer.Option(help="Torch device of the maps.")] = "cpu",
    backend: Annotated[str, typer.Option(help="Kernels of the maps; empty leaves the choice to the map.")] = "",
    json_file: Annotated[Path | None, typer.Option("--json", help="File that the figures are written to.")] = None,
    rayfronts: Annotated[Path | None, typer.Option(help="Checkout of RayFronts to measure on the same input.")] = None,
    corridor: Annotated[bool, typer.Option("--corridor", help="Only the drive along a corridor.")] = False,
    keyframes: Annotated[int, typer.Option(help="Keyframes of --corridor.")] = 20_000,
    length_m: Annotated[float, typer.Option(help="Length of --corridor, metres.")] = 2000.0,
    precision: Annotated[bool, typer.Option("--precision", help="Only the accuracy of the storage types.")] = False,
) -> None:
    """Time the voxel engine in a synthetic building; median times, one table, JSON beside it on request."""
    voxels = _numbers("--sizes", sizes, MIN_VOXELS) or list(QUICK_SIZES if quick else SIZES)
    widths = _numbers("--dimensions", dimensions, 1)
    types = _dtypes(dtypes)
    cores = usable_cores()
    if not 0 <= threads <= cores:
        raise ConfigError(f"--threads: must lie in [1, {cores}], the usable cores, or be 0, got {threads}")
    if repeats < 0:
        raise ConfigError(f"--repeats: must not be negative, got {repeats}")
    if corridor and not (keyframes >= 500 and length_m > 0):
        raise ConfigError(
            f"--corridor: needs at least 500 keyframes and a length above 0, got {keyframes} and {length_m:g} m"
        )
    if corridor and precision:
        raise ConfigError("--corridor and --precision are runs of their own: choose one")
    _check_map_options(device, backend)
    if rayfronts is not None:
        peer.check_checkout(rayfronts)
    if json_file is not None and not json_file.parent.is_dir():
        raise ConfigError(f"--json {json_file}: there is no folder {json_file.parent}")
    threads = threads or cores
    set_threads(threads)
    world = World(max(*voxels, *(peer.PREFILLED if rayfronts else ()), 0), _SEED)
    run = Run(world, device, backend or None, threads, repeats or (3 if quick else 5), _say)

    if corridor:
        width = widths[0] if widths else corridor_case.DIMENSION
        measured = corridor_case.measure_corridor(run, width, types[0] if types else default_dtype(), keyframes, length_m)
    elif precision:
        measured = []
        for width in widths or QUICK_DIMENSIONS:
            measured += precision_case.measure_precision(run, width, types or known_dtypes())
    else:
        measured = measure_all(run, voxels, settings(widths, types, quick), rayfronts)
    print_tables(measured, Console(highlight=False))
    if json_file is not None:
        try:
            write_json(measured, json_file)
        except OSError as error:
            raise ConfigError(f"--json {json_file}: {error.strerror or error}") from None


def _numbers(option: str, text: str, least: int) -> list[int]:
    """Parse numbers such as 10000, 10k or 2M from a comma-separated list."""
    numbers = []
    for item in (part.strip() for part in text.split(",") if part.strip()):
        digits, factor = (item[:-1], {"k": 1000, "M": 1_000_000}[item[-1]]) if item[-1] in "kM" else (item, 1)
        if not digits.isascii() or not digits.isdigit() or int(digits) * factor < least:
            raise ConfigError(f"{option}: '{item}' is no whole number of at least {least:,}")
        numbers.append(int(digits) * factor)
    return list(dict.fromkeys(numbers))


def _dtypes(text: str) -> list[str]:
    types = [part.strip() for part in text.split(",") if part.strip()]
    for name in types:
        if name not in known_dtypes():
            raise ConfigError(f"--dtypes: unknown storage type '{name}', known are {', '.join(known_dtypes())}")
    return list(dict.fromkeys(types))


def _check_map_options(device: str, backend: str) -> None:
    try:
        torch.zeros(1, device=device)
    except (RuntimeError, AssertionError) as error:
        raise ConfigError(f"--device {device}: {str(error).splitlines()[0]}") from None
    if backend:
        try:
            MapConfig.model_validate({"backend": backend, "device": device})
        except ValidationError as error:
            raise ConfigError(f"--backend {backend}: {error.errors()[0]['msg']}") from None


def _say(text: str) -> None:
    _log.print(f"bench: {text}", markup=False, soft_wrap=True)


def _refuse(text: str) -> None:
    _log.print(f"bench: {text}", markup=False, style="red", soft_wrap=True)
    sys.exit(2)
