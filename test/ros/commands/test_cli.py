"""The ``fus3dmaps`` command from a recording to an answer, with the real default encoders, and its refusals in one line."""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from fus3dmaps_core.encoders import registry
from fus3dmaps_core.messages.images import decode_color
from fus3dmaps_core.recordings.reader import RecordingReader
from fus3dmaps_core.recordings.writer import RecordingWriter
from fus3dmaps_core.saved_maps.storage import read_manifest
from fus3dmaps_lab.simulation.room.furnished_room import FurnishedRoom
from fus3dmaps_ros.commands import cli

Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def run(monkeypatch, capsys) -> Run:
    """Runs the command in this process: exit code, stdout, stderr."""

    def command(*arguments: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["fus3dmaps", *map(str, arguments)])
        capsys.readouterr()
        with pytest.raises(SystemExit) as ended:
            cli.main()
        return int(ended.value.code or 0), *capsys.readouterr()

    return command


@pytest.fixture(scope="module")
def room() -> FurnishedRoom:
    return FurnishedRoom()


@pytest.fixture(scope="module")
def recording(room: FurnishedRoom, tmp_path_factory) -> Path:
    """The frames of the room's path that see the cat."""
    label = 1 + [thing.name for thing in room.objects].index("cat")
    seen = [index for index in range(len(room) // 2) if (room.rendering(index).labels == label).sum() > 20_000]
    path = tmp_path_factory.mktemp("room") / "cat.mcap"
    with RecordingWriter(path) as writer:
        for index in seen[:5]:
            writer.write(room.frame(index))
    return path


@pytest.fixture(scope="module")
def map_directory(recording: Path, tmp_path_factory) -> Path:
    directory = tmp_path_factory.mktemp("map") / "room"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["fus3dmaps", "map", str(recording), "--out", str(directory)])
        with pytest.raises(SystemExit) as ended:
            cli.main()
    assert not ended.value.code
    return directory


def test_map_and_query_find_the_cat_and_write_what_is_asked_for(run: Run, room, map_directory: Path, tmp_path: Path):
    png, ply = tmp_path / "cat.png", tmp_path / "cat.ply"
    code, out, _ = run("query", map_directory, "a pet that meows", "--top", 3, "--json", "--png", png, "--ply", ply)
    assert code == 0
    answers = json.loads(out)
    assert 1 <= len(answers) <= 3
    assert [set(answer) for answer in answers] == [{"id", "score", "centroid", "box_min", "box_max", "voxels"}] * len(
        answers
    )
    assert [answer["score"] for answer in answers] == sorted((answer["score"] for answer in answers), reverse=True)
    (cat,) = (thing for thing in room.objects if thing.name == "cat")
    best = answers[0]
    assert np.all(np.array(best["centroid"]) > cat.box_min_m - 0.1)
    assert np.all(np.array(best["centroid"]) < cat.box_max_m + 0.1)
    assert np.all(np.array(best["box_min"]) < best["centroid"])
    assert np.all(np.array(best["box_max"]) > best["centroid"])
    assert cv2.imread(str(png)).shape[2] == 3
    assert ply.read_bytes().startswith(b"ply")


@pytest.mark.parametrize("layer", ["dense", "fused_dense", "instances", "fused_instances"])
def test_every_layer_prints_a_table(run: Run, map_directory: Path, layer: str):
    code, out, _ = run("query", map_directory, "a pet that meows", "a soft seat", "--layer", layer, "--not", "a wall")
    assert code == 0
    assert "a pet that meows" in out
    assert "a soft seat" in out


def test_two_runs_give_the_same_files_bit_for_bit(run: Run, recording: Path, map_directory: Path, tmp_path: Path):
    figures = tmp_path / "figures.json"
    code, out, _ = run("map", recording, "--out", tmp_path / "again", "--json", figures)
    assert code == 0
    assert "keyframes/s" in out
    assert json.loads(figures.read_text())["frames"] == 5
    names = sorted(path.name for path in map_directory.iterdir())
    assert names == sorted(path.name for path in (tmp_path / "again").iterdir())
    differing = [name for name in names if (map_directory / name).read_bytes() != (tmp_path / "again" / name).read_bytes()]
    assert differing == ["manifest.json"]  # It holds the time of the save, and so another checksum.
    first, second = (json.loads((path / "manifest.json").read_text()) for path in (map_directory, tmp_path / "again"))
    assert {key for key in first if first[key] != second[key]} == {"saved_ns", "sha256"}


def test_of_a_truncated_recording_what_can_be_read_is_saved(run: Run, recording: Path, tmp_path: Path):
    truncated = tmp_path / "truncated.mcap"
    intact = recording.read_bytes()
    truncated.write_bytes(intact[: int(0.6 * len(intact))])
    code, _, err = run("map", truncated, "--out", tmp_path / "part")
    assert code == 1
    assert "truncated.mcap" in err
    assert str(tmp_path / "part") in err.replace("\n", "")
    assert run("query", tmp_path / "part", "a pet that meows", "--json")[0] == 0


def test_simulate_writes_the_rooms_frames(run: Run, room: FurnishedRoom, tmp_path: Path):
    out = tmp_path / "room.mcap"
    assert run("simulate", out, "--frames", 2)[0] == 0
    with RecordingReader(out) as reader:
        images = [reader.deserialize(raw) for raw in reader.messages() if raw.topic.endswith("rgb/image")]
    assert len(images) == 2
    np.testing.assert_array_equal(decode_color(images[0], "rgb"), FurnishedRoom(frames=2).frame(0).rgb)


def refused(result: tuple[int, str, str], *named: str) -> None:
    code, _, err = result
    assert code == 1
    assert len(err.strip().splitlines()) == 1, err
    assert "Traceback" not in err
    for word in named:
        assert word in err


def test_refusals_are_one_line_that_names_what_is_wrong(run: Run, recording: Path, map_directory: Path, tmp_path: Path):
    refused(run("query", map_directory, " "), "prompts[0]")
    refused(run("query", map_directory, "cat", "--layer", "sparse"), "layer", "sparse")
    refused(run("query", map_directory, "cat", "--not", ""), "negative_prompts[0]")
    refused(run("query", tmp_path / "no_map", "cat"), "no_map")
    refused(run("query", map_directory, "cat", "--weights", "mine.pt"), "encoder.weights", "mine.pt")
    refused(run("map", tmp_path / "no_bag.mcap", "--out", tmp_path / "m"), "no_bag.mcap")
    refused(run("map", recording, "--out", tmp_path / "m", "--set", "map.voxel_size_m=-1"), "map.voxel_size_m")
    refused(run("map", recording, "--out", tmp_path / "m", "--set", "map.size=1"), "map.size")
    refused(run("map", recording, "--out", tmp_path / "m", "--set", "nonsense"), "nonsense")
    refused(run("map", recording, "--out", tmp_path / "m", "--params-file", tmp_path / "no.yaml"), "no.yaml")
    refused(run("map", recording, "--out", tmp_path / "m", "--set", "encoder.name=clippy"), "encoder.name", "clippy")
    refused(run("convert", "kitti", tmp_path, tmp_path / "k.mcap"), "kitti")
    refused(run("convert", "sevenscenes", tmp_path / "no_folder", tmp_path / "k.mcap"), "no_folder")
    refused(run("convert", "sevenscenes", tmp_path, tmp_path / "k.mcap", "--option", "speed=2"), "speed")
    refused(run("simulate", tmp_path / "room.bag"), "room.bag")
    (tmp_path / "text.mcap").write_text("this is no recording")
    refused(run("map", tmp_path / "text.mcap", "--out", tmp_path / "m"), "text.mcap")
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "holiday.jpg").write_bytes(b"jpg")
    refused(run("map", recording, "--out", tmp_path / "photos"), "photos")
    assert (tmp_path / "photos" / "holiday.jpg").exists()


def test_a_map_of_another_encoder_is_refused_by_name(run: Run, map_directory: Path, tmp_path: Path, monkeypatch):
    other = tmp_path / "other"
    shutil.copytree(map_directory, other)
    manifest = read_manifest(other).model_copy(update={"encoder": "naradio_of_tomorrow"})
    (other / "manifest.json").write_bytes(manifest.encode())
    assert "naradio_of_tomorrow" not in registry.names()
    refused(run("query", other, "cat"), "naradio_of_tomorrow")


def test_convert_map_and_query_a_real_recording(run: Run, redkitchen: Path, tmp_path: Path):
    frames = tmp_path / "kitchen"
    frames.mkdir()
    for path in redkitchen.iterdir():
        number = path.name[6:12]
        # Sixteen frames from the whole of the recording.
        if path.name == "camera-intrinsics.txt" or (number.isdigit() and number in NUMBERS):
            (frames / path.name).symlink_to(path)
    assert run("convert", "sevenscenes", frames, tmp_path / "kitchen.mcap")[0] == 0
    assert run("map", tmp_path / "kitchen.mcap", "--out", tmp_path / "map")[0] == 0
    for prompt, places in EXPECTED.items():
        code, out, _ = run("query", tmp_path / "map", prompt, "--top", 1, "--json")
        assert code == 0
        centroid = json.loads(out)[0]["centroid"]
        distances = [float(np.linalg.norm(np.subtract(centroid, place))) for place in places]
        assert min(distances) < 0.3, f"{prompt}: {centroid}"


NUMBERS = {f"{number:06d}" for number in range(0, 1000, 64)}
# Positions read off depth images by hand, in the frame of the recording's poses, metres: two mugs, four chairs, magazines.
EXPECTED = {
    "something to drink from": [(-0.75, -0.11, 1.95), (0.25, -0.07, 1.94)],
    "where can I sit down": [(-1.18, 0.11, 2.01), (-0.55, -0.30, 2.25), (0.53, -0.34, 2.33), (-0.50, 0.36, 1.65)],
    "something to read": [(-0.55, -0.07, 1.87), (-0.15, 0.03, 1.71)],
}
