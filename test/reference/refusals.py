"""A map in use, and the check that a call which it refuses leaves no trace in it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache

import numpy as np
import pytest

from fus3dmaps_core.errors import MapError
from fus3dmaps_core.voxel_map.semantic_map import SemanticMap
from reference.agreement import assert_same_bytes, engine_of
from reference.steps import Setting, random_steps


def used_map(setting: Setting) -> SemanticMap:
    engine = engine_of(setting)
    for step in random_steps(setting, extent=2, count=16, seed=3):
        step.apply(engine)
    return engine


def go_on(engine: SemanticMap, setting: Setting) -> dict[str, np.ndarray]:
    """Let a map go on for a while; returns what it holds then."""
    for step in random_steps(setting, extent=2, count=12, seed=6):
        step.apply(engine)
    engine.fuse()
    return engine.export_state()


@cache
def undisturbed(setting: Setting) -> dict[str, np.ndarray]:
    """What a map holds that was never given anything bad."""
    return go_on(used_map(setting), setting)


@contextmanager
def refused(
    engine: SemanticMap, setting: Setting, error: type[Exception] = MapError, match: str | None = None
) -> Iterator[None]:
    """The call inside is refused, changes no byte, and later calls do as if it had never been made."""
    before = engine.export_state()
    with pytest.raises(error, match=match):
        yield
    assert_same_bytes(engine.export_state(), before)
    assert_same_bytes(go_on(engine, setting), undisturbed(setting))
