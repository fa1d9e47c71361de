"""Checks of what is handed to the map: each raises MapError, naming the argument, before anything is touched."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from fus3dmaps_core.errors import MapError
from fus3dmaps_core.voxel_map.kernels.keys import MAX_COORDINATE
from fus3dmaps_core.voxel_map.kernels.protocols import MAX_COUNT, Kernels
from fus3dmaps_core.voxel_map.layers.instances import MAX_ID

_MAX_WEIGHT = 1e6  # Far from where sums in float32 would overflow.


def float_tensor(
    name: str,
    values: NDArray[np.floating],
    shape: tuple[int, ...],
    device: torch.device,
    dtype: torch.dtype = torch.float32,
) -> Tensor:
    """Finite floating point values of the given shape as a tensor."""
    if values.shape != shape or not np.issubdtype(values.dtype, np.floating):
        raise MapError(f"{name}: must be {shape} floating point, got {values.shape} {values.dtype}")
    tensor = torch.from_numpy(np.ascontiguousarray(values)).to(device, dtype)
    if not bool(torch.isfinite(tensor).all()):  # After the cast, which turns what is too large into infinity.
        raise MapError(f"{name}: has values that are not finite in {str(dtype).removeprefix('torch.')}")
    return tensor


def index_tensor(name: str, values: NDArray[np.integer], length: int, bound: int, device: torch.device) -> Tensor:
    """Integers in [0, bound) as an int64 tensor (length,)."""
    if values.shape != (length,) or not np.issubdtype(values.dtype, np.integer):
        raise MapError(f"{name}: must be ({length},) integer, got {values.shape} {values.dtype}")
    if length and not (values.min() >= 0 and values.max() < bound):
        raise MapError(f"{name}: must lie in [0, {bound}), got {values.min()} .. {values.max()}")
    return torch.from_numpy(values.astype(np.int64)).to(device)


def weight_tensor(weights: NDArray[np.floating], length: int, device: torch.device) -> Tensor:
    """Weights of observations, (length,) float32 in [0, 1e6]."""
    tensor = float_tensor("weights", weights, (length,), device)
    if bool(((tensor < 0) | (tensor > _MAX_WEIGHT)).any()):
        raise MapError(f"weights: must lie in [0, {_MAX_WEIGHT:g}]")
    return tensor


def unit_rows(name: str, embeddings: NDArray[np.floating], dimension: int, kernels: Kernels, device: torch.device) -> Tensor:
    """Embeddings (n, d) of any length but 0, scaled to unit length: float32."""
    shape = (*embeddings.shape[:1], dimension)
    if embeddings.shape != shape or not np.issubdtype(embeddings.dtype, np.floating):
        raise MapError(f"{name}: must be {shape} floating point, got {embeddings.shape} {embeddings.dtype}")
    units, failure = kernels.unit_rows(_tensor(embeddings, device))
    if failure:
        raise MapError(f"{name}: " + ("a row has length 0" if failure == 2 else "has values that are not finite"))
    return units


def voxel_keys(points_m: NDArray[np.floating], voxel_size_m: float, kernels: Kernels, device: torch.device) -> Tensor:
    """Packed key of the voxel of each point (n, 3): floor(p / size) per axis, (n,) int64."""
    shape = (*points_m.shape[:1], 3)
    if points_m.shape != shape or not np.issubdtype(points_m.dtype, np.floating):
        raise MapError(f"points_m: must be {shape} floating point, got {points_m.shape} {points_m.dtype}")
    keys, largest = kernels.voxel_keys(_tensor(points_m, device), voxel_size_m)
    if not math.isfinite(largest):
        raise MapError("points_m: has values that are not finite")
    if largest > MAX_COORDINATE:
        farthest, limit_km = largest * voxel_size_m, MAX_COORDINATE * voxel_size_m / 1000
        raise MapError(f"points_m: {farthest:.0f} m is beyond the map's range of {limit_km:.1f} km")
    return keys


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


def _tensor(values: NDArray[np.floating], device: torch.device) -> Tensor:
    """The values in a type that torch and kernels know."""
    wide = values if values.dtype in (np.float32, np.float64) else values.astype(np.float64)
    return torch.from_numpy(np.ascontiguousarray(wide)).to(device)


def with_visible(
    keys: Tensor, visible_points_m: NDArray[np.floating] | None, voxel_size_m: float, kernels: Kernels, device: torch.device
) -> Tensor:
    """Distinct keys of all voxels that a keyframe saw: those of its proposals, and of the points beside them."""
    if visible_points_m is not None:
        try:
            keys = torch.cat([keys, voxel_keys(visible_points_m, voxel_size_m, kernels, device)])
        except MapError as error:
            raise MapError(f"visible_{error}") from None  # It speaks of points_m.
    return kernels.distinct(keys)[0]
