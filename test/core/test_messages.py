"""Messages to arrays: every encoding, byte order and padding against arrays built the other way round; every refusal."""

from __future__ import annotations

from array import array
from types import SimpleNamespace

import numpy as np
import pytest
import ros_messages as ros
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from fus3dmaps_core import messages
from fus3dmaps_core.errors import FrameError

COLOR_LAYOUTS = {"rgb8": (0, 1, 2), "bgr8": (2, 1, 0), "rgba8": (0, 1, 2, None), "bgra8": (2, 1, 0, None)}


@pytest.mark.parametrize("encoding", COLOR_LAYOUTS)
@pytest.mark.parametrize("padding", [0, 5])
def test_colour_encodings(encoding, padding, rng):
    rgb = rng.integers(0, 256, (5, 7, 3), dtype=np.uint8)
    stored = np.stack([np.full((5, 7), 9, np.uint8) if c is None else rgb[:, :, c] for c in COLOR_LAYOUTS[encoding]], axis=2)
    decoded = messages.decode_color(ros.image(0, encoding, stored, padding=padding), "/rgb")
    assert decoded.dtype == np.uint8
    assert decoded.flags.c_contiguous
    assert decoded.flags.writeable
    np.testing.assert_array_equal(decoded, rgb)


def test_grey_becomes_three_equal_channels(rng):
    grey = rng.integers(0, 256, (3, 4), dtype=np.uint8)
    np.testing.assert_array_equal(messages.decode_color(ros.image(0, "mono8", grey), "/rgb"), np.stack([grey] * 3, axis=2))


@pytest.mark.parametrize("encoding", ["16UC1", "mono16"])
@pytest.mark.parametrize("big_endian", [False, True])
@pytest.mark.parametrize("padding", [0, 3])
def test_16_bit_depth_is_scaled_to_metres(encoding, big_endian, padding):
    stored = np.array([[0, 1, 1000], [256, 4321, 65535]], np.uint16)
    message = ros.image(0, encoding, stored, padding=padding, big_endian=big_endian)
    depth_m = messages.decode_depth(message, "/depth", 0.001)
    assert depth_m.dtype == np.float32
    np.testing.assert_allclose(depth_m, [[0, 0.001, 1], [0.256, 4.321, 65.535]], rtol=1e-6)
    np.testing.assert_allclose(messages.decode_depth(message, "/depth", 0.0002)[1, 1], 0.8642, rtol=1e-6)


@pytest.mark.parametrize("big_endian", [False, True])
def test_float_depth_keeps_its_values_whatever_the_unit(big_endian):
    stored = np.array([[0.0, np.nan, np.inf], [1.25, 3.5, 1e-3]], np.float32)
    depth_m = messages.decode_depth(ros.image(0, "32FC1", stored, big_endian=big_endian, padding=4), "/depth", 0.001)
    assert depth_m.dtype == np.dtype(np.float32)
    np.testing.assert_array_equal(depth_m, stored)


@pytest.mark.parametrize("container", [bytes, bytearray, lambda data: array("B", data), memoryview])
def test_data_may_be_any_buffer(container):
    message = ros.image(0, "rgb8", np.arange(24, dtype=np.uint8).reshape(2, 4, 3))
    message.data = container(message.data.tobytes())
    np.testing.assert_array_equal(messages.decode_color(message, "/rgb").ravel(), np.arange(24))


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"encoding": "bayer_rggb8"}, "unknown_encoding"),
        ({"encoding": ""}, "unknown_encoding"),
        ({"encoding": "16UC1"}, "unknown_encoding"),
        ({"width": 0}, "bad_image"),
        ({"height": 0}, "bad_image"),
        ({"width": 7}, "bad_image"),
        ({"height": 5}, "size_mismatch"),
        ({"step": 19}, "size_mismatch"),
        ({"data": np.zeros(71, np.uint8)}, "size_mismatch"),
        ({"data": np.zeros(73, np.uint8)}, "size_mismatch"),
        ({"data": np.zeros(0, np.uint8)}, "size_mismatch"),
    ],
)
def test_unusable_colour_images_are_refused_by_check_and_by_decode(changes, reason):
    message = ros.image(**changes)
    for refuse in (messages.check_color, messages.decode_color):
        with pytest.raises(FrameError, match=r"^/camera/rgb: ") as caught:
            refuse(message, "/camera/rgb")
        assert caught.value.reason == reason


def test_unusable_depth_images_are_refused():
    for message, reason in [
        (ros.image(), "unknown_encoding"),
        (ros.image(0, "16UC1", step=11), "bad_image"),
        (ros.image(0, "16UC1", data=np.zeros(47, np.uint8)), "size_mismatch"),
        (ros.image(0, "32FC1"), "bad_image"),
    ]:
        with pytest.raises(FrameError, match=r"^/depth: ") as caught:
            messages.check_depth(message, "/depth")
        assert caught.value.reason == reason
    with pytest.raises(FrameError, match="'rgb8'"):
        messages.decode_depth(ros.image(), "/depth", 0.001)


def test_stamp_is_exact_in_nanoseconds():
    assert messages.stamp_ns(ros.image(1_700_000_000_123_456_789)) == 1_700_000_000_123_456_789


def test_camera_model():
    intrinsics = messages.to_intrinsics(ros.camera_info(0, 640, 480, 500.0), "/info")
    assert (intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy) == (500, 500, 319.5, 239.5)
    assert (intrinsics.width, intrinsics.height) == (640, 480)


def test_camera_model_of_a_binned_region():
    """A point is seen at the pixel where reading out the region and binning puts it."""
    full = messages.to_intrinsics(ros.camera_info(0, 640, 480, 500.0), "/info")
    part = messages.to_intrinsics(ros.camera_info(0, 640, 480, 500.0, binning=(2, 4), roi=(100, 40, 400, 320)), "/info")
    assert (part.width, part.height) == (160, 100)
    x, y = 0.2, -0.1
    u, v = full.fx * x + full.cx, full.fy * y + full.cy
    # The edges of the pixels, not their centres, are what binning divides.
    assert part.fx * x + part.cx == pytest.approx((u - 100 + 0.5) / 2 - 0.5)
    assert part.fy * y + part.cy == pytest.approx((v - 40 + 0.5) / 4 - 0.5)


@pytest.mark.parametrize("focal", [0.0, -5.0, np.nan])
def test_uncalibrated_camera_is_refused(focal):
    with pytest.raises(FrameError, match=r"^/info: ") as caught:
        messages.to_intrinsics(ros.camera_info(0, focal=focal), "/info")
    assert caught.value.reason == "bad_intrinsics"


@pytest.mark.parametrize("build", [ros.pose, ros.odometry])
@given(
    position=st.tuples(*[st.floats(-1e4, 1e4)] * 3),
    quaternion=st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: np.linalg.norm(q) > 1e-3),
    scale=st.floats(0.991, 1.009),
)
def test_poses_agree_with_scipy(build, position, quaternion, scale):
    unit = np.array(quaternion) / np.linalg.norm(quaternion)
    T = messages.to_pose(build(0, position, (unit * scale).tolist()), "/pose")
    np.testing.assert_array_equal(T[:3, 3], position)
    np.testing.assert_allclose(T[:3, :3], Rotation.from_quat(unit).as_matrix(), atol=1e-12)
    np.testing.assert_array_equal(T[3], [0, 0, 0, 1])


@pytest.mark.parametrize(
    ("position", "quaternion"),
    [
        ((np.nan, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)),
        ((0.0, np.inf, 0.0), (0.0, 0.0, 0.0, 1.0)),
        ((0.0, 0.0, 0.0), (0.0, np.nan, 0.0, 1.0)),
        ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0)),
        ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.02)),
        ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.98)),
    ],
)
def test_poses_that_are_no_poses_are_refused(position, quaternion):
    for build in (ros.pose, ros.odometry):
        with pytest.raises(FrameError, match=r"^/tracker: ") as caught:
            messages.to_pose(build(0, position, quaternion), "/tracker")
        assert caught.value.reason == "bad_pose"


def test_any_object_with_the_fields_will_do():
    stamp = SimpleNamespace(sec=3, nanosec=5)
    message = SimpleNamespace(
        header=SimpleNamespace(stamp=stamp), height=1, width=2, encoding="mono8", is_bigendian=0, step=2, data=b"\x01\x02"
    )
    assert messages.stamp_ns(message) == 3_000_000_005
    assert messages.decode_color(message, "/rgb").tolist() == [[[1, 1, 1], [2, 2, 2]]]
