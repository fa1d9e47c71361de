"""Sequences of what can happen to a map, drawn at random: frames, proposals, window moves, removals, fusions, little memory.

A step applies to the reference and to the package's map alike, for both have the same methods. Points lie inside their
voxel, away from its walls, and dense weights are multiples of 1/64, so that sums are exact and comparisons of evidence have
one answer.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from hypothesis import strategies as st

from reference.vectors import Key


@dataclass(frozen=True)
class Setting:
    """How a map is built."""

    voxel_size_m: float = 0.05
    max_hypotheses: int = 3
    iou_threshold: float = 0.2
    variance_ratio: float = 1.0
    window_radius_m: float = 0.0
    keep_most_evidence: bool = True
    association: str = "iou"
    merge_overlap: float = 0.0
    merge_cosine: float = 0.8
    dimension: int = 5
    dtype: str = "float32"
    backend: str = "auto"
    device: str = "cpu"


@dataclass(frozen=True)
class DenseStep:
    """Arguments of integrate_dense."""

    points_m: np.ndarray
    patches: np.ndarray
    embeddings: np.ndarray
    weights: np.ndarray
    colors: np.ndarray

    def apply(self, target: Any) -> Any:
        return target.integrate_dense(self.points_m, self.patches, self.embeddings, self.weights, self.colors)


@dataclass(frozen=True)
class ProposalStep:
    """Arguments of integrate_proposals."""

    points_m: np.ndarray
    proposals: np.ndarray
    embeddings: np.ndarray
    visible_points_m: np.ndarray | None = None

    def apply(self, target: Any) -> Any:
        return target.integrate_proposals(self.points_m, self.proposals, self.embeddings, self.visible_points_m)


@dataclass(frozen=True)
class WindowStep:
    """Argument of prune_window."""

    center_m: np.ndarray

    def apply(self, target: Any) -> Any:
        return target.prune_window(self.center_m)


@dataclass(frozen=True)
class RemoveStep:
    """Argument of remove_voxels."""

    points_m: np.ndarray

    def apply(self, target: Any) -> Any:
        return target.remove_voxels(self.points_m)


@dataclass(frozen=True)
class RadiusStep:
    """Argument of set_window_radius; only for maps that have a window."""

    radius_m: float

    def apply(self, target: Any) -> Any:
        return target.set_window_radius(self.radius_m)


@dataclass(frozen=True)
class DropStep:
    """Argument of drop_least_observed."""

    count: int

    def apply(self, target: Any) -> Any:
        return target.drop_least_observed(self.count)


@dataclass(frozen=True)
class ReleaseStep:
    """A call of release_unused, which must not show."""

    def apply(self, target: Any) -> Any:
        target.release_unused()


@dataclass(frozen=True)
class FuseStep:
    """A fusion."""

    full: bool = False

    def apply(self, target: Any) -> Any:
        return target.fuse(self.full)


Step = DenseStep | ProposalStep | WindowStep | RemoveStep | RadiusStep | DropStep | ReleaseStep | FuseStep


def points_in(keys: np.ndarray, voxel_size_m: float, rng: np.random.Generator) -> np.ndarray:
    """One point somewhere inside each voxel (n, 3)."""
    return (np.asarray(keys, dtype=np.float64).reshape(-1, 3) + rng.uniform(0.05, 0.95, (len(keys), 3))) * voxel_size_m


def embeddings_of(count: int, dimension: int, rng: np.random.Generator) -> np.ndarray:
    """Vectors of any length that share enough direction for their means to keep one."""
    directions = rng.normal(size=(count, dimension)) + 0.8
    return (directions * rng.uniform(0.05, 20.0, (count, 1))).astype(np.float32)


def dense_step(keys: list[Key], setting: Setting, rng: np.random.Generator, weightless: bool = True) -> DenseStep:
    """A frame with a point in each of the voxels, which may repeat; more patches than are hit, some without weight."""
    patch_count = int(rng.integers(1, 6))
    weights = rng.integers(0 if weightless else 1, 65, patch_count) / 64.0
    weights[rng.random(patch_count) < 0.4] = 1.0
    if weightless:
        weights[rng.random(patch_count) < 0.1] = 0.0
    return DenseStep(
        points_in(np.array(keys).reshape(-1, 3), setting.voxel_size_m, rng),
        rng.integers(0, patch_count, len(keys)),
        embeddings_of(patch_count, setting.dimension, rng),
        weights.astype(np.float32),
        rng.integers(0, 256, (len(keys), 3), dtype=np.uint8),
    )


def proposal_step(masks: list[list[Key]], setting: Setting, rng: np.random.Generator) -> ProposalStep:
    """A frame of proposals, each with a point in each of its voxels, which may repeat; points come in mixed order.

    Where association asks what is visible, some voxels around are, with or without those of the proposals.
    """
    keys = [key for mask in masks for key in mask]
    proposals = np.array([m for m, mask in enumerate(masks) for _ in mask], dtype=np.int64)
    order = rng.permutation(len(keys))
    step = ProposalStep(
        points_in(np.array(keys).reshape(-1, 3), setting.voxel_size_m, rng)[order],
        proposals[order],
        embeddings_of(len(masks), setting.dimension, rng),
    )
    if setting.association == "iou" or rng.random() < 0.2:
        return step
    some = np.array(keys).reshape(-1, 3)[:: rng.integers(1, 4)]
    around = np.concatenate([rng.integers(-3, 3, (int(rng.integers(0, 40)), 3)), some])
    return replace(step, visible_points_m=points_in(around, setting.voxel_size_m, rng))


def remove_step(keys: list[Key], setting: Setting, rng: np.random.Generator) -> RemoveStep:
    """Removal of voxels, which may repeat or be missing."""
    return RemoveStep(points_in(np.array(keys).reshape(-1, 3), setting.voxel_size_m, rng))


def memory_step(setting: Setting, most: int, rng: np.random.Generator) -> Step:
    """What a map does when memory is short; at most so many voxels are dropped."""
    kind = rng.random()
    if kind < 0.5:
        return DropStep(int(rng.integers(0, most + 1)))
    if kind < 0.75 and setting.window_radius_m > 0:
        return RadiusStep(float(setting.window_radius_m * rng.choice([0.7, 1.0, 1.3])))
    return ReleaseStep()


def random_box(extent: int, rng: np.random.Generator) -> list[Key]:
    """Voxels of a random box in [-extent, extent)^3, with holes and repetitions."""
    low = rng.integers(-extent, extent, 3)
    high = np.minimum(low + rng.integers(1, rng.integers(2, 2 * extent + 2), 3), extent)
    keys = [tuple(int(each) for each in low + offset) for offset in np.ndindex(*(high - low))]
    kept = [key for key in keys if rng.random() < 0.85] or keys[:1]
    again = [kept[int(each)] for each in rng.integers(0, len(kept), rng.integers(0, len(kept) + 1))]
    return kept + again


def random_steps(setting: Setting, extent: int, count: int, seed: int) -> list[Step]:
    """A long walk through one place, so that objects are seen again, crowd each other out and leave the window.

    Beside the steps that are counted, memory is short now and then.
    """
    rng, shortage = np.random.default_rng(seed), np.random.default_rng([seed, 1])
    steps: list[Step] = []
    for _ in range(count):
        kind = rng.random()
        if kind < 0.4:
            keys = [key for _ in range(rng.integers(1, 4)) for key in random_box(extent, rng)]
            steps.append(dense_step(keys, setting, rng))
        elif kind < 0.75:
            masks = [random_box(extent, rng) if rng.random() < 0.95 else [] for _ in range(rng.integers(1, 7))]
            steps.append(proposal_step(masks, setting, rng))
        elif kind < 0.85:
            steps.append(WindowStep(rng.uniform(-extent, extent, 3) * setting.voxel_size_m))
        elif kind < 0.9:
            everything = [tuple(int(each) - extent for each in key) for key in np.ndindex(*[2 * extent] * 3)]
            steps.append(remove_step(everything if rng.random() < 0.15 else random_box(extent, rng), setting, rng))
        else:
            steps.append(FuseStep(full=rng.random() < 0.3))
        if shortage.random() < 0.08:
            steps.append(memory_step(setting, extent**3, shortage))
    return steps


settings_of_maps = st.builds(
    Setting,
    voxel_size_m=st.sampled_from([0.05, 0.07, 0.25]),
    max_hypotheses=st.integers(1, 4),
    iou_threshold=st.sampled_from([0.0, 0.2, 0.5]),
    variance_ratio=st.sampled_from([0.25, 1.0, 5.0]),
    window_radius_m=st.sampled_from([0.0, 0.07, 0.12]),
    dimension=st.integers(2, 6),
)

_cells = st.tuples(st.integers(-2, 1), st.integers(-2, 1), st.integers(-1, 0))
_seeds = st.integers(0, 2**32 - 1)


@st.composite
def _boxes(draw: st.DrawFn) -> list[Key]:
    a, b = draw(_cells), draw(_cells)
    low, high = np.minimum(a, b), np.maximum(a, b)
    keys = [tuple(int(each) for each in low + offset) for offset in np.ndindex(*(high - low + 1))]
    return keys + draw(st.lists(st.sampled_from(keys), max_size=3))


@st.composite
def sequences(draw: st.DrawFn, max_steps: int = 12, **fixed: Any) -> tuple[Setting, list[Step]]:
    """A map's setting, of which some fields may be given, and what happens to it; shrinks in steps, masks and voxels."""
    setting = replace(draw(settings_of_maps), **fixed)
    kinds = ["dense", "proposals", "proposals", "window", "remove", "memory", "fuse"]
    steps: list[Step] = []
    for kind in draw(st.lists(st.sampled_from(kinds), max_size=max_steps)):
        rng = np.random.default_rng(draw(_seeds))
        if kind == "dense":
            steps.append(dense_step(draw(st.lists(_cells, max_size=20)), setting, rng))
        elif kind == "proposals":
            masks = draw(st.lists(st.one_of(_boxes(), st.lists(_cells, max_size=4)), max_size=4))
            steps.append(proposal_step(masks, setting, rng))
        elif kind == "window":
            steps.append(WindowStep(rng.uniform(-2.5, 2.5, 3) * setting.voxel_size_m))
        elif kind == "remove":
            steps.append(remove_step(draw(st.one_of(_boxes(), st.lists(_cells, max_size=4))), setting, rng))
        elif kind == "memory":
            steps.append(memory_step(setting, 12, rng))
        else:
            steps.append(FuseStep(draw(st.booleans())))
    return setting, steps
