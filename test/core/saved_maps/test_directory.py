"""Names of maps: none leads out of the directory, and what is listed can be loaded."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from core.saved_maps.saved_maps import INFO, edit_manifest, filled_map
from hypothesis import example, given
from hypothesis import strategies as st

from fus3dmaps_core.errors import StorageError
from fus3dmaps_core.saved_maps.directory import MAX_NAME_BYTES, list_maps, map_path, map_root
from fus3dmaps_core.saved_maps.storage import SavedMap, load_map, save_map


@pytest.fixture(scope="module")
def root(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("maps")


@pytest.mark.parametrize(
    "name", ["kitchen", "ground floor", "Küche", "a.b", "2026-01-31T12:00:00", "x" * MAX_NAME_BYTES, "~"]
)
def test_a_name_is_a_place_in_the_directory(root: Path, name: str):
    assert map_path(root, name) == root / name
    assert map_path(str(root), name) == root / name


@pytest.mark.parametrize(
    "name",
    [
        "",
        ".",
        "..",
        "../kitchen",
        "/etc",
        "a/b",
        "a/../../b",
        "kitchen/",
        "a\\b",
        ".hidden",
        ".lock",
        "a\0b",
        "a\nb",
        "a\x1b[31mb",
        "\x7f",
        "a\u202eb",
        "\ud800",
        " ",
        " a",
        "a ",
        "x" * (MAX_NAME_BYTES + 1),
        "ü" * (MAX_NAME_BYTES // 2 + 1),
        "x" * 1_000_000,
    ],
)
def test_what_is_no_name_is_refused(root: Path, name: str):
    with pytest.raises(StorageError, match="cannot be the name of a map") as refusal:
        map_path(root, name)
    assert len(str(refusal.value)) < 2_000
    str(refusal.value).encode()


@given(st.text() | st.text(alphabet="./\\~a\0 \n"))
@example("..")
@example("a/..")
def test_a_path_never_leads_out(root: Path, name: str):
    try:
        path = map_path(root, name)
    except StorageError:
        return
    # By the operating system's own reading of the path.
    assert os.path.realpath(os.path.dirname(os.path.join(root, name))) == os.path.realpath(root)  # noqa: PTH118, PTH120
    assert os.path.normpath(path) == os.fspath(root / name)
    assert path.parent == root
    assert len(name.encode()) <= MAX_NAME_BYTES
    path.mkdir()
    assert [entry.name for entry in root.iterdir()] == [name]
    path.rmdir()


def test_symbolic_links_may_not_lead_out(tmp_path: Path):
    root, elsewhere = tmp_path / "maps", tmp_path / "elsewhere"
    (root / "kitchen").mkdir(parents=True)
    elsewhere.mkdir()
    links = {
        "out": elsewhere,
        "up": "..",
        "root": ".",
        "passwd": "/etc/passwd",
        "later": tmp_path / "not_there",
        "loop": "loop",
    }
    for name, target in links.items():
        (root / name).symlink_to(target)
        with pytest.raises(StorageError, match=name):
            map_path(root, name)
    (root / "latest").symlink_to("kitchen")
    assert map_path(root, "latest") == root / "latest"


def test_the_directory_itself_may_be_a_link(tmp_path: Path):
    (tmp_path / "disk").mkdir()
    (tmp_path / "maps").symlink_to("disk")
    assert map_path(tmp_path / "maps", "kitchen") == tmp_path / "maps" / "kitchen"


def test_the_home_directory_is_expanded(tmp_path: Path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    assert map_root("~/.ros/fus3dmaps") == tmp_path / ".ros" / "fus3dmaps"
    assert map_path("~/.ros/fus3dmaps", "kitchen") == tmp_path / ".ros" / "fus3dmaps" / "kitchen"
    with pytest.raises(StorageError, match="nobody_of_this_name"):
        map_path("~nobody_of_this_name/maps", "kitchen")


def test_a_relative_directory_is_that_of_the_process(tmp_path: Path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert map_path("maps", "kitchen") == tmp_path / "maps" / "kitchen"


def test_maps_are_listed_by_the_time_of_their_save(tmp_path: Path):
    semantic_map = filled_map(np.random.default_rng(2))
    for name, saved_ns in (("b", 30), ("oldest", 10), ("newest", 40), ("a", 30)):
        save_map(map_path(tmp_path, name), SavedMap(semantic_map, INFO), saved_ns=saved_ns)
    os.utime(tmp_path / "oldest" / "manifest.json")  # Times of files do not count: copies of maps have others.
    assert list_maps(tmp_path) == ["newest", "a", "b", "oldest"]
    load_map(map_path(tmp_path, "newest"))


def test_what_cannot_be_read_is_not_listed(tmp_path: Path):
    semantic_map = filled_map(np.random.default_rng(2))
    for age, name in enumerate(("good", "other_version", "damaged", "killed", ".hidden")):
        save_map(tmp_path / name, SavedMap(semantic_map, INFO), saved_ns=age)
    edit_manifest(tmp_path / "other_version", lambda manifest: manifest.update(version=3))
    (tmp_path / "damaged" / "manifest.json").write_text("{")
    (tmp_path / "killed" / "manifest.json").unlink()
    (tmp_path / "notes.txt").write_text("no map")
    (tmp_path / "empty").mkdir()
    (tmp_path / "out").symlink_to(tmp_path.parent)
    assert list_maps(tmp_path) == ["good"]


def test_a_directory_without_maps_has_none(tmp_path: Path):
    for root in (tmp_path, tmp_path / "not_there"):
        assert list_maps(root) == []


def test_a_directory_that_cannot_be_listed_is_named(tmp_path: Path):
    (tmp_path / "file").write_text("")
    with pytest.raises(StorageError, match="file"):
        list_maps(tmp_path / "file")
    with pytest.raises(StorageError, match="maps"):
        list_maps("maps\0")
