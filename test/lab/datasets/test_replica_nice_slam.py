"""A miniature room in NICE-SLAM's layout, its labelled mesh, and errors of broken ones."""

from __future__ import annotations

import json
import struct

import numpy as np
import pytest
from plane_scene import assert_on_wall, colors, cut, pose, text_of, wall_depth_m, write_color, write_gray

from fus3dmaps_core.errors import RecordingError
from fus3dmaps_core.frame import Intrinsics
from fus3dmaps_lab.datasets.registry import open_dataset, open_labelled
from fus3dmaps_lab.datasets.replica_nice_slam import ReplicaNiceSlam

CAMERA = (60.0, 60.0, 29.5, 16.5, 60, 34)


@pytest.fixture
def room(tmp_path):
    camera = dict(zip(("fx", "fy", "cx", "cy", "w", "h"), CAMERA, strict=True), scale=6553.5)
    (tmp_path / "cam_params.json").write_text(json.dumps({"camera": camera}))
    room = tmp_path / "office0"
    for i in range(4):
        write_color(room / "results" / f"frame{i:06d}.jpg", colors(i, 60, 34))
        depth = np.rint(wall_depth_m(i, *CAMERA) * 6553.5)
        depth[0, 0] = 0
        write_gray(room / "results" / f"depth{i:06d}.png", depth, np.uint16)
    (room / "traj.txt").write_text("\n".join(text_of(pose(i)) for i in range(4)) + "\n")
    return room


def write_habitat(folder, face_objects=(4, 4, 9), truncate=0):
    """Write three quads of one metre at x = 0, 1 and 2: two of one sofa, and one of something without a class."""
    folder.mkdir(parents=True)
    classes = [{"id": 31, "name": "wall"}, {"id": 76, "name": "sofa"}]
    objects = [{"id": 4, "class_id": 76, "class_name": "sofa"}, {"id": 9, "class_id": -1, "class_name": "undefined"}]
    (folder / "info_semantic.json").write_text(json.dumps({"classes": classes, "objects": objects}))
    header = (
        "ply\nformat binary_little_endian 1.0\nelement vertex 12\n"
        + "".join(f"property float {n}\n" for n in ("x", "y", "z", "nx", "ny", "nz"))
        + "".join(f"property uchar {n}\n" for n in ("red", "green", "blue"))
        + "element face 3\nproperty list uchar int vertex_indices\nproperty int object_id\nend_header\n"
    )
    body = b""
    for quad in range(3):
        for x, y in ((0, 0), (1, 0), (1, 1), (0, 1)):
            body += struct.pack("<6f3B", quad + x, y, 2, 0, 0, 1, 9, 9, 9)
    for quad, object_id in enumerate(face_objects):
        body += struct.pack("<B4ii", 4, *range(4 * quad, 4 * quad + 4), object_id)
    (folder / "mesh_semantic.ply").write_bytes(header.encode() + body[: len(body) - truncate])


def test_points_lie_on_the_wall(room):
    dataset = ReplicaNiceSlam(room)
    assert (dataset.name, dataset.scene, len(dataset)) == ("replica", "office0", 4)
    assert dataset.intrinsics == Intrinsics(*CAMERA)
    for i, frame in enumerate(dataset):
        assert_on_wall(frame, i, 5e-4)
        assert frame.depth_m[0, 0] == 0
        np.testing.assert_allclose(frame.rgb[4, 50], colors(i, 60, 34)[4, 50], atol=6)


def test_every_third_frame(room):
    frames = list(open_dataset("replica", room.parent, scene="office0", stride="3"))
    assert_on_wall(frames[0], 0, 5e-4)
    assert_on_wall(frames[1], 3, 5e-4)
    assert len(frames) == 2


def test_labelled_points_come_from_the_original_release(room, tmp_path):
    write_habitat(tmp_path / "release")
    dataset = open_labelled("replica", room, habitat=str(tmp_path / "release"))
    assert dataset.class_names == ("", "wall", "sofa")
    assert dataset.background == {1}
    points, classes, instances = dataset.ground_truth_points()
    np.testing.assert_allclose(points, [[0.5, 0.5, 2], [1.5, 0.5, 2], [2.5, 0.5, 2]])
    np.testing.assert_array_equal(classes, [2, 2, 0])
    np.testing.assert_array_equal(instances, [5, 5, 0])
    with pytest.raises(RecordingError, match=r"no label image for .*frame000001\.jpg"):
        dataset.label_image(1)


def test_without_the_original_release_there_are_no_labels(room):
    assert ReplicaNiceSlam(room).ground_truth_points() is None
    with pytest.raises(RecordingError, match="no labels"):
        open_labelled("replica", room)


@pytest.mark.parametrize("cut_off", [1, 30, 60, 400])
def test_a_truncated_mesh_is_named(room, cut_off):
    write_habitat(room / "habitat", truncate=cut_off)
    with pytest.raises(RecordingError, match=r"mesh_semantic\.ply' is truncated"):
        ReplicaNiceSlam(room).ground_truth_points()


@pytest.mark.parametrize(
    "old_new",
    [
        (b"object_id", b"objectXid"),
        (b"binary_little", b"binary_bigggg"),
        (b"ply\n", b"plx\n"),
        (b"list uchar", b"list uchor"),
    ],
)
def test_an_odd_mesh_is_named(room, old_new):
    write_habitat(room / "habitat")
    mesh = room / "habitat" / "mesh_semantic.ply"
    mesh.write_bytes(mesh.read_bytes().replace(*old_new))
    with pytest.raises(RecordingError, match=r"mesh_semantic\.ply"):
        ReplicaNiceSlam(room).ground_truth_points()


@pytest.mark.parametrize("content", ["", "{}", '{"classes": []}', '{"classes": [{"id": 1}]}', "[1]", '{"classes": 5}'])
def test_odd_classes_are_named(room, content):
    write_habitat(room / "habitat")
    (room / "habitat" / "info_semantic.json").write_text(content)
    with pytest.raises(RecordingError, match=r"info_semantic\.json"):
        ReplicaNiceSlam(room)


@pytest.mark.parametrize("name", ["results/depth000002.png", "traj.txt", "../cam_params.json", "habitat/mesh_semantic.ply"])
def test_a_missing_file_is_named(room, name):
    write_habitat(room / "habitat")
    (room / name).unlink()
    with pytest.raises(RecordingError, match=f"{name.split('/')[-1]}' is missing"):
        ReplicaNiceSlam(room)


def test_another_number_of_poses_than_images_is_refused(room):
    (room / "results" / "frame000003.jpg").unlink()
    with pytest.raises(RecordingError, match=r"traj\.txt' has 4 poses, .* 3 colour images"):
        ReplicaNiceSlam(room)


@pytest.mark.parametrize("line", ["1 2 3", "a " * 16, "2 " + "0 " * 15, "nan " * 16])
def test_an_odd_pose_is_named(room, line):
    lines = (room / "traj.txt").read_text().splitlines()
    (room / "traj.txt").write_text("\n".join([lines[0], line, *lines[2:]]))
    with pytest.raises(RecordingError, match=r"traj\.txt' (line|pose) 2"):
        ReplicaNiceSlam(room)


@pytest.mark.parametrize(
    "content", ["{", "{}", '{"camera": {"fx": 1}}', '{"camera": {"fx":1,"fy":1,"cx":1,"cy":1,"scale":0}}']
)
def test_an_odd_camera_is_named(room, content):
    (room.parent / "cam_params.json").write_text(content)
    with pytest.raises(RecordingError, match=r"cam_params\.json"):
        ReplicaNiceSlam(room)


@pytest.mark.parametrize("name", ["frame000002.jpg", "depth000002.png"])
def test_a_truncated_image_is_named(room, name):
    cut(room / "results" / name)
    frames = iter(ReplicaNiceSlam(room))
    next(frames), next(frames)
    with pytest.raises(RecordingError, match=f"{name}' is not an image, or is truncated"):
        next(frames)


def test_an_image_of_another_size_is_named(room):
    write_color(room / "results" / "frame000001.jpg", colors(1, 30, 34))
    with pytest.raises(RecordingError, match=r"frame000001\.jpg"):
        list(ReplicaNiceSlam(room))


def test_folders_that_are_not_rooms(room, tmp_path):
    with pytest.raises(RecordingError, match="nowhere' is not a directory"):
        ReplicaNiceSlam(tmp_path / "nowhere")
    with pytest.raises(RecordingError, match=r"results' is not a directory, expected files like frame000000\.jpg"):
        ReplicaNiceSlam(tmp_path)
