"""Boxes and rays, against plain loops over faces."""

from __future__ import annotations

import numpy as np
import pytest
from benchmarks.boxes import VOXEL_SIZE_M, Box, cast_rays, surface_points, voxels_of
from hypothesis import given
from hypothesis import strategies as st

corners = st.tuples(*[st.integers(-50, 50)] * 3)
extents = st.tuples(*[st.integers(2, 9)] * 3)


def box_at(corner: tuple, extent: tuple, **kwargs) -> Box:
    return Box(corner, tuple(c + e for c, e in zip(corner, extent, strict=True)), **{"label": 0, **kwargs})


@given(corners, extents)
def test_box_has_the_voxels_of_its_shell_once_each(corner, extent):
    voxels, labels = box_at(corner, extent, is_room=True).voxels()
    outer = np.prod([e + 1 for e in extent])
    assert len(voxels) == outer - np.prod([e - 1 for e in extent])
    assert len(np.unique(voxels, axis=0)) == len(voxels)
    assert (voxels.min(axis=0) == corner).all()
    assert (voxels.max(axis=0) == np.add(corner, extent)).all()
    assert set(labels.tolist()) == set(range(6))


@given(corners, extents)
def test_surface_points_lie_on_the_box_and_in_their_voxels(corner, extent):
    box = box_at(corner, extent)
    voxels, _ = box.voxels()
    points = surface_points(voxels)
    low, high = box.bounds_m
    assert (voxels_of(points) == voxels).all()
    assert ((points >= low - 1e-9) & (points <= high + 1e-9)).all()
    assert np.minimum(np.abs(points - low), np.abs(points - high)).min(axis=1).max() < 1e-9


def first_hit(boxes: list[Box], origin: np.ndarray, direction: np.ndarray) -> tuple[float, int]:
    """Every face of every box, one by one."""
    best, label = np.inf, -1
    for box in boxes:
        for face in range(6):
            axis, plane = face // 2, box.bounds_m[face % 2, face // 2]
            if direction[axis] == 0:
                continue
            distance = (plane - origin[axis]) / direction[axis]
            hit = origin + distance * direction
            others = [other for other in range(3) if other != axis]
            inside = all(box.bounds_m[0, other] <= hit[other] <= box.bounds_m[1, other] for other in others)
            if distance > 0 and inside and distance < best:
                best, label = distance, box.label + (face if box.is_room else 0)
    return best, label


@given(st.integers(0, 2**32 - 1))
def test_rays_hit_what_a_search_of_all_faces_finds(seed):
    rng = np.random.default_rng(seed)
    room = Box((-40, -40, -40), (40, 40, 40), 0, is_room=True)
    furniture = [box_at(tuple(rng.integers(5, 25, 3).tolist()), (8, 9, 7), label=10 + i) for i in range(4)]
    directions = rng.normal(size=(40, 3))
    directions[:20] = np.abs(directions[:20])
    directions[0] = (1.0, 0.0, 0.0)
    distance, labels = cast_rays([room, *furniture], np.zeros(3), directions)
    for direction, found, label in zip(directions, distance, labels, strict=True):
        expected, expected_label = first_hit([room, *furniture], np.zeros(3), direction)
        assert found == pytest.approx(expected, abs=1e-9)
        assert label == expected_label


def test_ray_that_hits_nothing_says_so():
    distance, labels = cast_rays([box_at((10, 10, 10), (3, 3, 3))], np.zeros(3), np.array([[-1.0, 0.0, 0.0]]))
    assert np.isinf(distance[0])
    assert labels[0] == -1


def test_voxels_are_counted_downwards_below_zero():
    assert voxels_of(np.array([[-0.01, 0.0, 0.07]])).tolist() == [[-1, 0, 1]]
    assert VOXEL_SIZE_M == 0.05
