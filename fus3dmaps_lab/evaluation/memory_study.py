"""Memory against mapped volume in a large simulated building: whole dense map, sliding window, and prediction."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from fus3dmaps_core.config.schema import Config
from fus3dmaps_core.voxel_map.semantic_map import SemanticMap
from fus3dmaps_lab.evaluation.building_runs import BuildingRun, Variant
from fus3dmaps_lab.evaluation.curves import DENSE_MAP, PREDICTED, SLIDING_WINDOW
from fus3dmaps_lab.evaluation.records import CurvePoint
from fus3dmaps_lab.simulation.building.simulated_building import SimulatedBuilding
from fus3dmaps_lab.simulation.models.encoder_statistics import EncoderStatistics

_TRIAL_VOXELS = 400_000
_TRIAL_STEP = 10_000


@dataclass(frozen=True)
class MemoryStudy:
    """The building of a memory study, and how it is mapped.

    Attributes:
        storeys: Number of storeys.
        rooms_per_storey: Number of rooms on each storey.
        frames: Number of frames along the route; None takes as many as the rooms need.
        room_size_m: Least and greatest edge of a room.
        dimension: Width of the embeddings.
        window_radius_m: Radius of the map with a window.
        measurements: Number of measurements, evenly along the route.
    """

    storeys: int = 3
    rooms_per_storey: int = 16
    frames: int | None = None
    room_size_m: tuple[float, float] = (9.0, 11.0)
    dimension: int = 128
    window_radius_m: float = 6.0
    measurements: int = 25


def memory_curves(
    study: MemoryStudy, seed: int, on_progress: Callable[[int, int], object] | None = None
) -> list[CurvePoint]:
    """Map a building with and without a window, and measure the allocated bytes of each map along the route.

    The prediction is the number of voxels times the bytes of a voxel, measured on another map (:func:`bytes_per_voxel`).

    Args:
        study: The building.
        seed: Seed of the building.
        on_progress: Called with the number of frames mapped and of all frames.
    """
    building = SimulatedBuilding(
        seed=seed,
        storeys=study.storeys,
        rooms_per_storey=study.rooms_per_storey,
        frames=study.frames,
        room_size_m=study.room_size_m,
    )
    statistics = replace(EncoderStatistics(), dimension=study.dimension)
    window = {"fusion.window_radius_m": study.window_radius_m}
    variants = {
        DENSE_MAP: Variant({"fusion.window_radius_m": 0.0}, statistics),
        SLIDING_WINDOW: Variant(window, statistics),
    }
    run = BuildingRun(building.truth, (building.intrinsics.width, building.intrinsics.height), variants, seed)
    whole = run.pipelines[DENSE_MAP]
    per_voxel = bytes_per_voxel(whole.config, study.dimension)
    period = max(1, len(building) // study.measurements)
    points: list[CurvePoint] = []

    def measure(done: int) -> None:
        if on_progress is not None:
            on_progress(done, len(building))
        if done % period:
            return
        voxels = whole.semantic_map.voxel_count
        volume_m3 = voxels * whole.config.map.voxel_size_m**3
        for curve in variants:
            held = float(sum(run.pipelines[curve].semantic_map.nbytes().values()))
            points.append(CurvePoint("memory", curve, seed, volume_m3, "bytes", held))
        points.append(CurvePoint("memory", PREDICTED, seed, volume_m3, "bytes", voxels * per_voxel))

    run.feed(building, measure)
    return points


def bytes_per_voxel(config: Config, dimension: int) -> float:
    """Measure the allocated bytes per voxel of a map whose voxels all have a dense embedding and no instance.

    Memory allocated in advance grows by doubling, so bytes per voxel rise and fall; the result is their mean over one
    doubling.

    Args:
        config: Configuration of the map.
        dimension: Width of the embeddings.
    """
    trial = SemanticMap(dimension, config.map, 1.0, 0.0)
    one = np.full((1, dimension), dimension**-0.5, np.float32)
    nothing, colors = np.zeros(_TRIAL_STEP, np.int64), np.zeros((_TRIAL_STEP, 3), np.uint8)
    found = []
    for start in range(0, _TRIAL_VOXELS, _TRIAL_STEP):
        index = np.stack(np.unravel_index(np.arange(start, start + _TRIAL_STEP), (_TRIAL_VOXELS, 100, 100)), axis=1)
        points_m = (index + 0.5) * config.map.voxel_size_m
        trial.integrate_dense(points_m, nothing, one, np.ones(1, np.float32), colors)
        if 2 * trial.voxel_count > _TRIAL_VOXELS:
            found.append(sum(trial.nbytes().values()) / trial.voxel_count)
    return float(np.mean(found))
