"""Datasets by name and their conversion into recordings."""

from __future__ import annotations

import numpy as np
import pytest
from recorded_frames import assert_same_frames, noise_frames, write_sevenscenes

from fus3dmaps_core.config.input import InputConfig
from fus3dmaps_core.config.schema import ImageConfig
from fus3dmaps_core.errors import RecordingError
from fus3dmaps_core.sources.bag import BagSource
from fus3dmaps_lab.datasets.convert import convert
from fus3dmaps_lab.datasets.registry import open_dataset


@pytest.fixture
def sequence(tmp_path):
    write_sevenscenes(tmp_path / "seq-01", noise_frames(4, 64, 48), [0, 1, 2, 30])
    return tmp_path / "seq-01"


def test_a_converted_dataset_gives_the_same_frames(sequence, tmp_path):
    progress = []
    out = tmp_path / "out.mcap"
    summary = convert("sevenscenes", sequence, out, on_progress=lambda done, total: progress.append((done, total)))
    assert (summary.frames, summary.duration_s, summary.size_bytes) == (4, 1.0, out.stat().st_size)
    assert progress == [(1, 4), (2, 4), (3, 4), (4, 4)]
    with BagSource(out, InputConfig()) as source:
        frames = [paired.decode(ImageConfig()) for paired in source]
        assert not source.pairer.drops.counts()
    stored = list(open_dataset("sevenscenes", sequence))
    for frame, original in zip(frames, stored, strict=True):
        # Seven digits in a pose file are not quite a rotation; a quaternion is.
        np.testing.assert_allclose(frame.T_world_camera, original.T_world_camera, atol=2e-7)
        frame.T_world_camera[:] = original.T_world_camera
    assert_same_frames(frames, stored)


def test_an_unknown_layout_is_named(sequence, tmp_path):
    with pytest.raises(RecordingError, match=r"'kitti'.*sevenscenes"):
        convert("kitti", sequence, tmp_path / "out.mcap")


def test_options_reach_the_dataset(sequence, tmp_path):
    out = tmp_path / "out.mcap"
    assert convert("sevenscenes", sequence.parent, out, options={"scene": "seq-01", "stride": 2}).frames == 2


def test_a_failed_conversion_leaves_no_file(sequence, tmp_path):
    (sequence / "frame-000002.pose.txt").write_text("")
    with pytest.raises(RecordingError, match=r"frame-000002\.pose\.txt"):
        convert("sevenscenes", sequence, tmp_path / "out.mcap")
    assert [path.name for path in tmp_path.iterdir()] == ["seq-01"]


def test_an_existing_recording_is_kept_unless_told_otherwise(sequence, tmp_path):
    out = tmp_path / "out.mcap"
    convert("sevenscenes", sequence, out)
    before = out.read_bytes()
    with pytest.raises(RecordingError, match="exists already"):
        convert("sevenscenes", sequence, out)
    convert("sevenscenes", sequence, out, overwrite=True)
    assert out.read_bytes() == before
