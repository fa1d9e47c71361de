"""The paper's claims as pairs of conditions to compare, and the records that belong to each."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from fus3dmaps_lab.evaluation.paper_tables import HM3DSEM, REPLICA, SCANNET, SCENES
from fus3dmaps_lab.evaluation.records import Record
from fus3dmaps_lab.evaluation.statistics import ComparisonError, PairedComparison, Unit, compare, named

SIMULATION = "simulation"
"""Group of all simulated scenes; the word appears wherever their numbers do."""

OTHER = "other recordings"
"""Group of recorded scenes that the paper does not use."""

SCORES = ("mIoU", "f-mIoU", "accuracy", "mean_accuracy")
"""Metrics of semantic segmentation, without background classes."""

WITH_BACKGROUND = "_with_background"
"""Ending of their names if background classes count."""

HEADLINE_METRICS = (*SCORES, *(metric + WITH_BACKGROUND for metric in SCORES))
"""Metrics that every table shows first, in this order."""

CLASS_PREFIX = "iou/"
"""Prefix of the metrics that are the IoU of a class."""

_CLASS_PREFIXES = (CLASS_PREFIX, f"iou{WITH_BACKGROUND}/")

_SCENE_PATTERNS = {
    REPLICA: r"(?:replica[/ _-])?(office|room)_?(\d)",
    SCANNET: r"(?:scannet[/ _-])?(?:scene)?(\d{4})(?:_\d\d)?",
    HM3DSEM: r"(?:hm3d(?:sem)?[/ _-])?(\d{5})(?:-\w+)?",
}


@dataclass(frozen=True)
class Condition:
    """A layer in a mode of mapping.

    Attributes:
        layer: One of LAYERS.
        mode: One of MODES.
    """

    layer: str
    mode: str

    def __str__(self) -> str:
        return f"{self.layer}, {self.mode}"


@dataclass(frozen=True)
class Effect:
    """A change whose effect is measured.

    Attributes:
        name: Short name, for file names.
        title: The comparison in words.
        first: Condition without the change.
        second: Condition with it.
    """

    name: str
    title: str
    first: Condition
    second: Condition


FUSED_INSTANCES = Effect(
    "instances", "fused against unfused instances", Condition("instances", "full"), Condition("fused_instances", "full")
)
FUSED_DENSE = Effect(
    "dense", "fused against unfused dense layer", Condition("dense", "full"), Condition("fused_dense", "full")
)
WINDOW = Effect(
    "window",
    "sliding window against the whole dense layer",
    Condition("fused_instances", "full"),
    Condition("fused_instances", "window"),
)
NO_EVIDENCE = Effect(
    "evidence",
    "sliding window without the evidence score against with it",
    Condition("fused_instances", "window"),
    Condition("fused_instances", "window_no_evidence"),
)
EFFECTS = (FUSED_INSTANCES, FUSED_DENSE, WINDOW, NO_EVIDENCE)
"""The paper's claims that compare two maps."""


def is_simulated(scene: str) -> bool:
    """Return whether a scene is a simulation, by its name."""
    return "simulat" in scene.lower()


def paper_scene(scene: str) -> tuple[str, str] | None:
    """Return the paper's dataset and scene of a recorded scene, by its name in any of the published layouts."""
    for dataset, pattern in _SCENE_PATTERNS.items():
        found = re.fullmatch(pattern, scene.lower())
        if found and (name := "".join(found.groups())) in SCENES[dataset]:
            return dataset, name
    return None


def group_of(scene: str) -> str:
    """Return a scene's group: ``simulation``, its dataset in the paper, or ``other recordings``."""
    if is_simulated(scene):
        return SIMULATION
    found = paper_scene(scene)
    return found[0] if found else OTHER


def grouped(records: Iterable[Record]) -> dict[str, list[Record]]:
    """Group the records: simulations first, then the paper's datasets, then other recordings; no empty groups."""
    groups: dict[str, list[Record]] = {name: [] for name in (SIMULATION, *SCENES, OTHER)}
    for record in records:
        groups[group_of(record.scene)].append(record)
    return {name: members for name, members in groups.items() if members}


def metrics_in(records: Iterable[Record]) -> tuple[str, ...]:
    """List the metrics of the records, HEADLINE_METRICS first, the others by name, without IoUs of classes."""
    present = {record.metric for record in records if not record.metric.startswith(_CLASS_PREFIXES)}
    return (*(metric for metric in HEADLINE_METRICS if metric in present), *sorted(present - set(HEADLINE_METRICS)))


def values_of(records: Iterable[Record], condition: Condition, metric: str) -> dict[Unit, float]:
    """Return the values of a metric under one condition, by scene and seed; empty if it was not measured.

    Raises:
        ComparisonError: A scene and seed has two values.
    """
    values: dict[Unit, float] = {}
    for record in records:
        if (record.layer, record.mode, record.metric) != (condition.layer, condition.mode, metric):
            continue
        unit = (record.scene, record.seed)
        if unit in values:
            raise ComparisonError(f"{metric} of {condition} is given twice for {named([unit])}")
        values[unit] = record.value
    return values


def compare_effect(records: Sequence[Record], effect: Effect, metric: str) -> PairedComparison | None:
    """Compare the two conditions of an effect, paired by scene and seed; None if one of them was not measured at all.

    Raises:
        ComparisonError: They were measured on different scenes or seeds, or a value is missing or given twice.
    """
    first, second = (values_of(records, condition, metric) for condition in (effect.first, effect.second))
    if not first or not second:
        return None
    return compare(first, second, (f"{metric} of {effect.first}", f"{metric} of {effect.second}"))
