"""Which kernels a map gets, and what it is told when it cannot have them."""

from __future__ import annotations

import logging
import sys

import numpy as np
import pytest
import torch
from reference.variants import BACKENDS

from fus3dmaps_core.config.schema import MapConfig
from fus3dmaps_core.errors import ConfigError
from fus3dmaps_core.voxel_map.kernels import selection
from fus3dmaps_core.voxel_map.kernels.selection import select_kernels
from fus3dmaps_core.voxel_map.kernels.torch_kernels import TorchKernels
from fus3dmaps_core.voxel_map.semantic_map import SemanticMap

CPU, CUDA = torch.device("cpu"), torch.device("cuda")


@pytest.fixture
def without_numba(monkeypatch):
    """As if numba were not installed."""
    monkeypatch.setitem(sys.modules, "numba", None)
    for name in [each for each in sys.modules if each.startswith("fus3dmaps_core.voxel_map.kernels.") and "numba" in each]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.delitem(sys.modules, "fus3dmaps_core.voxel_map.kernels.compiled_kernels", raising=False)
    # The package's own attributes would stand in for the modules that are gone.
    for name in ("compiled_kernels", "numba_points", "numba_rows", "numba_instances"):
        monkeypatch.delattr(f"fus3dmaps_core.voxel_map.kernels.{name}", raising=False)
    selection._compiled.cache_clear()
    yield
    selection._compiled.cache_clear()


def test_torch_is_taken_where_it_is_asked_for_and_off_the_cpu():
    assert isinstance(select_kernels("torch", CPU), TorchKernels)
    assert isinstance(select_kernels("auto", CUDA), TorchKernels)
    assert isinstance(select_kernels("torch", CUDA), TorchKernels)


def test_auto_takes_compiled_kernels_on_a_cpu_that_has_them():
    has_compiled = ("compiled", "cpu") in BACKENDS
    assert isinstance(select_kernels("auto", CPU), TorchKernels) is not has_compiled


def test_compiled_kernels_are_refused_off_the_cpu():
    with pytest.raises(ConfigError, match=r"map\.backend.*CPU.*map\.device.*cuda"):
        select_kernels("compiled", CUDA)
    with pytest.raises(ConfigError, match=r"map\.backend"):
        SemanticMap(4, MapConfig(backend="compiled", device="cuda:0"), 1.0)


def test_without_numba_auto_takes_torch_and_says_so_once(without_numba, caplog):
    with caplog.at_level(logging.WARNING):
        assert isinstance(select_kernels("auto", CPU), TorchKernels)
        assert isinstance(select_kernels("auto", CPU), TorchKernels)
    (record,) = [each for each in caplog.records if "numba" in each.getMessage()]
    assert record.levelno == logging.WARNING
    assert "slower" in record.getMessage()


def test_without_numba_compiled_is_refused_by_name(without_numba):
    with pytest.raises(ConfigError, match=r"map\.backend.*numba"):
        select_kernels("compiled", CPU)
    with pytest.raises(ConfigError, match="numba"):
        SemanticMap(4, MapConfig(backend="compiled"), 1.0)


def test_without_numba_a_map_works(without_numba):
    semantic_map = SemanticMap(4, MapConfig(), 1.0)
    point, none = np.full((1, 3), 0.01), np.zeros(1, int)
    semantic_map.integrate_dense(point, none, np.ones((1, 4)), np.ones(1), np.zeros((1, 3), np.uint8))
    assert semantic_map.integrate_proposals(point, none, np.ones((1, 4))).tolist() == [0]
    assert semantic_map.fuse().updated == 1


def test_a_processor_without_half_precision_gets_torch_instead_of_a_dead_process(monkeypatch, caplog):
    """Compiled for a processor without F16C, the first conversion of a half would abort the process."""
    monkeypatch.setattr("platform.machine", lambda: "x86_64")
    monkeypatch.setattr("numba.core.config.CPU_FEATURES", "+sse2,-f16c")
    selection._compiled.cache_clear()
    try:
        with caplog.at_level(logging.WARNING):
            assert isinstance(select_kernels("auto", CPU), TorchKernels)
        assert "F16C" in caplog.text
        with pytest.raises(ConfigError, match=r"map\.backend.*F16C"):
            select_kernels("compiled", CPU)
        monkeypatch.setattr("numba.core.config.CPU_FEATURES", "+sse2,+f16c")
        selection._compiled.cache_clear()
        assert not isinstance(select_kernels("compiled", CPU), TorchKernels)
        monkeypatch.setattr("platform.machine", lambda: "aarch64")
        monkeypatch.setattr("numba.core.config.CPU_FEATURES", "+neon")
        selection._compiled.cache_clear()
        assert not isinstance(select_kernels("compiled", CPU), TorchKernels)
    finally:
        selection._compiled.cache_clear()
