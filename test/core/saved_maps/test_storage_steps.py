"""A save step by step: every step may be the last one, or fail, and what must last lasts before it is relied on."""

from __future__ import annotations

import errno
import fcntl
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from core.saved_maps.saved_maps import INFO, assert_equal_states, files_of, filled_map

from fus3dmaps_core.errors import StorageError
from fus3dmaps_core.saved_maps.files import LOCK
from fus3dmaps_core.saved_maps.storage import SavedMap, load_map, read_manifest, save_map
from fus3dmaps_core.voxel_map.semantic_map import SemanticMap

STEPS = ((os, "open"), (os, "fsync"), (np, "save"), (Path, "mkdir"), (Path, "open"), (Path, "replace"))
"""What a save does to the file system until it is committed."""


def intercept(monkeypatch, steps, before: Callable[[str, tuple], None]) -> None:
    """Call ``before`` with name and arguments ahead of each step."""
    for holder, name in steps:
        original = getattr(holder, name)

        def step(*args, _original=original, _name=name, **kwargs):
            before(_name, args)
            return _original(*args, **kwargs)

        monkeypatch.setattr(holder, name, step)


def test_what_is_on_disk_at_every_step_is_one_of_the_two_maps(tmp_path: Path, rng, monkeypatch):
    old, new = filled_map(rng), filled_map(rng, frames=6)
    directory = tmp_path / "m"
    save_map(directory, SavedMap(old, INFO))
    copies: list[Path] = []

    copying: list[bool] = []

    def copy(*_) -> None:
        if not copying:  # Copying takes the same steps.
            copying.append(True)
            copies.append(shutil.copytree(directory, tmp_path / f"copy{len(copies)}"))
            copying.clear()

    with monkeypatch.context() as during:
        intercept(during, (*STEPS, (Path, "unlink")), copy)
        save_map(directory, SavedMap(new, INFO))
    states = {semantic_map.voxel_count: semantic_map.export_state() for semantic_map in (old, new)}
    assert len(states) == 2
    counts = []
    for path in copies:
        loaded = load_map(path)[0]
        assert_equal_states(loaded.export_state(), states[loaded.voxel_count])
        counts.append(loaded.voxel_count)
    # First the old map, from one step on the new one, and steps on both sides.
    assert counts == sorted(counts)
    assert set(counts) == set(states)

    # Each of them can be saved to, which leaves nothing of the interrupted save.
    for path in copies:
        save_map(path, SavedMap(old, INFO))
        assert {name for name in files_of(path) if name.endswith(".writing")} == set()
        assert len(files_of(path)) == len(files_of(directory))


def refusal_of(directory: Path, semantic_map: SemanticMap) -> str | None:
    """What a save says that is refused; None of one that is not."""
    try:
        save_map(directory, SavedMap(semantic_map, INFO))
    except StorageError as error:
        return str(error)
    return None


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EACCES, errno.EIO, errno.EROFS])
@pytest.mark.parametrize("replaces", [True, False], ids=["replacing", "first"])
def test_a_save_that_fails_at_any_step_changes_nothing(tmp_path: Path, rng, monkeypatch, code: int, replaces: bool):
    old, new = filled_map(rng), filled_map(rng, frames=6)
    refused, went_on, hit = 0, 0, True
    while hit:
        directory = tmp_path / str(refused + went_on) / "m"
        if replaces:
            save_map(directory, SavedMap(old, INFO))
        before = files_of(directory) if replaces else None
        steps, hit, committed = refused + went_on, False, False

        def fail(name: str, args: tuple) -> None:
            nonlocal steps, hit, committed
            if not steps and not committed:
                hit = True
                steps -= 1
                if name == "save":
                    args[0].write(b"half of it")
                raise OSError(code, os.strerror(code))
            steps -= 1
            committed |= name == "replace" and Path(args[1]).name == "manifest.json"

        with monkeypatch.context() as during:
            intercept(during, STEPS, fail)
            why = refusal_of(directory, new)
        if why is None:  # Nothing failed, or only the look for left-overs, which is not needed.
            went_on += 1
            assert_equal_states(load_map(directory)[0].export_state(), new.export_state())
            assert len(files_of(directory)) == 1 + len(read_manifest(directory).arrays)
            continue
        refused += 1
        assert os.strerror(code) in why
        assert str(directory) in why
        if replaces:
            assert files_of(directory) == before
        else:
            assert not directory.parent.exists()
    assert refused > 60, "not every step was made to fail"
    assert went_on <= 2


def test_what_is_renamed_lasts_and_names_last_before_the_manifest_speaks_of_them(tmp_path: Path, rng, monkeypatch):
    directory = tmp_path / "maps" / "m"
    save_map(directory, SavedMap(filled_map(rng), INFO))
    events: list[tuple[str, str]] = []

    def record(name: str, args: tuple) -> None:
        if name == "fsync":
            events.append((name, Path(f"/proc/self/fd/{args[0]}").readlink().name))
        elif name == "replace":
            events.append((name, Path(args[0]).name))
        elif name == "unlink":
            events.append((name, Path(args[0]).suffix))

    intercept(monkeypatch, ((os, "fsync"), (Path, "replace"), (Path, "unlink")), record)
    save_map(directory, SavedMap(filled_map(rng, frames=6), INFO))
    monkeypatch.undo()
    manifest = ".manifest.json.writing"
    commit = events.index(("replace", manifest))
    renamed = [name for kind, name in events[:commit] if kind == "replace"]
    assert len(renamed) > 10
    for name in (*renamed, manifest):
        assert events.index(("fsync", name)) < events.index(("replace", name)), name
    last_rename = max(index for index, (kind, _) in enumerate(events[:commit]) if kind == "replace")
    assert ("fsync", "m") in events[last_rename:commit]
    first_removal = min(index for index, (kind, _) in enumerate(events) if kind == "unlink")
    assert ("fsync", "m") in events[commit:first_removal]


def test_a_new_directory_lasts(tmp_path: Path, rng, monkeypatch):
    synced: list[str] = []
    intercept(monkeypatch, ((os, "fsync"),), lambda _, args: synced.append(Path(f"/proc/self/fd/{args[0]}").readlink().name))
    save_map(tmp_path / "maps" / "m", SavedMap(filled_map(rng), INFO))
    assert {tmp_path.name, "maps", "m"} <= set(synced)


def test_a_map_that_is_being_saved_elsewhere_is_refused_by_name(tmp_path: Path, rng):
    directory = tmp_path / "kitchen"
    save_map(directory, SavedMap(filled_map(rng), INFO))
    before = files_of(directory)
    with (directory / LOCK).open("rb") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        (directory / ".dense_weight.0123456789abcdef.npy.writing").write_bytes(b"of the other saver")
        with pytest.raises(StorageError, match=r"kitchen.*is being saved by another"):
            save_map(directory, SavedMap(filled_map(rng), INFO))
        leftover = {".dense_weight.0123456789abcdef.npy.writing": b"of the other saver"}
        assert files_of(directory) == before | leftover
        load_map(directory)
    save_map(directory, SavedMap(filled_map(rng), INFO))
    assert not leftover.keys() & files_of(directory).keys()
