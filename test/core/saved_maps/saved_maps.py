"""Maps to save, and how tests look at what was saved."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import numpy as np

from fus3dmaps_core.config.schema import Config, MapConfig
from fus3dmaps_core.saved_maps.storage import MapInfo
from fus3dmaps_core.voxel_map.semantic_map import SemanticMap

INFO = MapInfo("lite", 12.5, "map", 77, Config(), np.tile(np.eye(4), (3, 1, 1)))

ARRAYS = (
    "voxel_coordinates",
    "voxel_colors",
    "dense_slot",
    "dense_weight",
    "dense_embedding",
    "hypothesis_id",
    "hypothesis_count",
    "instance_id",
    "instance_weight",
    "instance_embedding",
    "fused_embedding",
    "fused_evidence",
    "next_instance_id",
    "camera_poses",
)
"""Arrays of a map whose dense embeddings are not int8."""


def filled_map(rng: np.random.Generator, dtype: str = "float16", frames: int = 4) -> SemanticMap:
    """A map of some hundred voxels with d = 6."""
    semantic_map = SemanticMap(6, MapConfig(dtype=dtype), 2.0)
    for _ in range(frames):
        points = rng.uniform(-0.4, 0.4, (200, 3))
        semantic_map.integrate_dense(
            points,
            rng.integers(0, 12, 200),
            rng.normal(size=(12, 6)),
            np.ones(12),
            rng.integers(0, 256, (200, 3), dtype=np.uint8),
        )
        semantic_map.integrate_proposals(points * 0.6, rng.integers(0, 3, 200), rng.normal(size=(3, 6)))
    semantic_map.fuse()
    return semantic_map


def assert_equal_states(first: dict[str, np.ndarray], second: dict[str, np.ndarray]) -> None:
    """Two exported states are the same to the bit."""
    assert first.keys() == second.keys()
    for name, array in first.items():
        assert (array.dtype, array.shape) == (second[name].dtype, second[name].shape), name
        assert array.tobytes() == second[name].tobytes(), name


def array_file(directory: Path, name: str) -> Path:
    """File of an array, found by its name alone."""
    (path,) = directory.glob(f"{name}.*.npy")
    return path


def files_of(directory: Path) -> dict[str, bytes]:
    """Content of every file of a directory but the lock, which is empty, by name."""
    return {path.name: path.read_bytes() for path in directory.iterdir() if path.name != ".lock"}


def edit_manifest(directory: Path, change) -> None:
    """Change a manifest's JSON and give it the checksum that it then should have."""
    path = directory / "manifest.json"
    tree = json.loads(path.read_text())
    change(tree)
    content = json.dumps({**tree, "sha256": "0" * 64}).encode()
    path.write_bytes(content)
    path.write_bytes(content.replace(b"0" * 64, hashlib.sha256(content).hexdigest().encode()))
