"""The examples and the Python of the README run as they stand, are as short as promised, and find what is there."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from fus3dmaps_core.recordings.writer import RecordingWriter
from fus3dmaps_lab.simulation.room.furnished_room import FurnishedRoom

ROOT = Path(__file__).resolve().parents[2]
FRAMES = 4
CAT_M = (-1.2, 2.28, 1.27)
"""Where the photograph of a cat hangs in the room."""


@pytest.fixture(scope="module")
def room() -> FurnishedRoom:
    return FurnishedRoom(frames=FRAMES)


def snippets() -> list[str]:
    """Blocks of Python in the README."""
    return re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)


def run(script: str, *arguments: str) -> str:
    command = [sys.executable, str(ROOT / "examples" / script), *arguments]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, env={**os.environ, "PYTHONPATH": str(ROOT)})
    assert done.returncode == 0, done.stderr
    return done.stdout


def position_of(prompt: str, printed: str) -> np.ndarray:
    """The place of the best answer to a prompt in a printed answer, metres."""
    found = re.search(rf"\d+\. {prompt}: score [\d.]+ at \(([^)]*)\) m", printed)
    assert found, printed
    return np.array([float(value) for value in found[1].split(",")])


def test_a_map_from_arrays_and_a_saved_map_asked_take_as_few_lines_as_promised(room, tmp_path, monkeypatch, capsys):
    arrays, saved = snippets()
    assert len(arrays.splitlines()) <= 12
    assert len(saved.splitlines()) <= 4
    monkeypatch.chdir(tmp_path)
    names = {"frames": [(frame.stamp_ns, frame.rgb, frame.depth_m, frame.T_world_camera) for frame in room]}
    exec(arrays, names)  # noqa: S102  (the code is the README's)
    assert np.linalg.norm(position_of("a pet that meows", capsys.readouterr().out) - CAT_M) < 0.3
    assert names["camera"] == room.intrinsics
    mapped = names["pipeline"].ask("a place to sit")
    exec(saved, names)  # noqa: S102
    assert capsys.readouterr().out == f"{mapped}\n"
    assert [each.id for each in names["answer"].instances] == [each.id for each in mapped.instances]


@pytest.mark.parametrize("script", sorted(path.name for path in (ROOT / "examples").glob("*.py")))
def test_examples_are_short(script: str):
    assert len((ROOT / "examples" / script).read_text().splitlines()) <= 40


def test_arrays_are_mapped_asked_and_saved(tmp_path):
    printed = run("from_arrays.py", str(tmp_path / "room"), str(FRAMES))
    assert np.linalg.norm(position_of("a pet that meows", printed) - CAT_M) < 0.3
    assert (tmp_path / "room" / "manifest.json").is_file()


def test_a_recording_is_mapped_saved_and_asked(room, tmp_path):
    with RecordingWriter(tmp_path / "room.mcap") as writer:
        for frame in room:
            writer.write(frame)
    printed = run("from_a_recording.py", str(tmp_path / "room.mcap"), str(tmp_path / "room"), "a pet that meows")
    assert np.linalg.norm(position_of("a pet that meows", printed) - CAT_M) < 0.3


def test_encoders_of_your_own_map():
    assert re.search(r"\d+\. brown: score 0\.[89]", run("own_encoder.py"))
