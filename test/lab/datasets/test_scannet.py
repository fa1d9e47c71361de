"""A miniature exported scan with lost poses, label images and a labelled mesh, and errors of broken ones."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from plane_scene import assert_on_wall, colors, cut, pose, wall_depth_m, write_color, write_gray

from fus3dmaps_core.config.input import InputConfig
from fus3dmaps_core.config.schema import ImageConfig
from fus3dmaps_core.errors import ConfigError, RecordingError
from fus3dmaps_core.frame import Intrinsics
from fus3dmaps_core.sources.bag import BagSource
from fus3dmaps_lab.datasets.convert import convert
from fus3dmaps_lab.datasets.registry import open_labelled
from fus3dmaps_lab.datasets.scannet import ScanNet

COLOR = (90.0, 90.0, 47.5, 35.5, 96, 72)
DEPTH = (45.0, 45.0, 23.5, 17.5, 48, 36)
TSV = (
    "id\traw_category\tnyu40id\tnyuClass\tnyu40class\n"
    "1\twall\t1\twall\twall\n2\toffice chair\t5\tchair\tchair\n1163\tobject\t40\tobject\totherprop\n"
)


def matrix(fx, fy, cx, cy, *_):
    return f"{fx} 0 {cx} 0\n0 {fy} {cy} 0\n0 0 1 0\n0 0 0 1\n"


@pytest.fixture
def scan(tmp_path):
    scan = tmp_path / "scans" / "scene0011_00"
    (scan / "intrinsic").mkdir(parents=True)
    (scan / "pose").mkdir()
    (scan / "intrinsic" / "intrinsic_color.txt").write_text(matrix(*COLOR))
    (scan / "intrinsic" / "intrinsic_depth.txt").write_text(matrix(*DEPTH))
    for i in range(11):
        write_color(scan / "color" / f"{i}.jpg", colors(i, 96, 72))
        write_gray(scan / "depth" / f"{i}.png", np.rint(wall_depth_m(i % 3, *DEPTH) * 1000), np.uint16)
        T = np.full((4, 4), -np.inf) if i in (1, 4) else pose(i % 3)
        (scan / "pose" / f"{i}.txt").write_text("\n".join(" ".join(f"{v:.6f}" for v in row) for row in T))
        labels = np.full((72, 96), 2 if i else 1)
        labels[:, :48] = 1163
        labels[0] = 0
        write_gray(scan / "scene0011_00_2d-label-filt" / "label-filt" / f"{i}.png", labels, np.uint16)
    (scan.parent / "scannetv2-labels.combined.tsv").write_text(TSV)
    return scan


def test_points_lie_on_the_wall_and_lost_poses_are_counted(scan):
    dataset = ScanNet(scan)
    assert (dataset.scene, len(dataset), dataset.lost_poses) == ("0011", 9, 2)
    assert dataset.intrinsics == Intrinsics(*COLOR)
    for i, frame in zip([0, 2, 3, 5, 6, 7, 8, 9, 10], dataset, strict=True):
        assert frame.depth_m.shape == (36, 48)
        assert_on_wall(frame, i % 3, 1.1e-3)


def test_a_converted_scan_is_the_same_scan(scan, tmp_path):
    assert convert("scannet", scan, tmp_path / "scan.mcap").frames == 9
    with BagSource(tmp_path / "scan.mcap", InputConfig()) as source:
        frames = [paired.decode(ImageConfig()) for paired in source]
    for i, frame in zip([0, 2, 3, 5, 6, 7, 8, 9, 10], frames, strict=True):
        assert_on_wall(frame, i % 3, 1.1e-3)


def test_the_stride_counts_lost_frames_too(scan):
    dataset = ScanNet(scan, stride=4)  # 0, 4 and 8, of which 4 is lost.
    assert (len(dataset), dataset.lost_poses) == (2, 1)
    assert_on_wall(list(dataset)[1], 2, 1.1e-3)


def test_labels_are_nyu40_and_belong_to_the_frames(scan):
    dataset = open_labelled("scannet", scan)
    assert dataset.class_names == ("", "wall", "chair")
    assert dataset.background == {1}
    assert (dataset.label_image(0)[1:, 48:] == 1).all()
    second = dataset.label_image(1)
    assert (second[1:, 48:] == 2).all()
    assert (second[:, :48] == 0).all()
    assert (second[0] == 0).all()
    assert dataset.instance_image(0) is None
    assert dataset.ground_truth_points() is None


def write_mesh(scan, labels):
    names = "".join(f"property float {n}\n" for n in "xyz") + "".join(
        f"property uchar {n}\n" for n in ("red", "green", "blue", "alpha")
    )
    header = f"ply\nformat binary_little_endian 1.0\ncomment by hand\nelement vertex {len(labels)}\n{names}"
    header += "property ushort label\n"
    header += "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    body = b"".join(struct.pack("<3f4BH", i, 2 * i, 3, 1, 2, 3, 255, label) for i, label in enumerate(labels))
    (scan / "scene0011_00_vh_clean_2.labels.ply").write_bytes(header.encode() + body + struct.pack("<B3i", 3, 0, 1, 2))


def test_the_mesh_is_the_truth_if_asked_for(scan):
    write_mesh(scan, [0, 1, 5, 40])
    assert ScanNet(scan).ground_truth_points() is None
    points, classes, instances = open_labelled("scannet", scan, truth="mesh").ground_truth_points()
    np.testing.assert_allclose(points, [[0, 0, 3], [1, 2, 3], [2, 4, 3], [3, 6, 3]])
    np.testing.assert_array_equal(classes, [0, 1, 2, 0])
    assert not instances.any()
    write_mesh(scan, [0, 1, 41])
    with pytest.raises(RecordingError, match=r"labels\.ply' has a label that is none of NYU40: 41"):
        ScanNet(scan, truth="mesh").ground_truth_points()
    with pytest.raises(ConfigError, match="'truth'"):
        ScanNet(scan, truth="guess")


def test_a_scan_that_is_not_exported_says_how(tmp_path):
    (tmp_path / "scene0000_00.sens").write_bytes(b"\4\0\0\0")
    with pytest.raises(RecordingError, match=r"scene0000_00\.sens' is not exported.*--export_poses"):
        ScanNet(tmp_path)


def test_two_views_are_refused(scan):
    (scan / "intrinsic" / "intrinsic_depth.txt").write_text(matrix(30, 30, 23.5, 17.5))
    with pytest.raises(RecordingError, match=r"intrinsic_color\.txt' and .*intrinsic_depth\.txt'"):
        ScanNet(scan)


def test_a_scan_of_lost_poses_only_is_refused(scan):
    for path in (scan / "pose").iterdir():
        path.write_text("-inf " * 16)
    with pytest.raises(RecordingError, match="no frame with a pose; 11 have none"):
        ScanNet(scan)


@pytest.mark.parametrize(
    "name", ["depth/2.png", "pose/2.txt", "intrinsic/intrinsic_depth.txt", "../scannetv2-labels.combined.tsv"]
)
def test_a_missing_file_is_named(scan, name):
    (scan / name).unlink()
    with pytest.raises(RecordingError, match=f"{name.split('/')[-1]}' is missing"):
        ScanNet(scan)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("pose/2.txt", "1 2 3"),
        ("pose/2.txt", "nan " * 16),
        ("pose/2.txt", "2 " * 16),
        ("intrinsic/intrinsic_color.txt", "1 0 0"),
        ("intrinsic/intrinsic_color.txt", "-1 " * 16),
        ("../scannetv2-labels.combined.tsv", ""),
        ("../scannetv2-labels.combined.tsv", "id\tnyu40id\n1\t2\n"),
        ("../scannetv2-labels.combined.tsv", "id\tnyu40id\tnyu40class\nx\t2\tcabinet\n"),
    ],
)
def test_an_odd_file_is_named(scan, name, content):
    (scan / name).write_text(content)
    with pytest.raises(RecordingError, match=name.split("/")[-1]):
        ScanNet(scan)


def test_a_truncated_depth_image_is_named(scan):
    cut(scan / "depth" / "0.png")
    with pytest.raises(RecordingError, match=r"0\.png' is not an image, or is truncated"):
        next(iter(ScanNet(scan)))
