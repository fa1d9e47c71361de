"""Checks of arrays that are handed to the map. Each raises MapError, naming the argument, and computes nothing else."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from fus3dmaps_core.errors import MapError
from fus3dmaps_core.voxel_map.kernels.keys import MAX_COORDINATE
from fus3dmaps_core.voxel_map.kernels.protocols import MAX_COUNT
from fus3dmaps_core.voxel_map.layers.instances import MAX_ID

_MAX_WEIGHT = 1e6  # Far from where sums in float32 would overflow.


def check_floats(name: str, values: NDArray[np.floating], shape: tuple[int, ...]) -> None:
    """Raise MapError unless values are of the given shape and floating point."""
    if values.shape != shape or not np.issubdtype(values.dtype, np.floating):
        raise MapError(f"{name}: must be {shape} floating point, got {values.shape} {values.dtype}")


def check_rows(name: str, values: NDArray[np.floating], width: int) -> None:
    """Raise MapError unless values are any number of rows of the given width and floating point."""
    check_floats(name, values, (*values.shape[:1], width))


def check_finite(name: str, values: NDArray[np.floating]) -> None:
    """Raise MapError unless all values are finite."""
    if not np.isfinite(values).all():
        raise MapError(f"{name}: has values that are not finite in {values.dtype}")


def check_indices(name: str, values: NDArray[np.integer], length: int, bound: int) -> None:
    """Raise MapError unless values are (length,) integers in [0, bound)."""
    if values.shape != (length,) or not np.issubdtype(values.dtype, np.integer):
        raise MapError(f"{name}: must be ({length},) integer, got {values.shape} {values.dtype}")
    if length and not (values.min() >= 0 and values.max() < bound):
        raise MapError(f"{name}: must lie in [0, {bound}), got {values.min()} .. {values.max()}")


def check_weights(weights: NDArray[np.float32]) -> None:
    """Raise MapError unless the weights of observations are finite and lie in [0, 1e6]."""
    check_finite("weights", weights)
    if ((weights < 0) | (weights > _MAX_WEIGHT)).any():
        raise MapError(f"weights: must lie in [0, {_MAX_WEIGHT:g}]")


def check_colors(colors: NDArray[np.uint8], length: int) -> None:
    """Raise MapError unless colours are (length, 3) uint8."""
    if colors.shape != (length, 3) or colors.dtype != np.uint8:
        raise MapError(f"colors: must be ({length}, 3) uint8, got {colors.shape} {colors.dtype}")


def check_state(state: dict[str, NDArray[Any]], dimension: int, max_hypotheses: int) -> None:
    """Raise MapError unless the arrays of an exported state are all there and fit together."""
    n, m, i = (len(state.get(name, ())) for name in ("voxel_coordinates", "dense_slot", "instance_id"))
    shapes = {
        "voxel_coordinates": (n, 3),
        "voxel_colors": (n, 3),
        "dense_slot": (m,),
        "dense_weight": (m,),
        "dense_embedding": (m, dimension),
        "hypothesis_id": (n, max_hypotheses),
        "hypothesis_count": (n, max_hypotheses),
        "instance_id": (i,),
        "instance_weight": (i,),
        "instance_embedding": (i, dimension),
        "fused_embedding": (i, dimension),
        "fused_evidence": (i,),
        "next_instance_id": (),
    }
    if "dense_embedding" in state and state["dense_embedding"].dtype == np.int8:
        shapes["dense_scale"] = (m,)
    for name, shape in shapes.items():
        if name not in state:
            raise MapError(f"array '{name}' is missing")
        if state[name].shape != shape:
            raise MapError(f"array '{name}' must have the shape {shape}, has {state[name].shape}")
        if not np.issubdtype(state[name].dtype, np.number):
            raise MapError(f"array '{name}' must hold numbers, is {state[name].dtype}")
    for name, array in state.items():
        if np.issubdtype(array.dtype, np.floating) and not np.isfinite(array).all():
            raise MapError(f"array '{name}' has values that are not finite")
    for name in ("voxel_coordinates", "dense_slot", "hypothesis_id", "hypothesis_count", "instance_id", "next_instance_id"):
        if not np.issubdtype(state[name].dtype, np.integer):
            raise MapError(f"array '{name}' must be of an integer type, is {state[name].dtype}")
    next_id = int(state["next_instance_id"])
    if not 0 <= next_id <= MAX_ID:
        raise MapError(f"array 'next_instance_id' must lie in [0, {MAX_ID}], is {next_id}")
    for name, bound in (("dense_slot", n), ("instance_id", next_id)):
        values = state[name]
        if len(values) and not (values.min() >= 0 and values.max() < bound and len(np.unique(values)) == len(values)):
            raise MapError(f"array '{name}' must hold distinct values in [0, {bound})")
    coordinates = state["voxel_coordinates"]
    if n and np.abs(coordinates.astype(np.int64)).max() > MAX_COORDINATE:
        raise MapError(f"array 'voxel_coordinates' goes beyond the map's range of +-{MAX_COORDINATE}")
    if len(np.unique(coordinates, axis=0)) != n:
        raise MapError("array 'voxel_coordinates' holds a voxel twice")
    held, counts = state["hypothesis_id"], state["hypothesis_count"]
    if not np.array_equal(np.unique(held[held >= 0]), np.sort(state["instance_id"])):
        raise MapError("arrays 'hypothesis_id' and 'instance_id' must name the same instances")
    ordered = np.sort(held, axis=1)
    if ((ordered[:, 1:] >= 0) & (ordered[:, 1:] == ordered[:, :-1])).any():
        raise MapError("array 'hypothesis_id' names an instance twice in one voxel")
    if (counts < 0).any() or (counts > MAX_COUNT).any() or ((counts > 0) != (held >= 0)).any():
        raise MapError(
            f"array 'hypothesis_count' must lie in [1, {MAX_COUNT}] where there is a hypothesis and be 0 elsewhere"
        )
    if "dense_scale" in shapes and (state["dense_scale"] <= 0).any():
        raise MapError("array 'dense_scale' must be positive")
    for name in ("dense_weight", "instance_weight", "fused_evidence"):
        if (state[name] < 0).any() or (name != "fused_evidence" and (state[name] == 0).any()):
            raise MapError(f"array '{name}' must be positive")
