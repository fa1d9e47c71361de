"""Pictures show the right colour at the right place, and PLY files keep their numbers."""

from __future__ import annotations

import cv2
import numpy as np
import open3d as o3d
import pytest

from fus3dmaps_core.answers.query import RankedInstance
from fus3dmaps_core.answers.render import render_answer, write_ply, write_png
from fus3dmaps_core.errors import StorageError


def floor_map():
    """A 4 m x 4 m floor in a z-up frame, red on the left (y > 0) and blue on the right of someone who looks along x."""
    xs, ys = np.meshgrid(np.arange(0, 4, 0.05), np.arange(-2, 2, 0.05))
    points = np.stack([xs.ravel(), ys.ravel(), np.zeros(xs.size)], axis=1).astype(np.float32)
    colors = np.where(points[:, 1:2] > 0, [[200, 20, 20]], [[20, 20, 200]]).astype(np.uint8)
    return points, colors


def looking_along_x() -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # x right is -y of the map, y down is -z, z forward is x.
    T[:3, 3] = (-1, 0, 1.2)
    return T


def picture(points, colors, similarity, instances=()):
    return render_answer(points, colors, points, similarity, instances, looking_along_x()[None], 0.05, "floor", (320, 240))


def test_the_picture_is_upright_and_not_mirrored():
    points, colors = floor_map()
    image = picture(points, colors, np.linspace(0, 1, len(points), dtype=np.float32))
    assert image.shape == (56 + 240, 640, 3)
    left = image[56:, :320].astype(int)
    middle = left[100:140]
    redness = (middle[:, :, 0] - middle[:, :, 2]).mean(axis=0)
    assert redness[100] > 50
    assert redness[220] < -50


def test_similarity_is_drawn_where_it_is_high():
    points, colors = floor_map()
    similarity = np.exp(-8 * np.linalg.norm(points - (2.0, -1.0, 0.0), axis=1) ** 2).astype(np.float32)
    right = picture(points, colors, similarity)[56:, 320:].astype(int)
    hot = np.argwhere((right[:, :, 0] > 100) & (right[:, :, 2] < 60))
    assert len(hot) > 5
    assert hot[:, 1].mean() > 170  # y = -1 is to the right of someone who looks along x.


def test_the_best_instance_is_marked_in_both_panels():
    points, colors = floor_map()
    similarity = np.zeros(len(points), np.float32)
    box = RankedInstance(3, "x", 0.5, 1.0, np.array([2, 0, 0.2]), np.array([1.5, -0.5, 0.0]), np.array([2.5, 0.5, 0.5]), 9)
    change = (
        np.abs(picture(points, colors, similarity, [box]).astype(int) - picture(points, colors, similarity)).sum(axis=2) > 60
    )
    assert change[56:, :320].sum() > 100
    assert change[56:, 320:].sum() > 100


@pytest.mark.parametrize("poses", [np.zeros((0, 4, 4)), looking_along_x()[None]])
def test_a_map_of_one_voxel_can_be_drawn(poses):
    one = np.zeros((1, 3), np.float32)
    image = render_answer(
        one, np.zeros((1, 3), np.uint8), one, np.ones(1, np.float32), [], poses, 0.05, "snow ☃", (320, 240)
    )
    assert image.dtype == np.uint8


def test_png_keeps_its_pixels(tmp_path):
    image = np.random.default_rng(0).integers(0, 256, (10, 12, 3), dtype=np.uint8)
    write_png(tmp_path / "deep" / "a.png", image)
    np.testing.assert_array_equal(cv2.imread(str(tmp_path / "deep" / "a.png"))[:, :, ::-1], image)


def test_ply_keeps_points_and_similarity(tmp_path):
    points = np.random.default_rng(0).normal(size=(50, 3)).astype(np.float32)
    similarity = np.linspace(-1, 1, 50, dtype=np.float32)
    write_ply(tmp_path / "a.ply", points, similarity)
    cloud = o3d.t.io.read_point_cloud(str(tmp_path / "a.ply"))
    np.testing.assert_array_equal(cloud.point["positions"].numpy(), points)
    np.testing.assert_array_equal(cloud.point["similarity"].numpy()[:, 0], similarity)


def test_unwritable_places_are_named(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(StorageError, match=r"a\.png"):
        write_png(tmp_path / "file" / "a.png", np.zeros((2, 2, 3), np.uint8))
    with pytest.raises(StorageError, match=r"a\.ply"):
        write_ply(tmp_path / "file" / "a.ply", np.zeros((1, 3), np.float32), np.zeros(1, np.float32))
