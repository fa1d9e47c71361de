"""The building, the robot's keyframes in it, and the maps that are filled from it."""

from __future__ import annotations

import numpy as np
import pytest
from benchmarks.boxes import voxels_of
from benchmarks.building import LABELS_PER_ROOM, make_room
from benchmarks.embeddings import ObservedObjects
from benchmarks.keyframes import DEPTH_NOISE_M, look_ahead, robot_path
from benchmarks.workload import KEYFRAMES, MIN_VOXELS, World, fill, instance_labels

from fus3dmaps_core.config.schema import MapConfig
from fus3dmaps_core.geometry.projection import sample_pixels
from fus3dmaps_core.voxel_map.semantic_map import SemanticMap


def as_set(voxels: np.ndarray) -> set:
    return set(map(tuple, voxels.tolist()))


def test_same_seed_same_room_and_another_seed_another():
    assert make_room(3, 1) == make_room(3, 1)
    assert make_room(3, 1) != make_room(3, 2)


def test_rooms_share_no_voxel_and_label_their_own():
    rooms = [make_room(number, 1).voxels() for number in range(12)]
    together = np.concatenate([voxels for voxels, _ in rooms])
    assert len(np.unique(together, axis=0)) == len(together)
    for number, (_, labels) in enumerate(rooms):
        assert (labels // LABELS_PER_ROOM == number).all()


def test_readings_lie_on_surfaces_but_for_the_depth_noise():
    boxes = make_room(0, 1).boxes
    camera = robot_path(1)[0]
    view = look_ahead(boxes, camera, sample_pixels(480, 640, 30, 40, 5), np.random.default_rng(0))
    assert len(view.points_m) == 6000
    distance = np.full(len(view.points_m), np.inf)
    for box in boxes:
        low, high = box.bounds_m
        outside = np.maximum(np.maximum(low - view.points_m, view.points_m - high), 0).max(axis=1)
        to_face = np.minimum(np.abs(view.points_m - low), np.abs(view.points_m - high)).min(axis=1)
        distance = np.minimum(distance, np.maximum(outside, to_face))
    assert distance.max() <= DEPTH_NOISE_M + 1e-9


def test_keyframes_have_the_points_that_they_promise_and_see_the_first_room_only(world):
    room = as_set(make_room(0, world.seed).voxels()[0])
    for keyframes, points in ((world.dense, 6000), (world.dense_8k, 8000)):
        assert len(keyframes) == KEYFRAMES
        for keyframe in keyframes:
            assert len(keyframe.points_m) == len(keyframe.patches) == len(keyframe.colors) == points
            assert keyframe.patches.max() < len(keyframe.patch_objects) == 1200
            seen = as_set(voxels_of(keyframe.points_m))
            assert seen <= room
            assert len(seen) == keyframe.voxels
            fresh = voxels_of(keyframe.fresh_points_m)
            assert as_set(fresh) <= seen
            assert len(as_set(fresh)) == len(fresh) == int(0.05 * keyframe.voxels)


def test_consecutive_keyframes_overlap(world):
    first, second = (as_set(voxels_of(keyframe.points_m)) for keyframe in world.dense[:2])
    assert len(first & second) > 0.5 * len(second)


def test_proposals_come_in_the_asked_numbers(world):
    for keyframe in world.masks:
        assert len(keyframe.objects) == 40
        sizes = np.bincount(keyframe.proposals, minlength=40)
        assert (np.diff(sizes) <= 0).all()
        assert sizes[-1] > 0
    for keyframe in world.detections:
        assert np.bincount(keyframe.proposals).tolist() == [3800] * 20


def test_surface_has_exactly_so_many_voxels_and_a_larger_one_goes_on_from_it(world):
    small = World(MIN_VOXELS, seed=world.seed).surface
    large = world.surface
    assert len(small.points_m) == MIN_VOXELS
    assert len(as_set(voxels_of(large.points_m))) == len(large.points_m) == 30_000
    assert (large.points_m[:MIN_VOXELS] == small.points_m).all()
    assert (large.objects[:MIN_VOXELS] == small.objects).all()
    assert small.seen == large.seen <= MIN_VOXELS
    seen = as_set(voxels_of(large.points_m[: large.seen]))
    assert all(as_set(voxels_of(keyframe.points_m)) <= seen for keyframe in [*world.dense_8k, *world.masks])


@pytest.mark.parametrize("instances", [200, 500, 1500])
def test_instances_cover_the_map_and_come_in_the_asked_number(world, instances):
    positions, labels = instance_labels(world.surface, 30_000, instances)
    assert np.unique(labels).tolist() == list(range(instances))
    depth = np.bincount(positions, minlength=30_000)
    assert set(depth.tolist()) == {1, 2}


def test_filled_map_has_exactly_the_voxels_and_about_the_instances(world):
    semantic_map = SemanticMap(16, MapConfig(), 1.0)
    fill(semantic_map, world, 12_000, 300, ObservedObjects(16, 0))
    assert semantic_map.voxel_count == semantic_map.dense_voxel_count == 12_000
    assert semantic_map.instance_count == pytest.approx(300, rel=0.02)
    before = semantic_map.instance_count
    for keyframe in world.masks:
        semantic_map.integrate_proposals(
            keyframe.points_m, keyframe.proposals, ObservedObjects(16, 1).observe(keyframe.objects)
        )
    assert semantic_map.voxel_count == 12_000
    assert semantic_map.instance_count - before < 40  # Masks find the instances that the map was filled with.


def test_observations_have_the_promised_cosine_with_their_object():
    observed = ObservedObjects(256, 3)
    objects = np.arange(500)
    seen = observed.observe(objects)
    cosines = (seen * observed.directions[objects]).sum(axis=1) / np.linalg.norm(seen, axis=1)
    assert cosines.mean() == pytest.approx(0.8, abs=0.01)
    assert (ObservedObjects(256, 3).observe(objects) == seen).all()
