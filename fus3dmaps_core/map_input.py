"""Checks of what is handed to the map: each raises MapError, naming the argument, before anything is touched."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import normalize

from fus3dmaps_core.errors import MapError
from fus3dmaps_core.voxels.hash import MAX_COORDINATE

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


def unit_rows(embeddings: NDArray[np.floating], dimension: int, device: torch.device) -> Tensor:
    """Embeddings (n, d) of any length but 0, scaled to unit length: float32."""
    values = float_tensor("embeddings", embeddings, (len(embeddings), dimension), device, torch.float64)
    largest = values.abs().amax(dim=1, keepdim=True) if len(values) else values[:, :1]
    if bool((largest == 0).any()):
        raise MapError("embeddings: a row has length 0")
    # Scaled first, so that squares neither overflow nor vanish whatever the row's length.
    return normalize(values / largest, dim=1).to(torch.float32)


def voxel_coordinates(points_m: NDArray[np.floating], voxel_size_m: float, device: torch.device) -> Tensor:
    """Voxel of each point (n, 3): floor(p / size) per axis, int64."""
    points = float_tensor("points_m", points_m, (len(points_m), 3), device, torch.float64)
    coordinates = torch.floor(points / voxel_size_m)
    if coordinates.numel() and float(coordinates.abs().max()) > MAX_COORDINATE:
        limit_km = MAX_COORDINATE * voxel_size_m / 1000
        raise MapError(f"points_m: {float(points.abs().max()):.0f} m is beyond the map's range of {limit_km:.1f} km")
    return coordinates.to(torch.int64)


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
    for name, shape in shapes.items():
        if name not in state:
            raise MapError(f"array '{name}' is missing")
        if state[name].shape != shape:
            raise MapError(f"array '{name}' must have the shape {shape}, has {state[name].shape}")
    for name, array in state.items():
        if np.issubdtype(array.dtype, np.floating) and not np.isfinite(array).all():
            raise MapError(f"array '{name}' has values that are not finite")
    for name in ("voxel_coordinates", "dense_slot", "hypothesis_id", "hypothesis_count", "instance_id", "next_instance_id"):
        if not np.issubdtype(state[name].dtype, np.integer):
            raise MapError(f"array '{name}' must be of an integer type, is {state[name].dtype}")
    next_id = int(state["next_instance_id"])
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
    if not np.isin(held[held >= 0], state["instance_id"]).all():
        raise MapError("array 'hypothesis_id' names an instance that array 'instance_id' lacks")
    if (counts < 0).any() or ((counts > 0) != (held >= 0)).any():
        raise MapError("array 'hypothesis_count' must be positive where there is a hypothesis and 0 elsewhere")
    for name in ("dense_weight", "instance_weight", "fused_evidence"):
        if (state[name] < 0).any() or (name != "fused_evidence" and (state[name] == 0).any()):
            raise MapError(f"array '{name}' must be positive")
