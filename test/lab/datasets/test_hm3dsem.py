"""A miniature walk as HOV-SG's generator writes it, its object ids, and errors of broken ones."""

from __future__ import annotations

import numpy as np
import pytest
from plane_scene import assert_on_wall, colors, cut, pose, wall_depth_m, write_color, write_gray

from fus3dmaps_core.errors import RecordingError
from fus3dmaps_core.frame import Intrinsics
from fus3dmaps_lab.datasets.hm3dsem import Hm3dSem
from fus3dmaps_lab.datasets.registry import open_labelled

CAMERA = (36.0, 36.0, 35.5, 23.5, 72, 48)
NAME = "Dd4bFSTQ8gi"


@pytest.fixture
def walk(tmp_path):
    walk = tmp_path / "val" / "00824-Dd4bFSTQ8gi"
    for folder in ("pose", "semantic"):
        (walk / folder).mkdir(parents=True)
    for i in range(3):
        write_color(walk / "rgb" / f"{NAME}_{i:06d}.png", colors(i, 72, 48))
        write_gray(walk / "depth" / f"{NAME}_{i:06d}.png", np.rint(wall_depth_m(i, *CAMERA) * 1000), np.uint16)
        T_world_opengl = pose(i).copy()
        T_world_opengl[:3, 1:3] *= -1  # Its y points up and its z backwards.
        text = "\t".join(str(value) for value in T_world_opengl.ravel())
        (walk / "pose" / f"{NAME}_{i:06d}.txt").write_text(text + "\n")
        ids = np.full((48, 72), 7, np.uint32)
        ids[:, :36] = 3
        ids[0] = 0
        ids[1] = 4
        np.save(walk / "semantic" / f"{NAME}_{i:06d}.npy", ids)
    (walk / f"{NAME}.semantic.txt").write_text(
        'HM3D Semantic Annotations\n3,AABBCC,"wall",0\n4,AABBCD,"unknown",0\n7,0A0B0C,"bar stool, high",2\n'
    )
    return walk


def test_points_lie_on_the_wall(walk):
    dataset = Hm3dSem(walk)
    assert (dataset.scene, len(dataset)) == ("00824", 3)
    assert dataset.intrinsics == Intrinsics(*CAMERA)
    for i, frame in enumerate(dataset):
        assert_on_wall(frame, i, 1e-3)
        np.testing.assert_array_equal(frame.rgb, colors(i, 72, 48))


def test_categories_are_classes_and_objects_are_instances(walk):
    dataset = open_labelled("hm3dsem", walk, stride=2)
    assert dataset.class_names == ("", "bar stool, high", "wall")
    assert dataset.background == {2}
    labels, instances = dataset.label_image(1), dataset.instance_image(1)
    assert (labels[2:, :36] == 2).all()
    assert (labels[2:, 36:] == 1).all()
    assert not labels[:2].any()
    assert (instances[2:, 36:] == 7).all()


def test_categories_may_be_parted_by_four_spaces(walk, tmp_path):
    table = tmp_path / "matterport_category_mappings.tsv"
    table.write_text(
        "index    raw_category    mpcat40index    mpcat40\n1    wall    1    wall\n2    bar stool, high    19    stool\n"
    )
    assert Hm3dSem(walk).class_names == ("", "stool", "wall")
    table = table.rename(tmp_path / "elsewhere.tsv")
    assert Hm3dSem(walk, categories=str(table)).class_names == ("", "stool", "wall")


def test_categories_become_matterport_classes(walk):
    (walk.parent / "category_mapping.tsv").write_text(
        "index\traw_category\tcategory\tmpcat40index\tmpcat40\n"
        "1\twall\twall\t1\twall\n2\tbar stool, high\tstool\t19\ttv_monitor\n"
    )
    assert Hm3dSem(walk).class_names == ("", "tv monitor", "wall")
    (walk.parent / "category_mapping.tsv").write_text("raw_category\nwall\n")
    with pytest.raises(RecordingError, match=r"category_mapping\.tsv' has no columns"):
        Hm3dSem(walk)


def test_without_names_of_objects_there_are_no_labels(walk, tmp_path):
    (walk / f"{NAME}.semantic.txt").rename(tmp_path / "objects.txt")
    with pytest.raises(RecordingError, match="no labels"):
        open_labelled("hm3dsem", walk)
    assert len(open_labelled("hm3dsem", walk, objects=str(tmp_path / "objects.txt")).class_names) == 3


@pytest.mark.parametrize("folder_suffix", [("depth", "png"), ("pose", "txt"), ("semantic", "npy")])
def test_a_missing_file_is_named(walk, folder_suffix):
    folder, suffix = folder_suffix
    (walk / folder / f"{NAME}_000001.{suffix}").unlink()
    with pytest.raises(RecordingError, match=rf"{folder}/{NAME}_000001\.{suffix}' is missing"):
        Hm3dSem(walk)


@pytest.mark.parametrize("ids", [np.zeros((48, 72)), np.zeros(5, np.int32), np.full((48, 72), -1), np.full((48, 72), 5)])
def test_odd_object_ids_are_named(walk, ids):
    np.save(walk / "semantic" / f"{NAME}_000001.npy", ids)
    with pytest.raises(RecordingError, match=r"000001\.npy"):
        Hm3dSem(walk).label_image(1)


def test_truncated_files_are_named(walk):
    cut(walk / "semantic" / f"{NAME}_000001.npy")
    with pytest.raises(RecordingError, match=r"000001\.npy"):
        Hm3dSem(walk).label_image(1)
    cut(walk / "rgb" / f"{NAME}_000000.png")
    with pytest.raises(RecordingError, match=r"rgb/.*000000\.png' is not an image, or is truncated"):
        next(iter(Hm3dSem(walk)))


@pytest.mark.parametrize("line", ["x,AA,wall,0", "1", "1,AA"])
def test_odd_objects_are_named(walk, line):
    (walk / f"{NAME}.semantic.txt").write_text(f"HM3D Semantic Annotations\n{line}\n")
    with pytest.raises(RecordingError, match=r"semantic\.txt' line 2"):
        Hm3dSem(walk)
