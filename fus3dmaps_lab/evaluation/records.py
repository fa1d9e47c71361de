"""Results of an evaluation as flat records, and the files they are kept in."""

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
