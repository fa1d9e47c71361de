"""Shared fixtures. Heavy work is done once per session."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, settings

import fus3dmaps_core  # noqa: F401  (before any test imports torch: it settles how idle threads wait)

REPOSITORY = Path(__file__).resolve().parents[1]

settings.register_profile(
    "fus3dmaps", deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large]
)
settings.load_profile("fus3dmaps")


@pytest.fixture(scope="session")
def redkitchen() -> Path:
    """A real recording in the 7-Scenes layout, where one lies beside the checkout."""
    directory = REPOSITORY.parent / "shared" / "recordings" / "redkitchen"
    if not (directory / "camera-intrinsics.txt").is_file():
        pytest.skip("no real recording lies beside this checkout")
    return directory


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20240611)
