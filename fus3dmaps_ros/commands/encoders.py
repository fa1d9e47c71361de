"""``fus3dmaps encoders``: a list of all encoders, their licences, and which of their parts are installed. Needs no ROS."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from fus3dmaps_core.config.schema import Config
from fus3dmaps_ros.commands.settings import ParamsFile, Settings, configuration
from fus3dmaps_ros.commands.terminal import OUT

if TYPE_CHECKING:
    from fus3dmaps_core.encoders.catalogue import Entry, Part

_HEADINGS = ("name", "d", "λ", "patches", "code", "weights", "installed")


def encoders(
    as_json: Annotated[bool, typer.Option("--json", help="Print a JSON list.")] = False,
    weights: Annotated[str | None, typer.Option("--weights", help="Where weights are; the same as encoder.weights.")] = None,
    params_file: ParamsFile = None,
    settings: Settings = None,
) -> None:
    """List the encoders: their space, their licences, and what of them is installed."""
    config = configuration(params_file, settings)
    if weights is not None:
        config = config.with_values({"encoder.weights": weights})
    list_encoders(config, OUT, as_json=as_json)


def list_encoders(config: Config, console: Console, *, as_json: bool) -> None:
    """Print every encoder trio.

    Args:
        config: Says where weights are, and for which image size patch grids are listed.
        console: Gets the table; JSON goes directly to standard output.
        as_json: Print a JSON list instead of the table.

    Raises:
        EncoderError: ``encoder.weights`` names neither a file or directory nor a repository, or ``encoder.name`` no encoder.
    """
    # These take seconds to import.
    from fus3dmaps_core.encoders import registry
    from fus3dmaps_core.encoders.catalogue import catalogue

    if config.encoder.name not in registry.names():
        registry.card(config.encoder.name)  # Refuses it, with the names that are known.
    entries = catalogue(config.encoder.weights, config.encoder.name)
    size = config.image.height, config.image.width
    if as_json:
        print(json.dumps([as_dict(entry, *size) for entry in entries], indent=1))
        return
    console.print(_table(entries, *size))
    for line in _advice(entries, config):
        console.print(line, markup=False, soft_wrap=True)


def as_dict(entry: Entry, height: int, width: int) -> dict[str, Any]:
    """Return a trio as a JSON object; every trio has every key.

    Args:
        entry: The trio.
        height: Height of the images that the patch grid is for, pixels.
        width: Width of these images, pixels.
    """
    card = entry.card
    return {
        "name": entry.name,
        "summary": card.summary if card else None,
        "dimension": card.dimension if card else None,
        "variance_ratio": card.variance_ratio if card else None,
        "patch_px": card.patch_px if card else None,
        "grid": list(card.grid(height, width)) if card else None,
        "code_licence": card.code_licence if card else None,
        "weights": [_part_as_dict(part) for part in entry.weights],
        "packages": [
            {"name": package.name, "installed": not package.problem, "problem": package.problem or None}
            for package in entry.packages
        ],
        "code": _part_as_dict(entry.code) if entry.code else None,
        "installed": entry.installed,
        "missing": entry.missing,
    }


def _part_as_dict(part: Part) -> dict[str, str | None]:
    return {
        "title": part.title,
        "licence": part.licence or None,
        "source": part.source,
        "path": _text(part.path),
        "put_at": _text(part.put_at),
    }


def _text(path: Path | None) -> str | None:
    return None if path is None else str(path)


def _table(entries: Sequence[Entry], height: int, width: int) -> Table:
    table = Table(
        title=f"encoders, patch grids for {width} x {height} images",
        title_justify="left",
        padding=(0, 1, 0, 0),
        box=SIMPLE_HEAD,
    )
    for heading in _HEADINGS:
        table.add_column(heading, no_wrap=heading in _HEADINGS[:4])
    for entry in entries:
        card, cells = entry.card, [""] * 5
        if card is not None:
            rows, columns = card.grid(height, width)
            licences = dict.fromkeys(part.licence for part in entry.weights)
            cells = [
                str(card.dimension),
                f"{card.variance_ratio:g}",
                f"{rows} x {columns}",
                card.code_licence or "this package's",
                "; ".join(licences) or card.weights_licence,
            ]
        table.add_row(*(escape(cell) for cell in (entry.name, *cells, "yes" if entry.installed else _lacking(entry))))
    return table


def _lacking(entry: Entry) -> str:
    """Say how much of a trio is missing, for the table."""
    counts = {
        "package": sum(bool(package.problem) for package in entry.packages),
        "file": sum(part.path is None for part in entry.weights),
    }
    parts = [f"{count} {what}{'s' if count > 1 else ''}" for what, count in counts.items() if count]
    if entry.code is not None and entry.code.path is None:
        parts.append("code")
    return f"no, lacks {', '.join(parts)}" if parts else "no"


def _advice(entries: Sequence[Entry], config: Config) -> list[str]:
    """Return lines that say what each trio lacks, and what to do about it."""
    lines, extras = [], set()
    for entry in entries:
        packages = [f"{package.name} {package.problem}" for package in entry.packages if package.problem]
        if entry.error or packages:
            lines.append(f"{entry.name}: {entry.error or ', '.join(packages)}")
        if entry.card is not None and (packages or any(part.put_at is None and part.path is None for part in entry.weights)):
            extras.add(entry.card.extra)
    if extras:
        lines.append(f"packages come with: pip install 'fus3dmaps_ros[{','.join(sorted(extras))}]'")
    by_hand: dict[str, list[str]] = {}
    for entry in entries:
        for part in (*entry.weights, *((entry.code,) if entry.code else ())):
            if part.path is None and part.put_at is not None:
                by_hand.setdefault(f"{part.title}: {part.source} -> {part.put_at}", []).append(entry.name)
    if by_hand:
        lines.append("files are downloaded when an encoder is first loaded; without a network there, bring and put them:")
        lines += [f"  {', '.join(names)}: {what}" for what, names in by_hand.items()]
    chosen = config.encoder.name
    return [*lines, f"choose one with --set encoder.name=NAME, or by this parameter of the node; now it is {chosen}"]
