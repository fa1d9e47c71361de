"""A miniature folder in the dataset's layout, errors of broken ones, and the real recording."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from recorded_frames import noise_frames, write_sevenscenes

from fus3dmaps_core.errors import RecordingError
from fus3dmaps_core.frame import Intrinsics
from fus3dmaps_lab.datasets.seven_scenes import SevenScenes


@pytest.fixture
def sequence(tmp_path):
    write_sevenscenes(tmp_path / "seq-01", noise_frames(3, 64, 48), [0, 4, 29])
    return tmp_path / "seq-01"


def test_frames_come_as_they_were_stored(sequence):
    dataset = SevenScenes(sequence)
    expected = noise_frames(3, 64, 48)
    assert len(dataset) == 3
    frames = list(dataset)
    for frame, stored in zip(frames, expected, strict=True):
        np.testing.assert_array_equal(frame.rgb, stored.rgb)
        np.testing.assert_allclose(frame.depth_m, stored.depth_m, rtol=1e-6)
        assert (frame.depth_m == 0).any()
        assert frame.depth_m.dtype == np.float32
        np.testing.assert_allclose(frame.T_world_camera, stored.T_world_camera, atol=1e-7)
        assert frame.intrinsics == Intrinsics(585.0, 585.0, 320.0, 240.0, 64, 48)
    stamps_ns = [frame.stamp_ns for frame in frames]
    assert stamps_ns[0] > 0
    assert [stamp - stamps_ns[0] for stamp in stamps_ns] == [0, 133_333_333, 966_666_667]
    assert [frame.stamp_ns for frame in dataset] == stamps_ns


def test_photographs_may_be_jpeg(tmp_path):
    write_sevenscenes(tmp_path, noise_frames(2, 64, 48), [7, 8], suffix="jpg")
    frames = list(SevenScenes(tmp_path))
    assert [frame.rgb.shape for frame in frames] == [(48, 64, 3)] * 2


def test_intrinsics_are_read_where_there_are_some(sequence):
    (sequence / "camera-intrinsics.txt").write_text("500 0 32\n0 501.5 24\n0 0 1\n")
    assert next(iter(SevenScenes(sequence))).intrinsics == Intrinsics(500.0, 501.5, 32.0, 24.0, 64, 48)


def test_files_beside_the_frames_do_not_matter(sequence):
    (sequence / "README.md").write_text("hello")
    (sequence / "frame-12.color.png").write_text("another scheme")
    assert len(SevenScenes(sequence)) == 3


@pytest.mark.parametrize("name", ["frame-000004.depth.png", "frame-000004.pose.txt"])
def test_a_missing_file_is_named(sequence, name):
    (sequence / name).unlink()
    with pytest.raises(RecordingError, match=rf"{name}' is missing"):
        SevenScenes(sequence)


def test_two_colour_images_of_one_frame_are_named(sequence):
    (sequence / "frame-000004.color.jpg").write_bytes(b"")
    with pytest.raises(RecordingError, match=r"color\.jpg' and 'frame-000004\.color\.png' are both number 4"):
        SevenScenes(sequence)


def test_a_folder_without_frames_names_its_sequences(sequence, tmp_path):
    with pytest.raises(RecordingError, match="seq-01, give one of them"):
        SevenScenes(sequence.parent)
    with pytest.raises(RecordingError, match="nowhere' is not a directory"):
        SevenScenes(tmp_path / "nowhere")
    (tmp_path / "bare").mkdir()
    with pytest.raises(RecordingError, match="bare' holds no file like frame-"):
        SevenScenes(tmp_path / "bare")


def _png(array) -> bytes:
    return cv2.imencode(".png", array)[1].tobytes()


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("frame-000004.color.png", b""),
        ("frame-000004.color.png", b"not an image"),
        ("frame-000004.depth.png", b""),
        ("frame-000004.depth.png", _png(np.zeros((4, 4), np.uint8))),
        ("frame-000004.depth.png", _png(np.zeros((4, 4, 3), np.uint16))),
    ],
)
def test_an_odd_file_is_named_and_the_frames_before_it_are_given(sequence, name, content):
    (sequence / name).write_bytes(content)
    frames = iter(SevenScenes(sequence))
    next(frames)
    with pytest.raises(RecordingError, match=name):
        next(frames)


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"1 0 0 0\n0 1 0 0\n0 0 1 0\n",
        b"1 0 0 0\n0 1 0 nan\n0 0 1 0\n0 0 0 1\n",
        b"1 0 0 0\n0 2 0 0\n0 0 1 0\n0 0 0 1\n",
        b"one two three\n",
        b"\xff\xfe\x00",
    ],
)
def test_an_odd_pose_is_named_before_any_frame(sequence, content):
    (sequence / "frame-000004.pose.txt").write_bytes(content)
    with pytest.raises(RecordingError, match=r"frame-000004\.pose\.txt"):
        SevenScenes(sequence)


def test_every_second_frame(sequence):
    dataset = SevenScenes(sequence, stride=2)
    assert len(dataset) == 2
    assert [frame.stamp_ns for frame in dataset] == [frame.stamp_ns for frame in SevenScenes(sequence)][::2]


@pytest.mark.parametrize("content", ["", "1 2 3", "585 0 320\n0 -585 240\n0 0 1", "585 0 inf\n0 585 240\n0 0 1"])
def test_odd_intrinsics_are_named(sequence, content):
    (sequence / "camera-intrinsics.txt").write_text(content)
    with pytest.raises(RecordingError, match=r"camera-intrinsics\.txt"):
        SevenScenes(sequence)


def test_the_real_recording(redkitchen):
    dataset = SevenScenes(redkitchen)
    assert len(dataset) == 250
    frame = next(iter(dataset))
    assert frame.rgb.shape == (480, 640, 3)
    assert frame.depth_m.shape == (480, 640)
    assert 0.3 < np.median(frame.depth_m[frame.depth_m > 0]) < 5
    assert frame.depth_m.max() < 20
    assert frame.intrinsics == Intrinsics(585.0, 585.0, 320.0, 240.0, 640, 480)
