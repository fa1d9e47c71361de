"""Saving processes that are killed, that run out of room and that get into each other's way."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from core.saved_maps import saving_process
from core.saved_maps.saved_maps import assert_equal_states, files_of, filled_map

from fus3dmaps_core.saved_maps.storage import load_map, read_manifest

KILLS = 50
LONGEST_WAIT_S = 0.04  # A save of these maps takes a few milliseconds.


class Savers:
    """The process that forks savers, and the contents of what they save."""

    def __init__(self, directory: Path) -> None:
        rng = np.random.default_rng(8)
        self.states = [filled_map(rng, frames=frames).export_state() for frames in (1, 2, 3, 5)]
        paths = [directory / f"{index}.npz" for index in range(len(self.states))]
        for path, state in zip(paths, self.states, strict=True):
            np.savez(path, **state)
        self.process = subprocess.Popen(
            [sys.executable, saving_process.__file__, *map(str, paths)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "OMP_NUM_THREADS": "1"},
        )
        self._guard = threading.Timer(240, self.process.kill)
        self._guard.start()

    def close(self) -> None:
        self.process.stdin.close()
        self.process.wait(60)
        self._guard.cancel()

    def start(self, directory: Path, first: int, count: int, savers: int = 1, file_limit_bytes: int = 0) -> None:
        request = {
            "directory": str(directory),
            "first": first,
            "count": count,
            "savers": savers,
            "file_limit_bytes": file_limit_bytes,
        }
        self.process.stdin.write(json.dumps(request) + "\n")
        self.process.stdin.flush()

    def lines(self) -> Iterator[tuple[int, str, int, str]]:
        """Process, what it did, number of the map, and why not, until all savers have ended."""
        while (line := self.process.stdout.readline()) != "ended\n":
            assert line, "the process that forks savers has died"
            pid, done, number, *rest = line.rstrip("\n").split(" ", 3)
            yield int(pid), done, int(number), "".join(rest)

    def assert_holds(self, directory: Path, numbers: set[int]) -> int:
        """The map loads and is, to the bit, one of these numbers; which one."""
        loaded, info = load_map(directory)
        number = info.stamp_ns
        assert number in numbers
        assert_equal_states(loaded.export_state(), self.states[number % len(self.states)])
        np.testing.assert_array_equal(info.camera_poses, np.tile(np.eye(4) * number, (1 + number % 3, 1, 1)))
        return number


@pytest.fixture(scope="module")
def savers(tmp_path_factory) -> Iterator[Savers]:
    savers = Savers(tmp_path_factory.mktemp("contents"))
    yield savers
    savers.close()


def test_a_saver_killed_at_any_moment_leaves_the_last_good_map(savers: Savers, tmp_path: Path):
    rng = np.random.default_rng(21)
    directory = tmp_path / "m"
    savers.start(directory, 0, 1)
    list(savers.lines())
    first, interrupted, leftovers = 1, 0, 0
    good = 0
    for _ in range(KILLS):
        wait_s = rng.uniform(0, LONGEST_WAIT_S)
        savers.start(directory, first, 1_000_000)
        lines = savers.lines()
        pid, done, number, _ = next(lines)
        assert (done, number) == ("saving", first)
        time.sleep(wait_s)
        os.kill(pid, signal.SIGKILL)
        in_work = number
        for _, done, number, why in lines:
            assert done in ("saving", "saved"), why
            good, in_work = (number, in_work) if done == "saved" else (good, number)
        interrupted += in_work != good
        good = savers.assert_holds(directory, {good, in_work})
        leftovers += files_of(directory).keys() != read_manifest(directory).file_names() | {"manifest.json"}
        first = in_work + 1
    assert interrupted > 0
    assert leftovers > 0, "no kill came in the middle of a save"
    savers.start(directory, first, 1)
    assert [done for _, done, _, _ in savers.lines()] == ["saving", "saved"]
    assert files_of(directory).keys() == read_manifest(directory).file_names() | {"manifest.json"}


def test_a_first_save_that_is_killed_leaves_a_place_to_save_to(savers: Savers, tmp_path: Path):
    rng = np.random.default_rng(3)
    for turn in range(10):
        directory = tmp_path / str(turn)
        savers.start(directory, 0, 1)
        lines = savers.lines()
        pid = next(lines)[0]
        time.sleep(rng.uniform(0, 0.006))
        os.kill(pid, signal.SIGKILL)
        list(lines)
        savers.start(directory, 7, 1)
        assert [done for _, done, _, _ in savers.lines()] == ["saving", "saved"]
        savers.assert_holds(directory, {7})
        assert files_of(directory).keys() == read_manifest(directory).file_names() | {"manifest.json"}


@pytest.mark.parametrize("file_limit_bytes", [1, 200, 1_000, 4_000])
def test_files_that_cannot_grow_further_leave_the_last_good_map(savers: Savers, tmp_path: Path, file_limit_bytes: int):
    directory = tmp_path / "m"
    for first in (0, 4):  # Of the first there is nothing before, of the second a map.
        before = files_of(directory) if directory.exists() else None
        savers.start(directory, first + 3, 1, file_limit_bytes=file_limit_bytes)
        (_, done, _, _), (_, refused, _, why) = savers.lines()
        assert (done, refused) == ("saving", "refused")
        assert "File too large" in why
        assert str(directory) in why
        if before is None:
            assert not directory.exists()
        else:
            assert files_of(directory) == before
            savers.assert_holds(directory, {first})
        savers.start(directory, first + 4, 1)
        list(savers.lines())


def test_savers_at_the_same_time_take_turns_or_are_refused(savers: Savers, tmp_path: Path):
    for turn in range(10):  # Of each directory the first save is contended as well.
        directory = tmp_path / str(turn)
        savers.start(directory, 0, 12, savers=3)
        saved = set()
        for _, done, number, why in savers.lines():
            if done == "saved":
                saved.add(number)
            if done == "refused":
                assert "is being saved by another process" in why
                assert str(directory) in why
        assert saved
        savers.assert_holds(directory, saved)
        assert files_of(directory).keys() == read_manifest(directory).file_names() | {"manifest.json"}
