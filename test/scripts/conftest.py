"""The benchmark's world, made once."""

from __future__ import annotations

import pytest
from benchmarks.workload import World


@pytest.fixture(scope="session")
def world() -> World:
    return World(30_000, seed=5)
