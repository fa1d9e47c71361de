"""A miniature trajectory of TartanGround: packed depth, poses of a NED world, labels; and errors of broken ones."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest
from plane_scene import assert_on_wall, colors, cut, pose, quaternion_of, wall_depth_m, write_color, write_gray

from fus3dmaps_core.errors import RecordingError
from fus3dmaps_core.frame import Intrinsics
from fus3dmaps_lab.datasets.registry import open_labelled
from fus3dmaps_lab.datasets.tartanground import TartanGround

CAMERA = (20.0, 20.0, 20.0, 20.0, 40, 40)


def write_depth(path, depth_m):
    path.parent.mkdir(parents=True, exist_ok=True)
    packed = np.frombuffer(depth_m.astype("<f4").tobytes(), np.uint8).reshape(*depth_m.shape, 4)
    assert cv2.imwrite(str(path), packed)


@pytest.fixture
def walk(tmp_path):
    walk = tmp_path / "AbandonedFactory" / "Data_omni" / "P0000"
    lines = []
    for i in range(3):
        stem = f"{i:06d}_lcam_front"
        write_color(walk / "image_lcam_front" / f"{stem}.png", colors(i, 40, 40))
        depth_m = wall_depth_m(i, *CAMERA)
        depth_m[0] = 10_000  # Sky.
        depth_m[1, 0] = np.inf
        write_depth(walk / "depth_lcam_front" / f"{stem}_depth.png", depth_m)
        labels = np.full((40, 40), 153)
        labels[:, :20] = 200
        labels[0] = 9
        write_gray(walk / "seg_lcam_front" / f"{stem}_seg.png", labels, np.uint8)
        # Columns of the camera frame's axes: forward is the optical z, right is x, down is y.
        R = pose(i)[:3, :3][:, [2, 0, 1]]
        lines.append(" ".join(f"{value:.9f}" for value in [*pose(i)[:3, 3], *quaternion_of(R)]))
    (walk / "pose_lcam_front.txt").write_text("\n".join(lines) + "\n")
    (walk.parents[1] / "seg_label_map.json").write_text(json.dumps({"name_map": {"wall": 200, "barrel": [153, 7]}}))
    return walk


def test_points_lie_on_the_wall(walk):
    dataset = TartanGround(walk)
    assert (dataset.scene, len(dataset)) == ("AbandonedFactory_P0000", 3)
    assert dataset.intrinsics == Intrinsics(*CAMERA)
    frames = list(dataset)
    for i, frame in enumerate(frames):
        assert_on_wall(frame, i, 1e-5)
        assert not frame.depth_m[0].any()
        assert frame.depth_m[1, 0] == 0
    assert frames[1].stamp_ns - frames[0].stamp_ns == 100_000_000


def test_a_robot_that_faces_north_looks_along_x_with_the_image_upright(walk):
    (walk / "pose_lcam_front.txt").write_text("1 2 -3 0 0 0 1\n" * 3)
    T = next(iter(TartanGround(walk))).T_world_camera
    np.testing.assert_array_equal(T @ [0, 0, 5, 1], [6, 2, -3, 1])  # Ahead is north.
    np.testing.assert_array_equal(T @ [5, 0, 0, 1], [1, 7, -3, 1])  # The image's right is east.
    np.testing.assert_array_equal(T @ [0, 5, 0, 1], [1, 2, 2, 1])  # The image's bottom is down.


def test_labels_belong_to_the_frames(walk):
    dataset = open_labelled("tartanground", walk, stride=2)
    assert dataset.class_names == ("", "barrel", "wall")
    assert dataset.background == {2}
    labels = dataset.label_image(1)
    assert not labels[0].any()
    assert (labels[1:, :20] == 2).all()
    assert (labels[1:, 20:] == 1).all()


def test_without_a_label_map_there_are_no_labels(walk):
    (walk.parents[1] / "seg_label_map.json").unlink()
    with pytest.raises(RecordingError, match="no labels"):
        open_labelled("tartanground", walk)


@pytest.mark.parametrize("content", ["", "{}", '{"name_map": []}', '{"name_map": {"a": 300}}', '{"name_map": {"a": "b"}}'])
def test_an_odd_label_map_is_named(walk, content):
    (walk.parents[1] / "seg_label_map.json").write_text(content)
    with pytest.raises(RecordingError, match=r"seg_label_map\.json"):
        TartanGround(walk)


def test_odd_depth_is_named(walk):
    path = walk / "depth_lcam_front" / "000000_lcam_front_depth.png"
    write_gray(path, np.ones((40, 40)), np.uint16)
    with pytest.raises(RecordingError, match=r"front_depth\.png' holds \(40, 40\) uint16, expected 4 channels"):
        next(iter(TartanGround(walk)))
    write_depth(path, np.ones((40, 40)))
    cut(path)
    with pytest.raises(RecordingError, match=r"front_depth\.png' is not an image, or is truncated"):
        next(iter(TartanGround(walk)))


@pytest.mark.parametrize(
    "name", ["depth_lcam_front/000001_lcam_front_depth.png", "seg_lcam_front/000001_lcam_front_seg.png"]
)
def test_a_missing_file_is_named(walk, name):
    (walk / name).unlink()
    with pytest.raises(RecordingError, match=f"{name.split('/')[-1]}' is missing"):
        TartanGround(walk)


@pytest.mark.parametrize(
    "lines", ["0 0 0 0 0 0 1\n" * 2, "0 0 0 0 0 0 1\n0 0 0\n", "0 0 0 0 0 0 0\n" * 3, "inf 0 0 0 0 0 1\n" * 3]
)
def test_odd_poses_are_named(walk, lines):
    (walk / "pose_lcam_front.txt").write_text(lines)
    with pytest.raises(RecordingError, match=r"pose_lcam_front\.txt'.*(2 poses, .* 3 colour|expected 7|not a position)"):
        TartanGround(walk)
