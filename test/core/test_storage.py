"""Saved maps: exact, complete or absent, and refused by name when anything is wrong."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from reference.variants import DTYPES

from fus3dmaps_core.config import Config, MapConfig
from fus3dmaps_core.errors import StorageError
from fus3dmaps_core.layers.similarity import LAYERS
from fus3dmaps_core.semantic_map import SemanticMap
from fus3dmaps_core.storage import MapInfo, load_map, save_map


def filled_map(rng: np.random.Generator, dtype: str = "float32", frames: int = 4) -> SemanticMap:
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


def cosines(semantic_map: SemanticMap, layer: str) -> np.ndarray:
    return np.stack([semantic_map.search(layer, prompt[None]).similarity for prompt in np.eye(2, 6)])


INFO = MapInfo("lite", 12.5, "map", 77, Config(), np.tile(np.eye(4), (3, 1, 1)))


@pytest.mark.parametrize("dtype", DTYPES)
def test_a_saved_map_comes_back_bit_for_bit_and_goes_on(tmp_path: Path, rng, dtype: str):
    original = filled_map(rng, dtype)
    info = MapInfo("lite", 12.5, "odom", 77, Config.from_flat({"map.dtype": dtype}), INFO.camera_poses)
    save_map(tmp_path / "m", original, info)
    loaded, loaded_info = load_map(tmp_path / "m")
    assert (loaded_info.encoder, loaded_info.logit_scale, loaded_info.map_frame, loaded_info.stamp_ns) == (
        "lite",
        12.5,
        "odom",
        77,
    )
    assert loaded_info.config == info.config
    np.testing.assert_array_equal(loaded_info.camera_poses, info.camera_poses)

    # Both go on in the same way, so nothing that matters was left out of the file.
    more = np.random.default_rng(5)
    points = more.uniform(-0.5, 0.5, (150, 3))
    for semantic_map in (original, loaded):
        semantic_map.integrate_dense(points, np.arange(150) % 4, np.eye(4, 6), np.ones(4), np.zeros((150, 3), np.uint8))
        semantic_map.integrate_proposals(points, np.arange(150) % 2, np.eye(2, 6))
    first, second = original.export_state(), loaded.export_state()
    assert first.keys() == second.keys()
    for name in first:
        assert first[name].dtype == second[name].dtype
        np.testing.assert_array_equal(first[name], second[name], err_msg=name)
    for layer in LAYERS:
        # Dense rows lie in another order than before, which sums of them feel in the last bit.
        np.testing.assert_allclose(cosines(original, layer), cosines(loaded, layer), atol=1e-6)


def test_saving_again_replaces_and_leaves_nothing_else(tmp_path: Path, rng):
    save_map(tmp_path / "m", filled_map(rng), INFO)
    bigger = filled_map(rng, frames=6)
    save_map(tmp_path / "m", bigger, INFO)
    assert load_map(tmp_path / "m")[0].voxel_count == bigger.voxel_count
    assert [path.name for path in tmp_path.iterdir()] == ["m"]


def test_a_directory_that_is_no_map_is_not_replaced(tmp_path: Path, rng):
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "chapter1.tex").write_text("precious")
    with pytest.raises(StorageError, match="thesis"):
        save_map(tmp_path / "thesis", filled_map(rng), INFO)
    assert (tmp_path / "thesis" / "chapter1.tex").read_text() == "precious"


def test_a_failed_write_keeps_the_old_map(tmp_path: Path, rng, monkeypatch):
    save_map(tmp_path / "m", filled_map(rng), INFO)
    before = load_map(tmp_path / "m")[0].export_state()

    def full_disk(*args, **kwargs):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "save", full_disk)
    with pytest.raises(StorageError, match="No space left"):
        save_map(tmp_path / "m", filled_map(rng, frames=7), INFO)
    monkeypatch.undo()
    after = load_map(tmp_path / "m")[0].export_state()
    assert all(np.array_equal(before[name], after[name]) for name in before)
    assert [path.name for path in tmp_path.iterdir()] == ["m"]


@pytest.fixture
def saved(tmp_path: Path, rng) -> Path:
    save_map(tmp_path / "m", filled_map(rng), INFO)
    return tmp_path / "m"


def edit(saved: Path, change) -> None:
    manifest = json.loads((saved / "manifest.json").read_text())
    change(manifest)
    (saved / "manifest.json").write_text(json.dumps(manifest))


def test_a_flipped_bit_is_found_in_every_array(saved: Path):
    for path in sorted(saved.glob("*.npy")):
        intact = path.read_bytes()
        damaged = bytearray(intact)
        damaged[-1] ^= 1
        path.write_bytes(damaged)
        with pytest.raises(StorageError, match=path.name):
            load_map(saved)
        path.write_bytes(intact)
    load_map(saved)


@pytest.mark.parametrize("name", ["dense_embedding", "voxel_coordinates", "camera_poses"])
def test_a_missing_part_is_named(saved: Path, name: str):
    (saved / f"{name}.npy").unlink()
    with pytest.raises(StorageError, match=name):
        load_map(saved)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda manifest: manifest.update(version=99), "99"),
        (lambda manifest: manifest.update(format="other"), "manifest"),
        (lambda manifest: manifest.update(dimension=7), "dense_embedding"),
        (lambda manifest: manifest["arrays"].pop("hypothesis_id"), "hypothesis_id"),
        (lambda manifest: manifest.pop("encoder"), "encoder"),
        (lambda manifest: manifest["config"].update({"map.voxel_size_m": -1}), "voxel_size_m"),
        (lambda manifest: manifest["arrays"].update({"../../etc/passwd": {"sha256": ""}}), "passwd"),
    ],
)
def test_a_manifest_that_does_not_fit_is_refused(saved: Path, change, message: str):
    edit(saved, change)
    with pytest.raises(StorageError, match=message):
        load_map(saved)


def test_pickled_arrays_are_not_read(saved: Path):
    path = saved / "camera_poses.npy"
    np.save(path, np.array([{"a": 1}], dtype=object), allow_pickle=True)
    import hashlib

    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    edit(saved, lambda manifest: manifest["arrays"]["camera_poses"].update(sha256=digest))
    with pytest.raises(StorageError, match="camera_poses"):
        load_map(saved)


def test_a_place_without_a_map_is_named(tmp_path: Path):
    with pytest.raises(StorageError, match="nowhere"):
        load_map(tmp_path / "nowhere")
