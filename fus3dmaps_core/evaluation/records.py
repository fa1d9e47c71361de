"""Results of an evaluation as flat records, and the files they are kept in."""

from __future__ import annotations

from dataclasses import dataclass

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
        experiment: ``lambda``, ``memory``, ``window_radius`` or ``association``.
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
