"""What a run yields, as JSON and as tables."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from benchmarks.timing import Times, spread

_COLUMNS = ("map_voxels", "d", "dtype")
_COMMON = {"device", "backend", "threads"}
_WIDTH = 150


@dataclass(frozen=True)
class Measurement:
    """One figure.

    Attributes:
        name: What was measured.
        params: What it was measured of; map_voxels, d and dtype wherever they apply.
        value: The figure, a median where there are samples.
        unit: Its unit; "1" for a ratio.
        spread: Smallest, quartiles, largest and number of the samples, in the same unit; empty without samples.
    """

    name: str
    params: Mapping[str, Any]
    value: float
    unit: str
    spread: Mapping[str, float] = field(default_factory=dict)

    def as_json(self) -> dict[str, Any]:
        """Return the figure as an entry of the JSON file."""
        entry = {"name": self.name, "params": dict(self.params), "value": self.value, "unit": self.unit}
        return {**entry, "spread": dict(self.spread)} if self.spread else entry


def timed(name: str, params: Mapping[str, Any], times: Times) -> Measurement:
    """Make a measurement in milliseconds."""
    return Measurement(name, params, times.median_ms, "ms", spread(times.samples_ms))


def write_json(measurements: Sequence[Measurement], path: Path) -> None:
    """Write a list of {name, params, value, unit}.

    Raises:
        OSError: The file cannot be written.
    """
    path.write_text(json.dumps([measurement.as_json() for measurement in measurements], indent=1) + "\n")


def print_tables(measurements: Sequence[Measurement], console: Console) -> None:
    """Print the figures in one table and the ratios between them under it."""
    console.width = max(console.width, _WIDTH)
    table = Table("name", *_COLUMNS, "of what", "value", "unit", "quartiles", title_justify="left")
    for name in ("map_voxels", "d", "value", "quartiles"):
        table.columns[["name", *_COLUMNS, "of what", "value", "unit", "quartiles"].index(name)].justify = "right"
    ratios = Table("ratio", "value", title="ratios", title_justify="left")
    for measurement in measurements:
        if measurement.name == "ratio":
            ratios.add_row(str(measurement.params["of"]), _digits(measurement.value))
            continue
        quartiles = measurement.spread
        table.add_row(
            measurement.name,
            *(_cell(measurement.params.get(column, "")) for column in _COLUMNS),
            ", ".join(_details(measurement.params)),
            _digits(measurement.value),
            measurement.unit,
            f"{_digits(quartiles['q1'])} .. {_digits(quartiles['q3'])}" if "q1" in quartiles else "",
        )
    console.print(table)
    if ratios.row_count:
        console.print(ratios)


def _details(params: Mapping[str, Any]) -> Iterator[str]:
    for key, value in params.items():
        if key not in _COLUMNS and key not in _COMMON:
            yield str(value) if key == "layer" else f"{key} {_cell(value)}"


def _cell(value: object) -> str:
    return f"{value:,}" if isinstance(value, int) and not isinstance(value, bool) else str(value)


def _digits(value: float) -> str:
    if value == 0 or 1e-3 <= abs(value) < 1e4:
        return f"{value:.4g}"
    return f"{value:,.0f}" if abs(value) >= 1e4 else f"{value:.2e}"
