"""A miniature sequence of the TUM RGB-D benchmark: association by stamp, distortion, and errors of broken ones."""

from __future__ import annotations

import numpy as np
import pytest
from plane_scene import (
    DISTANCE_M,
    NORMAL,
    assert_on_wall,
    colors,
    cut,
    pose,
    quaternion_of,
    wall_depth_m,
    write_color,
    write_gray,
)

from fus3dmaps_core.errors import ConfigError, RecordingError
from fus3dmaps_core.frame import Intrinsics
from fus3dmaps_lab.datasets.registry import open_labelled
from fus3dmaps_lab.datasets.tum import TumRgbd

CAMERA = (535.4, 539.2, 320.1, 247.6, 80, 60)
SECOND = 1305031102


def truth_line(stamp, i):
    T = pose(i)
    return " ".join([stamp, *(f"{value:.9f}" for value in [*T[:3, 3], *quaternion_of(T[:3, :3])])])


@pytest.fixture
def sequence(tmp_path):
    sequence = tmp_path / "rgbd_dataset_freiburg3_office"
    colors_listed, depths_listed, truth = ["# color images"], ["# depth maps"], ["# ground truth trajectory"]
    for i in range(3):
        rgb, depth = f"{SECOND}.{i}75304", f"{SECOND}.{i}85304"
        write_color(sequence / "rgb" / f"{rgb}.png", colors(i, 80, 60))
        write_gray(sequence / "depth" / f"{depth}.png", np.rint(wall_depth_m(i, *CAMERA) * 5000), np.uint16)
        colors_listed.append(f"{rgb} rgb/{rgb}.png")
        depths_listed.append(f"{depth} depth/{depth}.png")
        truth.append(truth_line(rgb, i))
    for name, lines in (("rgb", colors_listed), ("depth", depths_listed), ("groundtruth", truth)):
        (sequence / f"{name}.txt").write_text("\n".join(lines) + "\n")
    return sequence


def test_points_lie_on_the_wall_at_exact_stamps(sequence):
    dataset = TumRgbd(sequence)
    assert len(dataset) == 3
    assert dataset.intrinsics == Intrinsics(*CAMERA)
    for i, frame in enumerate(dataset):
        assert frame.stamp_ns == SECOND * 10**9 + i * 10**8 + 75_304_000
        assert_on_wall(frame, i, 2e-4)
    assert [frame.stamp_ns for frame in TumRgbd(sequence, stride=2)] == [frame.stamp_ns for frame in dataset][::2]


def test_images_without_depth_or_pose_are_counted(sequence):
    with (sequence / "rgb.txt").open("a") as file:
        file.write(f"{SECOND}.230000 rgb/none.png\n{SECOND}.300001 rgb/none.png\n")
    with (sequence / "depth.txt").open("a") as file:
        file.write(f"{SECOND}.310000 depth/none.png\n")
    dataset = TumRgbd(sequence)
    assert (len(dataset), dataset.unpaired, dataset.lost_poses) == (3, 1, 1)


def test_poses_are_interpolated(sequence):
    T = np.eye(4)
    lines = [f"{SECOND}.065304 1 2 3 0 0 0 1", f"{SECOND}.085304 3 2 3 0 0 0.198669331 0.980066578"]
    (sequence / "groundtruth.txt").write_text("\n".join(lines))
    T[:2, :2] = [[np.cos(0.2), -np.sin(0.2)], [np.sin(0.2), np.cos(0.2)]]
    T[:3, 3] = [2, 2, 3]
    dataset = TumRgbd(sequence)
    np.testing.assert_allclose(next(iter(dataset)).T_world_camera, T, atol=1e-8)
    assert dataset.lost_poses == 2


def test_lens_distortion_is_undone(tmp_path):
    sequence = tmp_path / "rgbd_dataset_freiburg1_desk"
    K = np.array([[517.3, 0, 318.6], [0, 516.5, 255.3], [0, 0, 1]])
    v, u = np.mgrid[:480, :640].astype(np.float64)
    lens = np.array([0.2624, -0.9531, -0.0054, 0.0026, 1.1633])
    seen = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1]])
    flat = seen.copy()
    for _ in range(50):  # Brown's model, inverted by its fixed point.
        (x, y), r2 = flat, (flat**2).sum(0)
        bent = np.stack([2 * lens[2] * x * y + lens[3] * (r2 + 2 * x * x), lens[2] * (r2 + 2 * y * y) + 2 * lens[3] * x * y])
        flat = (seen - bent) / (1 + lens[0] * r2 + lens[1] * r2**2 + lens[4] * r2**3)
    T = pose(1)
    along = np.stack([*flat, np.ones((480, 640))], -1) @ T[:3, :3].T @ NORMAL
    write_gray(sequence / "depth" / "1.png", np.rint((DISTANCE_M - NORMAL @ T[:3, 3]) / along * 5000), np.uint16)
    write_color(sequence / "rgb" / "1.png", colors(1, 640, 480))
    (sequence / "rgb.txt").write_text("1.0 rgb/1.png")
    (sequence / "depth.txt").write_text("1.0 depth/1.png")
    (sequence / "groundtruth.txt").write_text(truth_line("1.0", 1))
    frame = next(iter(TumRgbd(sequence)))
    assert_on_wall(frame, 1, 5e-3)  # The nearest pixel is up to half a pixel away; distortion is up to 10 pixels.


def test_the_camera_is_the_one_of_the_name_or_the_option(sequence, tmp_path):
    plain = sequence.rename(tmp_path / "my_copy")
    with pytest.raises(RecordingError, match="my_copy' does not say freiburg1, 2 or 3"):
        TumRgbd(plain)
    assert TumRgbd(plain, camera="2").intrinsics.fx == 520.9
    with pytest.raises(ConfigError, match="'camera'"):
        TumRgbd(plain, camera="4")
    with pytest.raises(RecordingError, match="no labels"):
        open_labelled("tum", plain, camera="3")


@pytest.mark.parametrize("name", ["rgb.txt", "depth.txt", "groundtruth.txt", f"depth/{SECOND}.185304.png"])
def test_a_missing_file_is_named(sequence, name):
    (sequence / name).unlink()
    with pytest.raises(RecordingError, match=f"{name.split('/')[-1]}' is missing"):
        TumRgbd(sequence)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("rgb.txt", ""),
        ("rgb.txt", "1.0"),
        ("depth.txt", "yesterday depth/1.png"),
        ("groundtruth.txt", "# nothing"),
        ("groundtruth.txt", "1.0 0 0 0 0 0 0"),
        ("groundtruth.txt", "1.0 0 0 0 0 0 0 0.5"),
        ("groundtruth.txt", "1.0 0 nan 0 0 0 0 1"),
        ("groundtruth.txt", "1.0 0 0 0 0 0 0 1\n0.5 0 0 0 0 0 0 1"),
        ("groundtruth.txt", "1.0 0 0 0 0 0 0 one"),
    ],
)
def test_an_odd_file_is_named(sequence, name, content):
    (sequence / name).write_text(content)
    with pytest.raises(RecordingError, match=name):
        TumRgbd(sequence)


def test_a_truncated_or_smaller_image_is_named(sequence):
    cut(sequence / "rgb" / f"{SECOND}.175304.png")
    frames = iter(TumRgbd(sequence))
    next(frames)
    with pytest.raises(RecordingError, match=r"175304\.png' is not an image, or is truncated"):
        next(frames)
    write_color(sequence / "rgb" / f"{SECOND}.175304.png", colors(1, 40, 60))
    with pytest.raises(RecordingError, match=r"175304\.png' is 40x60, the first image 80x60"):
        list(TumRgbd(sequence))
