"""Planes from segments, on scenes whose depth is computed from known planes."""

from __future__ import annotations

import numpy as np

from fus3dmaps_core.segmenters.coplanar import adjacent_pairs, join_coplanar

HEIGHT, WIDTH = 60, 80


def plane_depth_m(a: float, b: float, c: float) -> np.ndarray:
    """Compute the depth of a plane seen by a pinhole camera: 1 / z is affine in pixel coordinates."""
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    return (1 / (a * u / WIDTH + b * v / HEIGHT + c)).astype(np.float32)


def stripes(*columns: int) -> np.ndarray:
    return np.repeat(np.searchsorted(np.array(columns), np.arange(WIDTH), side="right")[None], HEIGHT, axis=0)


def test_segments_of_one_slanted_plane_are_joined():
    groups = join_coplanar(stripes(20, 40, 60), plane_depth_m(0.2, 0.3, 0.4), 0.01)
    assert [group.tolist() for group in groups] == [[0, 1, 2, 3]]


def test_a_step_and_a_crease_part_planes():
    labels = stripes(20, 40, 60)
    depth = plane_depth_m(0.2, 0.3, 0.4)
    step = np.where(labels < 2, depth, depth + 0.3).astype(np.float32)
    assert [group.tolist() for group in join_coplanar(labels, step, 0.01)] == [[0, 1], [2, 3]]
    u = np.arange(WIDTH)
    crease = np.repeat((1 / (0.5 + 0.3 * np.abs(u - 40) / WIDTH))[None], HEIGHT, axis=0).astype(np.float32)
    assert [group.tolist() for group in join_coplanar(labels, crease, 0.01)] == [[0, 1], [2, 3]]


def test_a_small_thing_on_a_plane_keeps_out_of_it(rng):
    labels = stripes(40)
    labels[20:30, 10:20] = 2
    depth = plane_depth_m(0.0, 0.2, 0.5)
    depth[labels == 2] -= 0.08
    depth *= 1 + 0.003 * rng.standard_normal(depth.shape).astype(np.float32)
    assert [group.tolist() for group in join_coplanar(labels, depth, 0.01)] == [[0, 1]]


def test_planes_that_do_not_touch_stay_apart():
    labels = stripes(30, 50)
    depth = plane_depth_m(0.0, 0.0, 0.5)
    depth[labels == 1] = 1.0
    assert join_coplanar(labels, depth, 0.01) == []


def test_segments_without_depth_are_left_alone():
    labels = stripes(20, 40, 60)
    depth = plane_depth_m(0.1, 0.0, 0.5)
    depth[labels == 1] = 0
    assert [group.tolist() for group in join_coplanar(labels, depth, 0.01)] == [[2, 3]]
    assert join_coplanar(labels, np.zeros_like(depth), 0.01) == []


def test_adjacent_pairs_of_a_small_image():
    labels = np.array([[0, 0, 1], [2, 2, 1], [3, 2, 2]])
    assert adjacent_pairs(labels).tolist() == [[0, 1], [0, 2], [1, 2], [2, 3]]
    assert adjacent_pairs(np.zeros((2, 2), int)).shape == (0, 2)
