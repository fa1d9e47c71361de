"""Results of an evaluation as flat records, and the files they are kept in."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from fus3dmaps_core.errors import StorageError

LAYERS = ("dense", "fused_dense", "instances", "fused_instances")
"""Layers that are evaluated."""

MODES = ("full", "window", "window_no_evidence")
"""Whole dense layer; sliding window; sliding window whose fused embeddings are replaced whatever their evidence."""


@dataclass(frozen=True)
class Record:
    """One number of one map.

    Attributes:
        scene: Scene, e.g. ``building`` or ``room0``; what is simulated says so in its name.
        seed: Seed of a simulation, 0 for recorded scenes.
        layer: One of LAYERS.
        mode: One of MODES.
        metric: ``mIoU``, ``f-mIoU``, ``accuracy`` (share of voxels right), ``mean_accuracy`` (mean over classes), the same
            with ``_with_background``; ``iou/NAME`` of a class; others as their modules name them.
        value: The number; NaN where it is undefined.
    """

    scene: str
    seed: int
    layer: str
    mode: str
    metric: str
    value: float


@dataclass(frozen=True)
class CurvePoint:
    """One point of a curve of an experiment.

    Attributes:
        experiment: ``lambda``, ``lambda_per_embedding``, ``memory``, ``window_radius`` or ``association``.
        curve: Which of its curves, e.g. ``R^D / R^I = 5``.
        seed: Seed of the simulation.
        x: Where along the curve: lambda, mapped volume in m^3, radius in m, threshold.
        metric: As in :class:`Record`, or ``bytes``.
        value: The number.
    """

    experiment: str
    curve: str
    seed: int
    x: float
    metric: str
    value: float


def write_records(path: Path, records: Iterable[Record]) -> None:
    """Write records as a JSON list of {scene, seed, layer, mode, metric, value}, NaN as null.

    What was in the file is replaced at once, or stays.

    Args:
        path: The file; folders above it are made.
        records: In the order in which they are written.

    Raises:
        StorageError: A value is infinite, or the file cannot be written.
    """
    lines = []
    for record in records:
        if math.isinf(record.value):
            raise StorageError(f"{path}: {record.metric} of {record.scene} is infinite")
        value = None if math.isnan(record.value) else float(record.value)
        lines.append(json.dumps(asdict(record) | {"value": value}, ensure_ascii=False, allow_nan=False))
    beside = path.with_name(f".{path.name}.writing")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        beside.write_text("[\n" + ",\n".join(lines) + "\n]\n", encoding="utf-8")
        beside.replace(path)
    except OSError as error:
        raise StorageError(f"{path}: cannot be written: {error}") from None


def read_records(path: Path) -> list[Record]:
    """Read what :func:`write_records` has written.

    Args:
        path: The file.

    Raises:
        StorageError: The file is missing or is not such a list; the message names the file and the entry.
    """
    try:
        entries = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise StorageError(f"{path}: cannot be read: {error}") from None
    except (ValueError, RecursionError) as error:
        raise StorageError(f"{path}: is not JSON: {error}") from None
    if not isinstance(entries, list):
        raise StorageError(f"{path}: must hold a list of records")
    return [_record(f"{path}: record {number}", entry) for number, entry in enumerate(entries)]


def _record(where: str, entry: Any) -> Record:
    names = [field.name for field in fields(Record)]
    if not isinstance(entry, dict) or set(entry) != set(names):
        raise StorageError(f"{where}: must have the keys {', '.join(names)}, and no others")
    for name in ("scene", "layer", "mode", "metric"):
        if not isinstance(entry[name], str):
            raise StorageError(f"{where}: {name} must be a text, got {entry[name]!r}")
    for name, known in (("layer", LAYERS), ("mode", MODES)):
        if entry[name] not in known:
            raise StorageError(f"{where}: {name} must be one of {', '.join(known)}, got '{entry[name]}'")
    if isinstance(entry["seed"], bool) or not isinstance(entry["seed"], int):
        raise StorageError(f"{where}: seed must be a whole number, got {entry['seed']!r}")
    value = entry["value"]
    if value is None:
        value = math.nan
    # Python reads NaN and Infinity too, which are not JSON.
    elif isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise StorageError(f"{where}: value must be a number or null, got {value!r}")
    return Record(**(entry | {"value": float(value)}))
