"""Results of an evaluation as flat records, and writing them to a file."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path

from fus3dmaps_core.errors import StorageError

LAYERS = ("dense", "fused_dense", "instances", "fused_instances")
"""Layers that are evaluated."""

MODES = ("full", "window", "window_no_evidence")
"""Whole dense layer; sliding window; sliding window that replaces fused embeddings even by ones of less evidence."""


@dataclass(frozen=True)
class Record:
    """One number of one map.

    Attributes:
        scene: Scene, e.g. ``building`` or ``room0``; the name of a simulated scene says so.
        seed: Seed of a simulation, 0 for recorded scenes.
        layer: One of LAYERS.
        mode: One of MODES.
        metric: ``mIoU``, ``f-mIoU``, ``accuracy`` (share of right voxels), ``mean_accuracy`` (mean over classes), the same
            with ``_with_background``; ``iou/NAME`` of a class; others as their modules name them.
        value: The number; NaN if it is undefined.
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
        curve: Name of the curve, e.g. ``R^D / R^I = 5``.
        seed: Seed of the simulation.
        x: Place along the curve: lambda, mapped volume in m^3, radius in m, threshold.
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

    The file is replaced as a whole, or stays as it was after an error.

    Args:
        path: The file; missing folders are made.
        records: Records in the order of the file.

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
