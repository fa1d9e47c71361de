"""Poses from quaternions, and the camera axes of datasets."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fus3dmaps_core.errors import RecordingError
from fus3dmaps_core.frame import check_pose
from fus3dmaps_lab.datasets.poses import FROM_FORWARD_RIGHT_DOWN, FROM_OPENGL, pose_of_quaternion

numbers = st.floats(-100, 100)
quaternions = st.lists(st.floats(-1, 1), min_size=4, max_size=4).filter(lambda q: np.linalg.norm(q) > 0.1)


@given(st.lists(numbers, min_size=3, max_size=3), quaternions, st.lists(numbers, min_size=3, max_size=3))
def test_points_turn_as_by_hamilton_products(t, q, p):
    x, y, z, w = np.array(q) / np.linalg.norm(q)
    T = pose_of_quaternion(np.array([*t, x, y, z, w]), "line")
    check_pose(T)
    v = np.array([x, y, z])
    turned = np.array(p) + 2 * w * np.cross(v, p) + 2 * np.cross(v, np.cross(v, p))
    np.testing.assert_allclose(T @ [*p, 1], [*(turned + t), 1], atol=1e-9)


@given(quaternions, st.floats(0.992, 1.008))
def test_rounding_of_a_file_is_forgiven_and_the_sign_does_not_matter(q, length):
    unit = np.array(q) / np.linalg.norm(q)
    T = pose_of_quaternion(np.array([1, 2, 3, *unit]), "line")
    np.testing.assert_allclose(pose_of_quaternion(np.array([1, 2, 3, *(unit * -length)]), "line"), T, atol=1e-12)


@given(quaternions, st.one_of(st.floats(0, 0.98), st.floats(1.02, 100), st.just(np.nan), st.just(np.inf)))
def test_what_is_no_unit_quaternion_is_refused(q, length):
    with pytest.raises(RecordingError, match=r"'poses\.txt' line 3 is not a position and a unit quaternion"):
        pose_of_quaternion(np.array([0, 0, 0, *(np.array(q) / np.linalg.norm(q) * length)]), "'poses.txt' line 3")


def test_axes():
    right, down, ahead = np.eye(4)[:3]
    for turn in (FROM_OPENGL, FROM_FORWARD_RIGHT_DOWN):
        check_pose(turn)
    np.testing.assert_array_equal(
        [FROM_OPENGL @ axis for axis in (right, down, ahead)], [[1, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 0]]
    )
    turned = [FROM_FORWARD_RIGHT_DOWN @ axis for axis in (right, down, ahead)]
    np.testing.assert_array_equal(turned, [[0, 1, 0, 0], [0, 0, 1, 0], [1, 0, 0, 0]])
