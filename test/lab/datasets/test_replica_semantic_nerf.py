"""A miniature room in Semantic-NeRF's layout, its label images, and errors of broken ones."""

from __future__ import annotations

import json

import numpy as np
import pytest
from plane_scene import assert_on_wall, colors, cut, pose, text_of, wall_depth_m, write_color, write_gray

from fus3dmaps_core.errors import RecordingError
from fus3dmaps_core.frame import Intrinsics
from fus3dmaps_lab.datasets.registry import open_labelled
from fus3dmaps_lab.datasets.replica_semantic_nerf import ReplicaSemanticNerf

CAMERA = (32.0, 32.0, 31.5, 23.5, 64, 48)


@pytest.fixture
def room(tmp_path):
    folder = tmp_path / "office_0" / "Sequence_1"
    for i in range(12):
        write_color(folder / "rgb" / f"rgb_{i}.png", colors(i, 64, 48))
        write_gray(folder / "depth" / f"depth_{i}.png", np.rint(wall_depth_m(i % 3, *CAMERA) * 1000), np.uint16)
        classes = np.full((48, 64), 93)
        classes[:, :32] = 12
        classes[0] = 0
        write_gray(folder / "semantic_class" / f"semantic_class_{i}.png", classes, np.uint8)
        write_gray(folder / "semantic_instance" / f"semantic_instance_{i}.png", classes + 300, np.uint16)
    (folder / "traj_w_c.txt").write_text("\n".join(text_of(pose(i % 3)) for i in range(12)) + "\n")
    info = tmp_path / "semantic_info" / "office_0" / "info_semantic.json"
    info.parent.mkdir(parents=True)
    info.write_text(json.dumps({"classes": [{"id": 93, "name": "wall"}, {"id": 12, "name": "bin"}]}))
    return tmp_path / "office_0"


def test_points_lie_on_the_wall_in_numerical_order(room):
    dataset = ReplicaSemanticNerf(room)
    assert (dataset.scene, len(dataset)) == ("office0", 12)
    assert dataset.intrinsics == Intrinsics(*CAMERA)
    for i, frame in enumerate(dataset):
        assert_on_wall(frame, i % 3, 1e-3)
        np.testing.assert_array_equal(frame.rgb, colors(i, 64, 48))


def test_labels_belong_to_the_frames(room):
    dataset = open_labelled("replica_semantic_nerf", room, stride=11)
    assert len(dataset) == 2
    assert dataset.class_names == ("", "bin", "wall")
    assert dataset.background == {2}
    labels = dataset.label_image(1)
    assert labels.dtype == np.int32
    assert (labels[0] == 0).all()
    assert (labels[1:, :32] == 1).all()
    assert (labels[1:, 32:] == 2).all()
    assert dataset.instance_image(1)[5, 5] == 312
    assert dataset.ground_truth_points() is None


def test_a_sequence_itself_may_be_given(room):
    assert len(ReplicaSemanticNerf(room / "Sequence_1")) == 12
    with pytest.raises(RecordingError, match="Sequence_2"):
        ReplicaSemanticNerf(room, sequence="Sequence_2")


def test_labels_of_no_class_are_named(room):
    path = room / "Sequence_1" / "semantic_class" / "semantic_class_3.png"
    for value in (50, 200):
        write_gray(path, np.full((48, 64), value), np.uint8)
        with pytest.raises(RecordingError, match=rf"semantic_class_3\.png' holds the value {value}"):
            ReplicaSemanticNerf(room).label_image(3)
    write_gray(path, np.full((24, 64), 12), np.uint8)
    with pytest.raises(RecordingError, match=r"semantic_class_3\.png' is 64x24"):
        ReplicaSemanticNerf(room).label_image(3)
    cut(path)
    with pytest.raises(RecordingError, match=r"semantic_class_3\.png' is not an image"):
        ReplicaSemanticNerf(room).label_image(3)


@pytest.mark.parametrize("name", ["depth/depth_2.png", "semantic_class/semantic_class_2.png", "traj_w_c.txt"])
def test_a_missing_file_is_named(room, name):
    (room / "Sequence_1" / name).unlink()
    with pytest.raises(RecordingError, match=f"{name.split('/')[-1]}' is missing"):
        ReplicaSemanticNerf(room)


def test_without_names_of_classes_there_are_no_labels(room):
    (room.parent / "semantic_info" / "office_0" / "info_semantic.json").unlink()
    assert len(ReplicaSemanticNerf(room)) == 12
    with pytest.raises(RecordingError, match="no labels"):
        open_labelled("replica_semantic_nerf", room)


def test_another_number_of_poses_than_images_is_refused(room):
    (room / "Sequence_1" / "traj_w_c.txt").write_text(text_of(pose(0)))
    with pytest.raises(RecordingError, match=r"traj_w_c\.txt' has 1 poses, .* 12 colour images"):
        ReplicaSemanticNerf(room)
