"""The demonstration on a given recording: real node, real player, real encoders, each in a process of its own."""

from __future__ import annotations

import io
from pathlib import Path

import cv2
import numpy as np
import pytest
from rich.console import Console

from fus3dmaps_core.errors import Fus3dmapsError, RecordingError
from fus3dmaps_core.recordings.writer import RecordingWriter
from fus3dmaps_lab.simulation.room.furnished_room import FurnishedRoom
from fus3dmaps_ros.commands import demo


@pytest.fixture(scope="module")
def recording(tmp_path_factory) -> Path:
    room = FurnishedRoom()
    path = tmp_path_factory.mktemp("room") / "start.mcap"
    with RecordingWriter(path) as writer:
        for index in range(3):
            writer.write(room.frame(index))
    return path


def test_a_recording_is_played_mapped_asked_and_drawn(recording: Path, tmp_path: Path, monkeypatch):
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    output = io.StringIO()
    assert demo.run_demo(recording, ["a pet that meows"], tmp_path / "out", Console(file=output, width=200))
    text = output.getvalue()
    assert '"a pet that meows"' in text
    assert "1. score" in text
    picture = cv2.imread(str(tmp_path / "out" / "a_pet_that_meows.png"))
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 100
    log = (tmp_path / "out" / "node.log").read_text()
    assert "Traceback" not in log
    assert "ready" in log


def test_a_recording_that_cannot_be_read_is_named(tmp_path: Path):
    with pytest.raises(RecordingError, match=r"absent\.mcap"):
        demo.run_demo(tmp_path / "absent.mcap", [], tmp_path / "out", Console(file=io.StringIO()))


def test_a_node_that_dies_is_reported_with_the_end_of_its_log(recording: Path, tmp_path: Path, monkeypatch):
    # No node can start with a device that torch does not have.
    monkeypatch.setattr(demo, "NODE_PARAMETERS", {"encoder.device": "no_such_device"})
    with pytest.raises(Fus3dmapsError, match="no_such_device"):
        demo.run_demo(recording, [], tmp_path / "out", Console(file=io.StringIO()))
