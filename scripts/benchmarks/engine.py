"""The cases of the map itself: updates, fusion, queries and memory.

Maps of several sizes are held side by side and timed in turns: whatever else the machine does meets all of them alike.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.embeddings import KnownText, ObservedObjects
from benchmarks.keyframes import DenseKeyframe, ProposalKeyframe
from benchmarks.measurements import Measurement, timed
from benchmarks.timing import Times, collected_garbage, time_call, time_calls
from benchmarks.workload import World, fill
from fus3dmaps_core.answers.query import TextQuery, answer_query
from fus3dmaps_core.config.schema import MapConfig
from fus3dmaps_core.voxel_map.layers.similarity import LAYERS
from fus3dmaps_core.voxel_map.semantic_map import SemanticMap

ELEMENT_BYTES = {"float32": 4, "float16": 2, "int8": 1}
_VOXELS_PER_INSTANCE = 400
_VARIANCE_RATIO = 1.0
_LOGIT_SCALE = 100.0
_DENSE_LAYERS = ("dense", "fused_dense")
_MIN_VOXELS_PER_INSTANCE = 20


@dataclass(frozen=True)
class Run:
    """What all cases of a run share.

    Attributes:
        world: Keyframes and surfaces.
        device: Torch device of the maps.
        backend: Which kernels the maps use; None leaves the choice to the map.
        threads: Threads of torch and of compiled code.
        repeats: Rounds over the keyframes, and timed calls of what has no keyframe.
        say: Called with what is being done.
    """

    world: World
    device: str
    backend: str | None
    threads: int
    repeats: int
    say: Callable[[str], None]

    def new_map(self, dimension: int, dtype: str, window_radius_m: float = 0.0) -> SemanticMap:
        """Make an empty map."""
        values = {"dtype": dtype, "device": self.device} | ({"backend": self.backend} if self.backend else {})
        return SemanticMap(dimension, MapConfig.model_validate(values), _VARIANCE_RATIO, window_radius_m)

    def params(self, voxels: int, dimension: int, dtype: str, **further: Any) -> dict[str, Any]:
        """Return the params of a measurement."""
        shared = {"device": self.device, "backend": self.backend or "default", "threads": self.threads}
        return {"map_voxels": voxels, "d": dimension, "dtype": dtype, **further, **shared}


class FilledMap:
    """A map of the benchmark and the inputs that are handed to it."""

    def __init__(self, run: Run, voxels: int, dimension: int, dtype: str, instances: int | None = None) -> None:
        """Fill a map.

        Args:
            run: The run that the map belongs to.
            voxels: How many voxels it gets.
            dimension: Embedding width d.
            dtype: Storage type.
            instances: How many instances it gets; None for as many as a building of that size has.
        """
        self.run = run
        self.voxels, self.dimension, self.dtype = voxels, dimension, dtype
        self.instances = instances or max(voxels // _VOXELS_PER_INSTANCE, 1)
        self.observed = ObservedObjects(dimension, run.world.seed)
        self.map = run.new_map(dimension, dtype)
        run.say(f"filling {voxels:,} voxels, d {dimension}, {dtype}")
        fill(self.map, run.world, voxels, self.instances, self.observed)

    def params(self, **further: Any) -> dict[str, Any]:
        """Return the params of a measurement of this map."""
        return self.run.params(self.voxels, self.dimension, self.dtype, **further)

    def forget_fresh(self, keyframe: DenseKeyframe) -> None:
        """Remove from the map what the keyframe is the first to see."""
        self.map.remove_voxels(keyframe.fresh_points_m)

    def update_dense(self, keyframe: DenseKeyframe, embeddings: NDArray[np.float32]) -> None:
        """Run one dense update."""
        weights = np.ones(len(embeddings), np.float32)
        self.map.integrate_dense(keyframe.points_m, keyframe.patches, embeddings, weights, keyframe.colors)

    def update_instances(self, keyframe: ProposalKeyframe, embeddings: NDArray[np.float32]) -> NDArray[np.int64]:
        """Run one instance update."""
        return self.map.integrate_proposals(keyframe.points_m, keyframe.proposals, embeddings)


def measure_dense_updates(maps: Sequence[FilledMap], keyframes: Sequence[DenseKeyframe]) -> list[Measurement]:
    """Measure dense_update: one keyframe into the dense layer, a twentieth of its voxels new to the map."""
    samples: list[list[float]] = [[] for _ in maps]
    run = maps[0].run
    embeddings = [maps[0].observed.observe(keyframe.patch_objects) for keyframe in keyframes]
    with collected_garbage():
        for rounds in range(run.repeats + 1):
            for keyframe, values in zip(keyframes, embeddings, strict=True):
                for filled, taken in zip(maps, samples, strict=True):
                    filled.forget_fresh(keyframe)
                    took = time_call(partial(filled.update_dense, keyframe, values), run.device)
                    if rounds:  # The first one warms up.
                        taken.append(took)
    points = round(float(np.mean([len(keyframe.points_m) for keyframe in keyframes])))
    hit = round(float(np.mean([keyframe.voxels for keyframe in keyframes])))
    return [
        timed("dense_update", filled.params(points=points, voxels_hit=hit, keyframes=len(keyframes)), Times(taken))
        for filled, taken in zip(maps, samples, strict=True)
    ]


def measure_instance_updates(maps: Sequence[FilledMap], keyframes: Sequence[ProposalKeyframe]) -> list[Measurement]:
    """Measure instance_update: all proposals of a keyframe, on maps that differ in instances alive."""
    samples: list[list[float]] = [[] for _ in maps]
    known = [0 for _ in maps]
    run = maps[0].run
    embeddings = [maps[0].observed.observe(keyframe.objects) for keyframe in keyframes]
    with collected_garbage():
        for rounds in range(run.repeats + 1):
            for keyframe, values in zip(keyframes, embeddings, strict=True):
                for place, filled in enumerate(maps):
                    before = filled.map.instance_count
                    took = time_call(partial(filled.update_instances, keyframe, values), run.device)
                    if rounds:
                        samples[place].append(took)
                        known[place] += len(values) - max(filled.map.instance_count - before, 0)
    masks = max(len(keyframe.objects) for keyframe in keyframes)
    points = round(float(np.mean([len(keyframe.points_m) for keyframe in keyframes])))
    total = run.repeats * sum(len(keyframe.objects) for keyframe in keyframes)
    return [
        timed(
            "instance_update",
            filled.params(
                masks=masks,
                points=points,
                instances=filled.instances,
                alive=filled.map.instance_count,
                matched_share=round(known[place] / total, 3),
            ),
            Times(samples[place]),
        )
        for place, filled in enumerate(maps)
    ]


def measure_fusion(
    filled: FilledMap, keyframes: Sequence[DenseKeyframe], masks: Sequence[ProposalKeyframe]
) -> list[Measurement]:
    """Measure full_fusion of a changed map, its bandwidth, and incremental_fusion after one more keyframe of both kinds."""
    run = filled.run

    def keyframe_before(index: int) -> None:
        dense, proposals = keyframes[index % len(keyframes)], masks[index % len(masks)]
        filled.update_dense(dense, filled.observed.observe(dense.patch_objects))
        filled.update_instances(proposals, filled.observed.observe(proposals.objects))

    full = time_calls(lambda index: filled.map.fuse(full=True), run.repeats, 1, keyframe_before, run.device)
    incremental = time_calls(lambda index: filled.map.fuse(), 2 * run.repeats, 1, keyframe_before, run.device)
    alive = filled.map.instance_count
    return [
        timed("full_fusion", filled.params(instances=alive), full),
        _bandwidth("full_fusion_bandwidth", filled, full, {}),
        timed("incremental_fusion", filled.params(instances=alive), incremental),
    ]


def measure_queries(filled: FilledMap) -> Iterator[Measurement]:
    """Measure text_query: one prompt asked of each layer of a fused map, with the whole answer but without encoding it."""
    filled.map.fuse()
    text = KnownText(filled.observed.directions[7])
    for layer in LAYERS:
        query = TextQuery(["a chair"], layer=layer)
        ask = partial(answer_query, filled.map, text, query, _LOGIT_SCALE)
        times = time_calls(lambda index, ask=ask: ask(), filled.run.repeats, 1, device=filled.run.device)  # type: ignore[misc]
        yield timed("text_query", filled.params(layer=layer), times)
        if layer in _DENSE_LAYERS:
            yield _bandwidth("text_query_bandwidth", filled, times, {"layer": layer})


def measure_memory(filled: FilledMap) -> list[Measurement]:
    """Measure dense_bytes_per_voxel (keys, hash, weights, embeddings) and instance_bytes (instances and all hypotheses)."""
    held = filled.map.nbytes()
    dense, instances = filled.map.dense_voxel_count, filled.map.instance_count
    return [
        Measurement("dense_bytes_per_voxel", filled.params(), (held["hash"] + held["dense"]) / dense, "B"),
        Measurement("instance_bytes", filled.params(instances=instances), held["instances"] / instances, "B"),
    ]


def instance_levels(voxels: int, wanted: Sequence[int]) -> list[int]:
    """Return the numbers of instances that a map of this size has room for."""
    return [level for level in wanted if level * _MIN_VOXELS_PER_INSTANCE <= voxels]


def _bandwidth(name: str, filled: FilledMap, times: Times, further: dict[str, Any]) -> Measurement:
    """Compute GB/s over the bytes of the dense rows: dense voxels x d x bytes of an element."""
    size = filled.map.dense_voxel_count * filled.dimension * ELEMENT_BYTES[filled.dtype]
    return Measurement(name, filled.params(**further), size / times.median_ms / 1e6, "GB/s")
