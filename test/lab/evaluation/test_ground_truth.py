"""Truth per voxel against plain counting, from points and from label images."""

from __future__ import annotations

import math
from collections import Counter, defaultdict

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fus3dmaps_core.config.schema import ImageConfig
from fus3dmaps_core.errors import FrameError, MapError
from fus3dmaps_core.frame import Intrinsics, PosedFrame
from fus3dmaps_lab.evaluation import ground_truth
from fus3dmaps_lab.evaluation.ground_truth import (
    LabelledDepth,
    VoxelTruth,
    labelled_depth,
    voxel_keys,
    voxel_truth,
    voxel_truth_from_frames,
)

SIZE_M = 0.25
coordinates = st.integers(-8, 8).map(lambda eighths: eighths / 8)  # Exact, so that a plain computation has one answer.
a_point = st.tuples(coordinates, coordinates, coordinates, st.integers(0, 3), st.integers(0, 3))


def counted(points, rounding, last_choice=frozenset()):
    """Return (class, instance) by voxel, by plain counting."""
    votes = defaultdict(list)
    for x, y, z, label, instance in points:
        scaled = [each / SIZE_M for each in (x, y, z)]
        key = tuple(math.floor(each) if rounding == "floor" else round(each) for each in scaled)
        votes[key].append((label, instance))
    found = {}
    for key, labels in votes.items():
        kept = [each for each in labels if each[0] not in last_choice]
        if not kept:
            found[key] = (0, 0)
            continue
        classes = Counter(label for label, _ in kept)
        best = min(classes, key=lambda label: (-classes[label], label))
        instances = Counter(instance for label, instance in kept if label == best)
        found[key] = (best, min(instances, key=lambda instance: (-instances[instance], instance)))
    return found


def as_dictionary(truth: VoxelTruth):
    rows = zip(truth.keys.tolist(), truth.classes.tolist(), truth.instances.tolist(), strict=True)
    found = {tuple(key): (label, instance) for key, label, instance in rows}
    assert len(found) == len(truth.keys)
    assert list(found) == sorted(found)
    return found


def split(points):
    table = np.array(points, np.float64).reshape(-1, 5)
    return table[:, :3], table[:, 3].astype(np.int64), table[:, 4].astype(np.int64)


@given(st.lists(a_point, max_size=40), st.sampled_from(["floor", "round"]))
def test_majority_of_points_agrees_with_plain_counting(points, rounding):
    truth = voxel_truth(*split(points), SIZE_M, rounding)
    assert as_dictionary(truth) == counted(points, rounding)
    assert (truth.keys.dtype, truth.classes.dtype, truth.instances.dtype) == (np.int64, np.int32, np.int32)
    assert (truth.voxel_size_m, truth.rounding) == (SIZE_M, rounding)


@given(st.lists(a_point, min_size=1, max_size=20), st.sampled_from(["floor", "round"]))
def test_a_voxel_holds_its_points(points, rounding):
    positions, *_ = split(points)
    keys = voxel_keys(positions, SIZE_M, rounding)
    truth = VoxelTruth(keys, np.zeros(len(keys), np.int32), np.zeros(len(keys), np.int32), SIZE_M, rounding)
    assert np.all(np.abs(truth.centers_m - positions) <= SIZE_M / 2)
    np.testing.assert_array_equal((truth.positions + 0.5) * SIZE_M, truth.centers_m)
    assert (truth.positions == keys).all() == (rounding == "floor")


def test_classes_that_are_taken_out_lose_their_instances_too():
    truth = VoxelTruth(
        np.arange(9).reshape(3, 3), np.array([1, 2, 3], np.int32), np.array([7, 8, 9], np.int32), 0.1, "round"
    )
    rest = truth.without({1, 3})
    assert (rest.classes.tolist(), rest.instances.tolist()) == ([0, 2, 0], [0, 8, 0])
    assert (rest.voxel_size_m, rest.rounding) == (0.1, "round")
    np.testing.assert_array_equal(rest.keys, truth.keys)
    assert truth.classes.tolist() == [1, 2, 3]


def frames_of(points, images):
    """Make one-row label images whose pixels lie at the given points, which are dealt to a number of images in turn."""
    frames = []
    for start in range(images):
        mine = points[start::images]
        for x, y, z, label, instance in mine:
            pose = np.eye(4)
            pose[:3, 3] = (x, y, z - 1.0)  # The pixel at the principal point, one metre ahead.
            camera = Intrinsics(1.0, 1.0, 1.0, 0.0, 3, 1)
            depth_m = np.array([[0, 1, np.nan]], np.float32)
            frames.append(
                LabelledDepth(depth_m, camera, pose, np.array([[3, label, 3]]), np.array([[9, instance, 9]], np.uint8))
            )
    return frames


@given(
    st.lists(a_point, max_size=25),
    st.sets(st.integers(1, 3)),
    st.sampled_from(["floor", "round"]),
    st.integers(1, 3),
    st.sampled_from([1, 10, 2**22]),
)
def test_label_images_agree_with_plain_counting_of_the_classes_kept(points, ignored, rounding, images, rows_kept):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ground_truth, "_ROWS_KEPT", rows_kept)
        truth = voxel_truth_from_frames(frames_of(points, images), SIZE_M, frozenset(ignored), rounding)
    assert as_dictionary(truth) == counted(points, rounding, ignored | {0})


def test_images_without_instances_give_none():
    camera = Intrinsics(1.0, 1.0, 0.0, 0.0, 2, 1)
    frame = LabelledDepth(np.ones((1, 2), np.float32), camera, np.eye(4), np.array([[4, 4]]))
    truth = voxel_truth_from_frames([frame], SIZE_M)
    assert as_dictionary(truth) == {(0, 0, 4): (4, 0), (4, 0, 4): (4, 0)}


def test_labels_are_brought_to_the_resolution_of_the_map_with_its_depth():
    image = ImageConfig(width=32, height=32, depth_max_m=3.0)
    rng = np.random.default_rng(0)
    labels = rng.integers(0, 40_000, (32, 32)).astype(np.uint16)
    twice = labels.repeat(2, axis=0).repeat(2, axis=1)
    depth_m = rng.uniform(1, 4, (32, 32)).astype(np.float32)
    depth_m[0, 0] = np.inf
    camera = Intrinsics(40.0, 40.0, 31.5, 31.5, 64, 64)
    pose = np.eye(4)
    pose[:3, 3] = (1, 2, 3)
    frame = PosedFrame(0, np.zeros((64, 64, 3), np.uint8), depth_m, camera, pose)
    small = labelled_depth(frame, twice, twice + 1, image)
    np.testing.assert_array_equal(small.classes, labels)
    np.testing.assert_array_equal(small.instances, labels + 1)
    np.testing.assert_array_equal(small.depth_m, np.where(depth_m <= 3.0, depth_m, 0))
    np.testing.assert_array_equal(small.T_world_camera, pose)
    assert small.intrinsics == camera.resized(32, 32)
    assert labelled_depth(frame, twice, None, image).instances is None


def test_images_of_different_sizes_are_refused():
    camera = Intrinsics(1.0, 1.0, 0.0, 0.0, 2, 1)
    for labels in ((np.zeros((2, 1), int), None), (np.zeros((1, 2), int), np.zeros((1, 3), int))):
        with pytest.raises(FrameError, match=r"(classes|instances): image is .* depth \(1, 2\)"):
            LabelledDepth(np.ones((1, 2), np.float32), camera, np.eye(4), *labels)


@pytest.mark.parametrize(
    ("points", "classes", "instances", "named"),
    [
        (np.zeros((2, 2)), [1, 1], [1, 1], "points_m: must be"),
        (np.array([[0, 0, np.nan]]), [1], [1], "points_m: must be finite"),
        (np.array([[0, 0, 1e9]]), [1], [1], "points_m: must be finite and within"),
        (np.zeros((2, 3)), [1], [1, 1], "classes, instances: must be"),
        (np.zeros((2, 3)), [1, 1], [1], "classes, instances: must be"),
        (np.zeros((1, 3)), [-1], [1], "must not be negative"),
        (np.zeros((1, 3)), [1], [-1], "must not be negative"),
    ],
)
def test_malformed_points_are_refused(points, classes, instances, named):
    with pytest.raises(MapError, match=named):
        voxel_truth(points, np.array(classes), np.array(instances), SIZE_M)


def test_a_malformed_truth_is_refused():
    with pytest.raises(MapError, match="truth: keys, classes and instances"):
        VoxelTruth(np.zeros((2, 3), np.int64), np.zeros(2, np.int32), np.zeros(1, np.int32))
    with pytest.raises(MapError, match="must not be negative"):
        VoxelTruth(np.zeros((1, 3), np.int64), np.full(1, -1, np.int32), np.zeros(1, np.int32))
