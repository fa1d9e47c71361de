"""Trios with random weights, a short recording, and the maps that the trios make of it without ROS."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from ros.conftest import signals, start, user  # noqa: F401  (fixtures)
from weights_cache import WeightsCache, expect_random_weights, write_weights

from fus3dmaps_core.config.schema import Config
from fus3dmaps_core.recordings.writer import RecordingWriter
from fus3dmaps_lab.simulation.room.furnished_room import FurnishedRoom

FRAMES = 2
SETTINGS = {
    "image.width": 160,
    "image.height": 128,
    "segmenter.min_area_px": 100,
    "segmenter.max_masks": 2,
    "node.service_timeout_s": 120.0,
}
"""Settings of all trios: small images, and few crops of them."""


@pytest.fixture(scope="session")
def recording(tmp_path_factory) -> Path:
    """Record keyframes of both layers, and nothing else."""
    path = tmp_path_factory.mktemp("recording") / "room.mcap"
    room = FurnishedRoom(frames=30)
    with RecordingWriter(path) as writer:
        for index in range(FRAMES):
            writer.write(room.frame(index))
    return path


@pytest.fixture(scope="session")
def cache(tmp_path_factory) -> Iterator[WeightsCache]:
    """Keep weights for as long as they are needed: pytest keeps what tests leave, and these take a gigabyte."""
    root = tmp_path_factory.mktemp("cache")
    yield write_weights(root)
    shutil.rmtree(root)


@pytest.fixture(scope="session")
def maps(tmp_path_factory) -> Path:
    """Make the directory of saved maps."""
    return tmp_path_factory.mktemp("maps")


@pytest.fixture(scope="session")
def parameters(maps) -> Callable[[str], dict[str, object]]:
    """Return every parameter of a node or pipeline with the trio of a name."""

    def of_trio(name: str) -> dict[str, object]:
        return {**SETTINGS, "node.map_directory": str(maps), "encoder.name": name}

    return of_trio


@pytest.fixture
def cached(cache, monkeypatch) -> None:
    """Let this process find the weights, too."""
    for variable, value in cache.environment.items():
        monkeypatch.setenv(variable, value)
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(Path(cache.environment["HF_HOME"]) / "hub"))
    expect_random_weights(monkeypatch.setattr)


@pytest.fixture(scope="session")
def config(parameters) -> Callable[[str], Config]:
    return lambda name: Config().with_values(parameters(name))
