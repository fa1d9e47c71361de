"""The pose buffer against scipy's interpolation over the whole trajectory, and its bounds."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from fus3dmaps_core.geometry.trajectory import PoseBuffer, PoseGap


def transform(rotation_vector, position) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(rotation_vector).as_matrix()
    T[:3, 3] = position
    return T


def test_empty_buffer_waits():
    buffer = PoseBuffer(max_gap_s=1)
    assert buffer.lookup(5) is PoseGap.AFTER_LAST
    assert buffer.first_ns is None
    assert buffer.last_ns is None


def test_half_way_of_a_quarter_turn():
    buffer = PoseBuffer(max_gap_s=1)
    buffer.add(1_000_000_000, transform([0, 0, 0], [0, 0, 0]))
    buffer.add(2_000_000_000, transform([0, 0, np.pi / 2], [2, 4, 6]))
    T = buffer.lookup(1_500_000_000)
    np.testing.assert_allclose(T, transform([0, 0, np.pi / 4], [1, 2, 3]), atol=1e-12)


def test_stored_poses_come_back_bit_for_bit_and_as_copies():
    buffer = PoseBuffer(max_gap_s=1e-3)
    poses = [transform([0.1, 0.2, i], [i, 0, 0]) for i in range(3)]
    for i, T in enumerate(poses):
        buffer.add(i * 1_000_000_000, T)
    for i, T in enumerate(poses):
        found = buffer.lookup(i * 1_000_000_000)
        np.testing.assert_array_equal(found, T)
        found[:] = 0
        np.testing.assert_array_equal(buffer.lookup(i * 1_000_000_000), T)


def test_reasons():
    buffer = PoseBuffer(max_gap_s=0.5)
    for stamp_ns in (1_000_000_000, 1_500_000_000, 2_000_000_001):
        buffer.add(stamp_ns, np.eye(4))
    assert buffer.lookup(999_999_999) is PoseGap.BEFORE_FIRST
    assert isinstance(buffer.lookup(1_250_000_000), np.ndarray)
    assert buffer.lookup(1_700_000_000) is PoseGap.TOO_WIDE
    assert isinstance(buffer.lookup(2_000_000_001), np.ndarray)
    assert buffer.lookup(2_000_000_002) is PoseGap.AFTER_LAST


def test_forgetting_keeps_what_later_lookups_need():
    buffer = PoseBuffer(max_gap_s=1)
    for i in range(1000):
        buffer.add(i * 10, np.eye(4))
        buffer.forget_before(i * 10 - 95)
    assert len(buffer) == 11
    assert (buffer.first_ns, buffer.last_ns) == (9890, 9990)
    assert isinstance(buffer.lookup(9895), np.ndarray)
    assert buffer.lookup(9889) is PoseGap.BEFORE_FIRST
    buffer.forget_before(9900)
    assert buffer.first_ns == 9900
    buffer.forget_before(10**9)
    assert (buffer.first_ns, len(buffer)) == (9990, 1)
    buffer.clear()
    buffer.forget_before(5)
    assert len(buffer) == 0
    buffer.add(0, np.eye(4))


@pytest.mark.parametrize("stamp_ns", [5, 4, -1])
def test_stamps_must_rise(stamp_ns):
    buffer = PoseBuffer(max_gap_s=1)
    buffer.add(5, np.eye(4))
    with pytest.raises(ValueError, match="not later"):
        buffer.add(stamp_ns, np.eye(4))
    assert len(buffer) == 1


@given(
    steps_ms=st.lists(st.integers(1, 400), min_size=1, max_size=12),
    seed=st.integers(0, 2**32 - 1),
    share=st.floats(0, 1),
)
def test_interpolation_agrees_with_scipy(steps_ms, seed, share):
    rng = np.random.default_rng(seed)
    start_ns = 1_700_000_000_000_000_000  # Nanoseconds since 1970 do not fit a float64; the buffer must not care.
    offsets_ns = np.concatenate([[0], np.cumsum(steps_ms)]) * 1_000_000
    rotations = Rotation.from_rotvec(rng.normal(size=(len(offsets_ns), 3)))
    positions = rng.normal(size=(len(offsets_ns), 3))
    buffer = PoseBuffer(max_gap_s=0.4)
    for offset_ns, rotation, position in zip(offsets_ns.tolist(), rotations, positions, strict=True):
        buffer.add(start_ns + offset_ns, transform(rotation.as_rotvec(), position))
    at_ns = round(share * int(offsets_ns[-1]))
    T = buffer.lookup(start_ns + at_ns)
    np.testing.assert_allclose(T[:3, :3], Slerp(offsets_ns, rotations)(at_ns).as_matrix(), atol=1e-9)
    expected = [np.interp(at_ns, offsets_ns, positions[:, axis]) for axis in range(3)]
    np.testing.assert_allclose(T[:3, 3], expected, atol=1e-12)
    np.testing.assert_array_equal(T[3], [0, 0, 0, 1])
