"""The choice of the kernels that a map runs on."""

from __future__ import annotations

import logging
from functools import cache
from typing import Literal

import torch

from fus3dmaps_core.errors import ConfigError
from fus3dmaps_core.voxel_map.kernels.protocols import Kernels
from fus3dmaps_core.voxel_map.kernels.torch_kernels import TorchKernels

Backend = Literal["auto", "compiled", "torch"]

_LOG = logging.getLogger(__name__)


def select_kernels(backend: Backend, device: torch.device) -> Kernels:
    """Choose the kernels for a map on a device.

    Args:
        backend: ``compiled`` needs numba and a CPU. ``torch`` runs anywhere. ``auto`` takes ``compiled`` where it runs.
        device: The device that holds the map.

    Raises:
        ConfigError: ``compiled`` was asked for and cannot run; the message says why.
    """
    if backend == "torch" or (backend == "auto" and device.type != "cpu"):
        return TorchKernels()
    if device.type != "cpu":
        raise ConfigError(f"parameter 'map.backend': compiled kernels run on the CPU, parameter 'map.device' is '{device}'")
    compiled = _compiled()
    if isinstance(compiled, ImportError):
        if backend == "compiled":
            raise ConfigError(f"parameter 'map.backend': compiled kernels need numba and cannot run: {compiled}")
        return TorchKernels()
    return compiled


@cache
def _compiled() -> Kernels | ImportError:
    try:
        # Only here: the package runs without numba, a few times slower.
        from fus3dmaps_core.voxel_map.kernels.compiled_kernels import CompiledKernels
        from fus3dmaps_core.voxel_map.kernels.processor import check_processor

        check_processor()
    except ImportError as error:  # Also numba's own, when it does not know this numpy.
        _LOG.warning("numba cannot be used, the map runs several times slower than it could: %s", error)
        return error
    return CompiledKernels()
