import itertools

import cv2
import numpy as np
import pytest

from fus3dmaps_lab.simulation.room.furnished_room import EPOCH_NS, FurnishedRoom
from fus3dmaps_lab.simulation.room.photographs import photograph


@pytest.fixture(scope="module")
def room():
    return FurnishedRoom(seed=0, frames=60)


@pytest.fixture(scope="module")
def views(room):
    return [room.rendering(index) for index in range(len(room))]


def photo_of(room, name):
    """Return the panel with the photograph."""
    original = photograph(name)
    (panel,) = (p for p in room._scene.panels if np.array_equal(p.material.texture, original))
    return original, panel


def test_frames_are_posed_stamped_and_as_many_as_asked():
    room = FurnishedRoom(frames=3)
    frames = list(room)
    assert len(frames) == len(room) == 3
    assert [frame.stamp_ns - EPOCH_NS for frame in frames] == [0, 250_000_000, 500_000_000]
    for index, frame in enumerate(frames):
        assert frame.rgb.shape == (480, 640, 3)
        assert frame.depth_m.shape == (480, 640)
        assert np.array_equal(frame.T_world_camera, room.pose(index))
    with pytest.raises(ValueError, match="at least 2"):
        FurnishedRoom(frames=1)


def test_two_constructions_are_bit_identical_and_order_does_not_matter(room):
    again = FurnishedRoom(seed=0, frames=60)
    for index in (37, 5):
        first, second = room.frame(index), again.frame(index)
        assert np.array_equal(first.rgb, second.rgb)
        assert np.array_equal(first.depth_m, second.depth_m)
        assert np.array_equal(first.T_world_camera, second.T_world_camera)
    other = FurnishedRoom(seed=1, frames=60).frame(5)
    assert not np.array_equal(other.rgb, room.frame(5).rgb)
    assert not np.array_equal(other.depth_m, room.frame(5).depth_m)


def test_the_camera_moves_like_a_robot_and_returns(room):
    poses = [room.pose(index) for index in range(len(room))]
    for before, after in itertools.pairwise(poses):
        assert np.linalg.norm(after[:3, 3] - before[:3, 3]) < 0.25
        turn = (np.trace(before[:3, :3].T @ after[:3, :3]) - 1) / 2
        assert np.arccos(np.clip(turn, -1, 1)) < 0.3
    np.testing.assert_allclose(poses[0], poses[-1], atol=1e-9)
    for pose in poses:
        assert np.all(np.abs(pose[:2, 3]) < 1.4)  # Clear of the furniture.


def test_every_photograph_is_seen_whole_from_several_places_nearby(room, views):
    assert len(room.photographs) >= 5
    for name in room.photographs:
        label = [item.name for item in room.objects].index(name) + 1
        center_m = room.objects[label - 1].center_m
        places = []
        for index, view in enumerate(views):
            mask = view.labels == label
            whole = not (mask[0].any() or mask[-1].any() or mask[:, 0].any() or mask[:, -1].any())
            position = room.pose(index)[:3, 3]
            if mask.sum() > 20_000 and whole and 0.5 < np.linalg.norm(position - center_m) < 3.0:
                places.append(position)
        assert len(places) >= 5, name
        assert np.ptp(np.array(places), axis=0).max() > 0.3, name


def test_every_object_is_seen(room, views):
    for label, item in enumerate(room.objects, start=1):
        seen = sum(np.count_nonzero(view.labels == label) > 2000 for view in views)
        assert seen >= 5, item.name


def test_ground_truth_boxes_hold_the_points_of_their_labels(room, views):
    fx, fy, cx, cy = (getattr(room.intrinsics, name) for name in ("fx", "fy", "cx", "cy"))
    rows, columns = np.mgrid[:480:4, :640:4]
    for index in range(0, len(room), 6):
        view, pose = views[index], room.pose(index)
        depth, labels = view.depth_m[::4, ::4], view.labels[::4, ::4]
        assert np.all(depth > 0)  # The room is closed.
        camera = np.stack([(columns - cx) / fx * depth, (rows - cy) / fy * depth, depth], axis=-1)
        world = camera @ pose[:3, :3].T + pose[:3, 3]
        for label in np.unique(labels[labels > 0]):
            item, points = room.objects[label - 1], world[labels == label]
            assert np.all(points > item.box_min_m - 2e-3), item.name
            assert np.all(points < item.box_max_m + 2e-3), item.name


def test_photographs_keep_their_pixels_upright_and_not_mirrored(room, views):
    for name in room.photographs:
        original, panel = photo_of(room, name)
        label = [item.name for item in room.objects].index(name) + 1
        index = max(range(len(views)), key=lambda i: np.count_nonzero(views[i].labels == label))
        pose, K = room.pose(index), room.intrinsics.matrix
        corners = panel.point_m([0, 1, 1, 0], [0, 0, 1, 1])
        pixels = (K @ pose[:3, :3].T @ (corners - pose[:3, 3]).T).T
        height, width = original.shape[:2]
        target = np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float32) - 0.5
        homography = cv2.getPerspectiveTransform((pixels[:, :2] / pixels[:, 2:]).astype(np.float32), target)
        seen = cv2.warpPerspective(views[index].rgb, homography, (width, height), flags=cv2.INTER_LINEAR).astype(float)
        inside = cv2.warpPerspective(np.ones((480, 640), np.uint8), homography, (width, height)) > 0
        blurred = cv2.GaussianBlur(original, (0, 0), 1.5).astype(float)
        error = np.abs(seen - blurred)[inside].mean()
        mirrored = np.abs(seen - blurred[:, ::-1])[inside].mean()
        flipped = np.abs(seen - blurred[::-1])[inside].mean()
        assert error < 10, name
        assert error < 0.5 * min(mirrored, flipped), name


def test_measured_depth_is_near_the_true_one(room, views):
    measured, true = room.frame(20).depth_m, views[20].depth_m
    found = measured > 0
    assert 0.9 < found.mean() < 1.0
    error = np.abs(measured - true)[found]
    assert np.median(error) < 0.01
    assert np.mean(error > 0.1) < 0.01
