"""The ways to build a map that this machine has: kernels with their device, and storage types."""

from __future__ import annotations

from importlib.util import find_spec

import torch

from fus3dmaps_core.voxel_map.kernels.protocols import Kernels
from fus3dmaps_core.voxel_map.kernels.selection import select_kernels

DEVICES = ("cpu", "cuda") if torch.cuda.is_available() else ("cpu",)
BACKENDS = tuple(
    (backend, device)
    for backend in ("compiled", "torch")
    for device in DEVICES
    if backend == "torch" or (device == "cpu" and find_spec("numba"))
)
"""Pairs of ``backend`` and ``device``."""

BACKEND_IDS = ["-".join(pair) for pair in BACKENDS]
DTYPES = ("float32", "float16", "int8")


def kernels_of(backend: str, device: str) -> Kernels:
    """The kernels of a pair."""
    return select_kernels(backend, torch.device(device))
