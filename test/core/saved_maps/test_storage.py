"""Saved maps: exact, complete or absent, and refused by name when they do not fit."""

from __future__ import annotations

import threading
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from core.saved_maps.saved_maps import INFO, assert_equal_states, edit_manifest, files_of, filled_map
from hypothesis import given
from hypothesis import strategies as st
from reference.variants import DTYPES

from fus3dmaps_core.config.schema import Config, MapConfig
from fus3dmaps_core.errors import StorageError
from fus3dmaps_core.saved_maps.manifest import Manifest
from fus3dmaps_core.saved_maps.storage import (
    MapInfo,
    SavedMap,
    check_fits,
    check_map_target,
    load_map,
    read_manifest,
    restore_map,
    save_map,
)
from fus3dmaps_core.voxel_map.layer_query import LayerQuery
from fus3dmaps_core.voxel_map.layers.similarity import LAYERS
from fus3dmaps_core.voxel_map.semantic_map import SemanticMap


def cosines(semantic_map: SemanticMap, layer: str) -> np.ndarray:
    return np.stack([semantic_map.search(LayerQuery(layer, prompt[None])).similarity for prompt in np.eye(2, 6)])


@pytest.mark.parametrize("dtype", DTYPES)
def test_a_saved_map_comes_back_bit_for_bit_and_goes_on(tmp_path: Path, rng, dtype: str):
    original = filled_map(rng, dtype)
    info = MapInfo("lite", 12.5, "odom", 77, Config.from_flat({"map.dtype": dtype}), INFO.camera_poses)
    save_map(tmp_path / "m", SavedMap(original, info))
    loaded, loaded_info = load_map(tmp_path / "m")
    assert_equal_states(original.export_state(), loaded.export_state())
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
    assert_equal_states(original.export_state(), loaded.export_state())
    for layer in LAYERS:
        # Dense rows lie in another order than before, which sums of them feel in the last bit.
        np.testing.assert_allclose(cosines(original, layer), cosines(loaded, layer), atol=1e-6)


def test_an_empty_map_comes_back(tmp_path: Path):
    empty = SemanticMap(6, MapConfig(), 2.0)
    save_map(tmp_path / "m", SavedMap(empty, MapInfo("lite", 1.0, "map", 0, Config(), np.zeros((0, 4, 4)))))
    loaded, info = load_map(tmp_path / "m")
    assert_equal_states(empty.export_state(), loaded.export_state())
    assert info.camera_poses.shape == (0, 4, 4)


numbers = st.floats(allow_nan=False, allow_infinity=False)
stamps = st.integers(-(2**63), 2**63 - 1)


@given(logit_scale=numbers, variance_ratio=numbers, stamp_ns=stamps, saved_ns=stamps, frame=st.text(min_size=1))
def test_a_manifest_says_the_same_when_read(
    tmp_path_factory, logit_scale: float, variance_ratio: float, stamp_ns: int, saved_ns: int, frame: str
):
    directory = tmp_path_factory.mktemp("manifest")
    manifest = Manifest(
        saved_ns=saved_ns,
        encoder="lite",
        logit_scale=logit_scale,
        map_frame=frame,
        stamp_ns=stamp_ns,
        dimension=6,
        variance_ratio=variance_ratio,
        config=Config(),
        arrays={},
    )
    (directory / "manifest.json").write_bytes(manifest.encode())
    assert read_manifest(directory).model_dump(exclude={"sha256"}) == manifest.model_dump(exclude={"sha256"})


def test_the_size_returned_is_that_of_the_files(tmp_path: Path, rng):
    size_bytes = save_map(tmp_path / "m", SavedMap(filled_map(rng), INFO))
    assert size_bytes == sum(len(content) for content in files_of(tmp_path / "m").values())


def test_the_time_of_the_save_is_kept(tmp_path: Path, rng):
    save_map(tmp_path / "m", SavedMap(filled_map(rng), INFO), saved_ns=1_700_000_000_000_000_001)
    assert read_manifest(tmp_path / "m").saved_ns == 1_700_000_000_000_000_001


def test_saving_again_replaces_and_leaves_nothing_else(tmp_path: Path, rng):
    save_map(tmp_path / "m", SavedMap(filled_map(rng), INFO))
    bigger = filled_map(rng, frames=6)
    save_map(tmp_path / "m", SavedMap(bigger, INFO))
    assert_equal_states(load_map(tmp_path / "m")[0].export_state(), bigger.export_state())
    assert [path.name for path in tmp_path.iterdir()] == ["m"]
    assert len(files_of(tmp_path / "m")) == 1 + len(read_manifest(tmp_path / "m").arrays)


def test_unchanged_arrays_are_not_written_again(tmp_path: Path, rng):
    semantic_map = filled_map(rng)
    save_map(tmp_path / "m", SavedMap(semantic_map, INFO))
    before = {path.name: path.stat().st_ino for path in (tmp_path / "m").glob("*.npy")}
    points = np.zeros((5, 3))  # In a voxel that is known: weights, embeddings and colours change, places do not.
    semantic_map.integrate_dense(points, np.zeros(5, int), np.eye(1, 6), np.ones(1), np.zeros((5, 3), np.uint8))
    save_map(tmp_path / "m", SavedMap(semantic_map, INFO))
    after = {path.name: path.stat().st_ino for path in (tmp_path / "m").glob("*.npy")}
    kept = {name.split(".")[0] for name, _ in before.items() & after.items()}
    assert {"voxel_coordinates", "instance_embedding", "camera_poses"} <= kept
    assert not {"dense_embedding", "dense_weight"} & kept
    assert_equal_states(load_map(tmp_path / "m")[0].export_state(), semantic_map.export_state())


def test_a_damaged_array_is_written_anew(tmp_path: Path, rng):
    semantic_map = filled_map(rng)
    save_map(tmp_path / "m", SavedMap(semantic_map, INFO))
    for path in (tmp_path / "m").glob("*.npy"):
        path.write_bytes(path.read_bytes()[:-1] + b"\x55")
    save_map(tmp_path / "m", SavedMap(semantic_map, INFO))
    assert_equal_states(load_map(tmp_path / "m")[0].export_state(), semantic_map.export_state())


def test_a_save_holds_one_copy_of_the_map_in_memory(tmp_path: Path):
    class Large:
        dimension, variance_ratio = 6, 2.0

        def export_state(self) -> dict[str, np.ndarray]:
            return {"first": np.ones((1 << 24,), np.float32), "second": np.zeros((1 << 24,), np.float32)}

    tracemalloc.start()
    try:
        save_map(tmp_path / "m", SavedMap(Large(), INFO))
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 2 * (4 << 24) + (40 << 20)


def test_files_of_others_in_a_map_are_left_alone(tmp_path: Path, rng):
    save_map(tmp_path / "m", SavedMap(filled_map(rng), INFO))
    for name in ("notes.txt", "weights.npy", ".hidden"):
        (tmp_path / "m" / name).write_text("precious")
    save_map(tmp_path / "m", SavedMap(filled_map(rng), INFO))
    for name in ("notes.txt", "weights.npy", ".hidden"):
        assert (tmp_path / "m" / name).read_text() == "precious"


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("chapter1.tex", "precious"),
        ("dense_embedding.npy", "precious"),
        ("manifest.json", '{"name": "a browser extension", "version": 2}'),
        ("manifest.json", '{"format": "fus3dmaps-map", "version": 1}'),
        ("manifest.json", "no JSON"),
    ],
)
def test_a_directory_that_is_no_map_is_not_replaced(tmp_path: Path, rng, name: str, content: str):
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / name).write_text(content)
    for refused in (check_map_target, lambda directory: save_map(directory, SavedMap(filled_map(rng), INFO))):
        with pytest.raises(StorageError, match="thesis"):
            refused(tmp_path / "thesis")
        assert files_of(tmp_path / "thesis") == {name: content.encode()}


def test_a_file_is_not_replaced(tmp_path: Path, rng):
    (tmp_path / "thesis").write_text("precious")
    for place in ("thesis", "thesis/m"):
        with pytest.raises(StorageError, match="thesis"):
            save_map(tmp_path / place, SavedMap(filled_map(rng), INFO))
    assert (tmp_path / "thesis").read_text() == "precious"


def test_an_empty_directory_may_become_a_map(tmp_path: Path, rng):
    (tmp_path / "m").mkdir()
    save_map(tmp_path / "m", SavedMap(filled_map(rng), INFO))
    load_map(tmp_path / "m")


def test_a_map_is_read_whole_while_it_is_saved_again_and_again(tmp_path: Path, rng):
    maps = [filled_map(rng, frames=frames) for frames in (2, 3, 4)]
    states = {index: semantic_map.export_state() for index, semantic_map in enumerate(maps)}
    infos = [MapInfo("lite", 1.0, "map", index, Config(), INFO.camera_poses) for index in states]
    save_map(tmp_path / "m", SavedMap(maps[0], infos[0]))

    def save_often() -> None:
        for turn in range(60):
            save_map(tmp_path / "m", SavedMap(maps[turn % 3], infos[turn % 3]))

    saver = threading.Thread(target=save_often)
    saver.start()
    loads = 0
    while saver.is_alive() or not loads:
        loaded, info = load_map(tmp_path / "m")
        assert_equal_states(loaded.export_state(), states[info.stamp_ns])
        loads += 1
    saver.join()


def test_a_saved_map_becomes_the_content_of_a_running_one(tmp_path: Path, rng):
    saved, running = filled_map(rng), filled_map(rng, frames=2)
    save_map(tmp_path / "m", SavedMap(saved, INFO))
    info = restore_map(tmp_path / "m", running, Config(), "lite")
    assert_equal_states(saved.export_state(), running.export_state())
    assert info.stamp_ns == INFO.stamp_ns


@pytest.mark.parametrize(
    ("values", "encoder", "dimension", "both"),
    [
        ({}, "naradio", 6, "encoder is 'lite', here 'naradio'"),
        ({}, "lite", 7, "embedding dimension is 6, here 7"),
        ({"map.voxel_size_m": 0.1}, "lite", 6, r"voxel_size_m is 0\.05, here 0\.1"),
        ({"map.max_hypotheses": 5}, "lite", 6, "max_hypotheses is 3, here 5"),
        ({"input.map_frame": "odom"}, "lite", 6, "map_frame is 'map', here 'odom'"),
        ({"map.voxel_size_m": 0.1}, "naradio", 6, r"encoder .* map\.voxel_size_m"),
    ],
)
def test_a_map_that_does_not_fit_is_refused_with_both_values(
    tmp_path: Path, rng, values: dict, encoder: str, dimension: int, both: str
):
    save_map(tmp_path / "kitchen", SavedMap(filled_map(rng), INFO))
    config = Config.from_flat(values)
    running = SemanticMap(dimension, config.map, 2.0)
    running.integrate_proposals(np.zeros((4, 3)), np.zeros(4, int), np.eye(1, dimension))
    before = running.export_state()
    with pytest.raises(StorageError, match=f"kitchen.*{both}"):
        restore_map(tmp_path / "kitchen", running, config, encoder)
    assert_equal_states(before, running.export_state())


@pytest.mark.parametrize(("weights", "warns"), [("", False), ("/models/mine", True)])
def test_other_weights_under_the_same_name_are_warned_of(tmp_path: Path, rng, caplog, weights: str, warns: bool):
    save_map(tmp_path / "m", SavedMap(filled_map(rng), INFO))
    config = Config.from_flat({"encoder.weights": weights})
    restore_map(tmp_path / "m", filled_map(rng, frames=1), config, "lite")
    assert ("built with encoder.weights '', here they are '/models/mine'" in caplog.text) == warns


def test_what_need_not_agree_is_not_asked_for(tmp_path: Path, rng):
    save_map(tmp_path / "m", SavedMap(filled_map(rng), INFO))
    config = Config.from_flat({"map.dtype": "int8", "map.iou_threshold": 0.5, "fusion.window_radius_m": 4.0})
    check_fits(tmp_path / "m", read_manifest(tmp_path / "m"), config, "lite", 6)


def test_a_damaged_map_leaves_the_running_one_as_it_is(tmp_path: Path, rng):
    save_map(tmp_path / "m", SavedMap(filled_map(rng), INFO))
    edit_manifest(tmp_path / "m", lambda manifest: manifest["arrays"].pop("hypothesis_id"))
    running = filled_map(rng, frames=2)
    before = running.export_state()
    with pytest.raises(StorageError, match="hypothesis_id"):
        restore_map(tmp_path / "m", running, Config(), "lite")
    assert_equal_states(before, running.export_state())


def test_a_place_without_a_map_is_named(tmp_path: Path):
    with pytest.raises(StorageError, match="nowhere"):
        load_map(tmp_path / "nowhere")
