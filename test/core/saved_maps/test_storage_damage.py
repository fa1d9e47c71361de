"""Damaged maps: whatever is altered, cut off, missing or made up is refused, and the file is named."""

from __future__ import annotations

import hashlib
import json
import os
import re
from pathlib import Path

import numpy as np
import pytest
from core.saved_maps.saved_maps import ARRAYS, INFO, array_file, edit_manifest, filled_map
from hypothesis import given, settings
from hypothesis import strategies as st

from fus3dmaps_core.errors import StorageError
from fus3dmaps_core.saved_maps.storage import SavedMap, load_map, save_map


@pytest.fixture(scope="module")
def kept(tmp_path_factory) -> Path:
    """A map that every test leaves as it found it."""
    directory = tmp_path_factory.mktemp("kept") / "m"
    save_map(directory, SavedMap(filled_map(np.random.default_rng(4)), INFO))
    return directory


@pytest.fixture
def saved(tmp_path: Path, rng) -> Path:
    save_map(tmp_path / "m", SavedMap(filled_map(rng), INFO))
    return tmp_path / "m"


def refused_with(path: Path, content: bytes, directory: Path) -> None:
    """The map is refused by the file's name while the file has other content, and read again afterwards."""
    intact = path.read_bytes()
    path.write_bytes(content)
    try:
        with pytest.raises(StorageError, match=re.escape(path.name)):
            load_map(directory)
    finally:
        path.write_bytes(intact)
    load_map(directory)


def test_these_are_the_arrays(kept: Path):
    assert {path.name.split(".")[0] for path in kept.glob("*.npy")} == set(ARRAYS)


@given(name=st.sampled_from(ARRAYS), place=st.floats(0, 1, exclude_max=True), bit=st.integers(0, 7))
@settings(max_examples=200)
def test_a_flipped_bit_of_an_array_is_found(kept: Path, name: str, place: float, bit: int):
    path = array_file(kept, name)
    content = bytearray(path.read_bytes())
    content[int(place * len(content))] ^= 1 << bit
    refused_with(path, bytes(content), kept)


@given(place=st.floats(0, 1, exclude_max=True), bit=st.integers(0, 7))
@settings(max_examples=200)
def test_a_flipped_bit_of_the_manifest_is_found(kept: Path, place: float, bit: int):
    path = kept / "manifest.json"
    content = bytearray(path.read_bytes())
    content[int(place * len(content))] ^= 1 << bit
    refused_with(path, bytes(content), kept)


@pytest.mark.parametrize("name", ARRAYS)
def test_an_array_that_is_missing_cut_off_or_longer_is_named(kept: Path, name: str):
    path = array_file(kept, name)
    intact = path.read_bytes()
    for length in {0, 1, 10, len(intact) // 2, len(intact) - 1}:
        refused_with(path, intact[:length], kept)
    refused_with(path, intact + b"\0", kept)
    path.unlink()
    with pytest.raises(StorageError, match=re.escape(path.name)):
        load_map(kept)
    path.mkdir()
    with pytest.raises(StorageError, match=re.escape(path.name)):
        load_map(kept)
    path.rmdir()
    path.write_bytes(intact)
    load_map(kept)


@pytest.mark.parametrize(
    "content",
    [b"", b"no JSON", b"[]", b"{}", b"null", b"\xff\xfe", b"[" * 100_000, b" " * (2 << 20), b'{"format": "fus3dmaps-map"}'],
)
def test_a_manifest_that_is_none_is_named(kept: Path, content: bytes):
    refused_with(kept / "manifest.json", content, kept)


def test_a_manifest_that_is_cut_off_is_named(kept: Path):
    content = (kept / "manifest.json").read_bytes()
    for length in range(1, len(content), 97):
        refused_with(kept / "manifest.json", content[:length], kept)


def test_a_map_without_manifest_is_none(saved: Path):
    (saved / "manifest.json").unlink()
    with pytest.raises(StorageError, match=r"no manifest\.json"):
        load_map(saved)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda manifest: manifest.update(version=99), "format version 99; this program reads 2"),
        (lambda manifest: manifest.update(version=1), "format version 1; this program reads 2"),
        (lambda manifest: manifest.update(version="2"), "version"),
        (lambda manifest: manifest.update(format="other"), "manifest"),
        (lambda manifest: manifest.update(dimension=7), "dense_embedding"),
        (lambda manifest: manifest.update(dimension=0), "dimension"),
        (lambda manifest: manifest.update(dimension=10**12), "dimension"),
        (lambda manifest: manifest["arrays"].pop("hypothesis_id"), "hypothesis_id"),
        (lambda manifest: manifest["arrays"].pop("camera_poses"), "camera_poses"),
        (lambda manifest: manifest["arrays"].update(camera_poses=manifest["arrays"]["voxel_colors"]), "camera_poses"),
        (lambda manifest: manifest["arrays"]["camera_poses"].update(dtype="float32"), "camera_poses"),
        (lambda manifest: manifest["arrays"]["camera_poses"].update(shape=[48]), "camera_poses"),
        (lambda manifest: manifest["arrays"]["camera_poses"].update(sha256="../../x"), "camera_poses.sha256"),
        (lambda manifest: manifest.update(arrays=[]), "arrays"),
        (lambda manifest: manifest.pop("encoder"), "encoder"),
        (lambda manifest: manifest.update(logit_scale=None), "logit_scale"),
        (lambda manifest: manifest.pop("config"), "config"),
        (lambda manifest: manifest["config"].update({"map.voxel_size_m": -1}), "voxel_size_m"),
        (lambda manifest: manifest["config"].update({"map.of_tomorrow": 1}), "of_tomorrow"),
    ],
)
def test_a_manifest_that_does_not_fit_is_refused(saved: Path, change, message: str):
    edit_manifest(saved, change)
    with pytest.raises(StorageError, match=message):
        load_map(saved)


@pytest.mark.parametrize("name", ["../../etc/passwd", "/etc/passwd", "a/b", "..", ".", "", "a\0b", "Ä", "a.b", "x" * 65])
def test_an_array_whose_name_leads_elsewhere_is_refused(saved: Path, name: str):
    edit_manifest(saved, lambda manifest: manifest["arrays"].update({name: manifest["arrays"]["camera_poses"]}))
    with pytest.raises(StorageError, match=r"manifest\.json' does not describe a map: arrays"):
        load_map(saved)


def test_pickled_arrays_are_not_read(saved: Path):
    class Opened:
        def __reduce__(self):
            return os.mkdir, (str(saved / "was_unpickled"),)

    old = array_file(saved, "camera_poses")
    np.save(old, np.array([Opened()], dtype=object), allow_pickle=True)
    content = old.read_bytes()
    digest = hashlib.sha256(content).hexdigest()
    old.rename(saved / f"camera_poses.{digest[:16]}.npy")
    edit_manifest(saved, lambda manifest: manifest["arrays"]["camera_poses"].update(sha256=digest, size_bytes=len(content)))
    with pytest.raises(StorageError, match="camera_poses"):
        load_map(saved)
    assert not (saved / "was_unpickled").exists()


def test_values_that_no_map_can_have_are_refused(saved: Path):
    """The checksums are right, so that whoever wrote this was at fault."""
    old = array_file(saved, "dense_weight")
    np.save(old, -np.load(old))
    content = old.read_bytes()
    digest = hashlib.sha256(content).hexdigest()
    old.rename(saved / f"dense_weight.{digest[:16]}.npy")
    edit_manifest(saved, lambda manifest: manifest["arrays"]["dense_weight"].update(sha256=digest))
    with pytest.raises(StorageError, match="dense_weight"):
        load_map(saved)


def test_the_manifest_is_plain_json(saved: Path):
    manifest = json.loads((saved / "manifest.json").read_text())
    assert manifest["arrays"]["dense_embedding"]["dtype"] == "float16"
