"""Keyframe gates against the plain reference over random walks, and at their thresholds."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from reference.gates import keyframes, moved_m, turned_rad
from scipy.spatial.transform import Rotation

from fus3dmaps_core.geometry.keyframe_gate import KeyframeGate, rotation_angle_rad


def pose(position=(0.0, 0.0, 0.0), rotation_vector=(0.0, 0.0, 0.0)) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(rotation_vector).as_matrix()
    T[:3, 3] = position
    return T


def walk(gate: KeyframeGate, poses: list[np.ndarray]) -> list[bool]:
    wanted = []
    for T in poses:
        wanted.append(gate.wants(T))
        if wanted[-1]:
            gate.accept(T)
    return wanted


@given(
    st.integers(0, 2**32 - 1), st.integers(0, 40), st.sampled_from([0.005, 0.03, 0.1]), st.sampled_from([0.005, 0.03, 0.1])
)
def test_a_walk_has_the_keyframes_of_the_reference(seed: int, steps: int, stride_m: float, turn_rad: float):
    rng = np.random.default_rng(seed)
    poses = [pose(rng.normal(size=3) * 100, rng.normal(size=3))]
    for _ in range(steps):
        poses.append(poses[-1] @ pose(rng.normal(size=3) * stride_m, rng.normal(size=3) * turn_rad))
    for translation_m, rotation_rad in ((0.08, 0.06), (0.14, 0.11)):
        margins = [
            abs(distance - threshold)
            for a in poses
            for b in poses
            for distance, threshold in ((moved_m(a, b), translation_m), (turned_rad(a, b), rotation_rad))
        ]
        if min(margins, default=1.0) > 1e-9:
            assert walk(KeyframeGate(translation_m, rotation_rad), poses) == keyframes(poses, translation_m, rotation_rad)


def test_the_first_frame_is_a_keyframe_and_so_is_the_first_after_a_reset():
    gate = KeyframeGate(0.5, 0.5)
    assert gate.wants(pose((7, 8, 9)))
    gate.accept(pose((7, 8, 9)))
    assert not gate.wants(pose((7, 8, 9)))
    gate.reset()
    assert gate.wants(pose((7, 8, 9)))


@pytest.mark.parametrize(
    ("position", "rotation_vector", "wanted"),
    [
        ((0.25, 0.0, 0.0), (0, 0, 0), True),  # Exactly at the threshold, and exact in binary.
        ((0.2499999, 0.0, 0.0), (0, 0, 0), False),
        ((0.0, -0.15, 0.20001), (0, 0, 0), True),
        ((0.0, -0.15, 0.19999), (0, 0, 0), False),
        ((0, 0, 0), (0.0, 0.0600001, 0.0), True),
        ((0, 0, 0), (0.0, 0.0599999, 0.0), False),
        ((0, 0, 0), (-0.0600001, 0.0, 0.0), True),
        ((0, 0, 0), (0.0, np.pi, 0.0), True),
        ((0.2, 0.0, 0.0), (0.0, 0.05, 0.0), False),  # Neither suffices and they do not add up.
        ((1.0, 0.0, 0.0), (0.0, 0.05, 0.0), True),
        ((0.2, 0.0, 0.0), (0.0, 0.5, 0.0), True),
    ],
)
def test_either_threshold_suffices(position, rotation_vector, wanted: bool):
    gate = KeyframeGate(0.25, 0.06)
    start = pose((0, 0, 0), (0, 0, 0))
    gate.accept(start)
    assert gate.wants(start @ pose(position, rotation_vector)) is wanted


def test_motion_counts_from_the_last_keyframe_not_from_the_last_frame():
    gate = KeyframeGate(0.08, 0.06)
    wanted = walk(gate, [pose((0.03 * step, 0, 0)) for step in range(10)])
    assert wanted == [True, False, False, True, False, False, True, False, False, True]


def test_asking_changes_nothing_and_the_pose_is_kept_by_value():
    gate = KeyframeGate(0.08, 0.06)
    T = pose()
    gate.accept(T)
    for _ in range(3):
        assert gate.wants(pose((1, 0, 0)))
    T[:3, 3] = (1, 0, 0)  # The caller reuses its array.
    assert gate.wants(pose((1, 0, 0)))
    assert not gate.wants(pose())


def test_thresholds_of_zero_take_every_frame():
    gate = KeyframeGate(0.0, 0.0)
    assert walk(gate, [pose()] * 3) == [True] * 3


@given(st.integers(0, 2**32 - 1), st.sampled_from([1e-6, 1e-3, 0.1, 1.0, 3.0, 3.1415, float(np.pi)]))
def test_the_angle_of_a_rotation_is_right_from_tiny_turns_to_half_a_turn(seed: int, angle: float):
    axis = np.random.default_rng(seed).normal(size=3)
    R = Rotation.from_rotvec(axis / np.linalg.norm(axis) * angle).as_matrix()
    assert rotation_angle_rad(R) == pytest.approx(angle, abs=1e-7)
