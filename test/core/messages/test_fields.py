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

from fus3dmaps_core.errors import FrameError
from fus3dmaps_core.geometry.distortion import Distortion, Rectifier
from fus3dmaps_core.messages import fields, images

NO_BEND = (0.0, 0.0, 0.0, 0.0, 0.0)


def pose_with_covariance(stamp_ns, position, quaternion):
    covered = ros.odometry(stamp_ns, position, quaternion)
    return ros.make("geometry_msgs/msg/PoseWithCovarianceStamped", covered.header, covered.pose)


def transform_stamped(stamp_ns, position, quaternion):
    moved = ros.make(
        "geometry_msgs/msg/Transform",
        ros.make("geometry_msgs/msg/Vector3", *position),
        ros.make("geometry_msgs/msg/Quaternion", *quaternion),
    )
    return ros.make("geometry_msgs/msg/TransformStamped", ros.header(stamp_ns, "map"), "camera", moved)


def camera_info(model: str, coefficients, **changes):
    message = ros.camera_info(0, 640, 480, 500.0, **changes)
    message.distortion_model, message.d = model, np.array(coefficients, float)
    return message


COLOR_LAYOUTS = {"rgb8": (0, 1, 2), "bgr8": (2, 1, 0), "rgba8": (0, 1, 2, None), "bgra8": (2, 1, 0, None)}


@pytest.mark.parametrize("encoding", COLOR_LAYOUTS)
@pytest.mark.parametrize("padding", [0, 5])
def test_colour_encodings(encoding, padding, rng):
    rgb = rng.integers(0, 256, (5, 7, 3), dtype=np.uint8)
    stored = np.stack([np.full((5, 7), 9, np.uint8) if c is None else rgb[:, :, c] for c in COLOR_LAYOUTS[encoding]], axis=2)
    decoded = images.decode_color(ros.image(0, encoding, stored, padding=padding), "/rgb")
    assert decoded.dtype == np.uint8
    assert decoded.flags.c_contiguous
    assert decoded.flags.writeable
    np.testing.assert_array_equal(decoded, rgb)


def test_grey_becomes_three_equal_channels(rng):
    grey = rng.integers(0, 256, (3, 4), dtype=np.uint8)
    np.testing.assert_array_equal(images.decode_color(ros.image(0, "mono8", grey), "/rgb"), np.stack([grey] * 3, axis=2))


@pytest.mark.parametrize("encoding", ["16UC1", "mono16"])
@pytest.mark.parametrize("big_endian", [False, True])
@pytest.mark.parametrize("padding", [0, 3])
def test_16_bit_depth_is_scaled_to_metres(encoding, big_endian, padding):
    stored = np.array([[0, 1, 1000], [256, 4321, 65535]], np.uint16)
    message = ros.image(0, encoding, stored, padding=padding, big_endian=big_endian)
    depth_m = images.decode_depth(message, "/depth", 0.001)
    assert depth_m.dtype == np.float32
    np.testing.assert_allclose(depth_m, [[0, 0.001, 1], [0.256, 4.321, 65.535]], rtol=1e-6)
    np.testing.assert_allclose(images.decode_depth(message, "/depth", 0.0002)[1, 1], 0.8642, rtol=1e-6)


@pytest.mark.parametrize("big_endian", [False, True])
def test_float_depth_keeps_its_values_whatever_the_unit(big_endian):
    stored = np.array([[0.0, np.nan, np.inf], [1.25, 3.5, 1e-3]], np.float32)
    depth_m = images.decode_depth(ros.image(0, "32FC1", stored, big_endian=big_endian, padding=4), "/depth", 0.001)
    assert depth_m.dtype == np.dtype(np.float32)
    np.testing.assert_array_equal(depth_m, stored)


@pytest.mark.parametrize("container", [bytes, bytearray, lambda data: array("B", data), memoryview])
def test_data_may_be_any_buffer(container):
    message = ros.image(0, "rgb8", np.arange(24, dtype=np.uint8).reshape(2, 4, 3))
    message.data = container(message.data.tobytes())
    np.testing.assert_array_equal(images.decode_color(message, "/rgb").ravel(), np.arange(24))


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
    for refuse in (images.check_color, images.decode_color):
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
            images.check_depth(message, "/depth")
        assert caught.value.reason == reason
    with pytest.raises(FrameError, match="'rgb8'"):
        images.decode_depth(ros.image(), "/depth", 0.001)


def test_stamp_is_exact_in_nanoseconds():
    assert fields.stamp_ns(ros.image(1_700_000_000_123_456_789)) == 1_700_000_000_123_456_789


def test_camera_model():
    intrinsics = fields.to_intrinsics(ros.camera_info(0, 640, 480, 500.0), "/info")
    assert (intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy) == (500, 500, 319.5, 239.5)
    assert (intrinsics.width, intrinsics.height) == (640, 480)


def test_camera_model_of_a_binned_region():
    """A point is seen at the pixel where reading out the region and binning puts it."""
    full = fields.to_intrinsics(ros.camera_info(0, 640, 480, 500.0), "/info")
    part = fields.to_intrinsics(ros.camera_info(0, 640, 480, 500.0, binning=(2, 4), roi=(100, 40, 400, 320)), "/info")
    assert (part.width, part.height) == (160, 100)
    x, y = 0.2, -0.1
    u, v = full.fx * x + full.cx, full.fy * y + full.cy
    # The edges of the pixels, not their centres, are what binning divides.
    assert part.fx * x + part.cx == pytest.approx((u - 100 + 0.5) / 2 - 0.5)
    assert part.fy * y + part.cy == pytest.approx((v - 40 + 0.5) / 4 - 0.5)


@pytest.mark.parametrize("focal", [0.0, -5.0, np.nan])
def test_uncalibrated_camera_is_refused(focal):
    with pytest.raises(FrameError, match=r"^/info: ") as caught:
        fields.to_intrinsics(ros.camera_info(0, focal=focal), "/info")
    assert caught.value.reason == "bad_intrinsics"


@pytest.mark.parametrize(
    ("model", "coefficients"),
    [
        ("plumb_bob", (-0.3, 0.1, 0.001, -0.002, 0.0)),
        ("plumb_bob", (-0.3, 0.1, 0.001, -0.002)),
        ("rational_polynomial", (0.5, -2.6, 0.0, 0.0, 1.5, 0.4, -2.4, 1.45)),
        ("equidistant", (0.0, 0.01, 0.0, 0.0)),
    ],
)
def test_distortion(model, coefficients):
    assert fields.to_distortion(camera_info(model, coefficients), "/info") == Distortion(model, coefficients)


@pytest.mark.parametrize(
    ("model", "coefficients"),
    [("plumb_bob", NO_BEND), ("rational_polynomial", [0] * 8), ("equidistant", [0] * 4), ("plumb_bob", ()), ("", ()),
     ("", (0.1, 0, 0, 0, 0)), ("none", NO_BEND)],
)  # fmt: skip
def test_no_distortion(model, coefficients):
    assert fields.to_distortion(camera_info(model, coefficients), "/info") is None


@pytest.mark.parametrize(
    ("model", "coefficients"),
    [("fov", (0.9,)), ("plumb_bob", (0.1,) * 6), ("equidistant", (0.1,) * 5), ("plumb_bob", (0.1, np.nan, 0, 0, 0)),
     ("", (np.inf,)), ("rational_polynomial", (0.1,) * 5)],
)  # fmt: skip
def test_unusable_distortion_is_refused(model, coefficients):
    with pytest.raises(FrameError, match=r"^/info: ") as caught:
        fields.to_distortion(camera_info(model, coefficients), "/info")
    assert caught.value.reason == "bad_intrinsics"


def test_distortion_of_a_binned_region_is_that_of_the_whole_image():
    """Rectifying the part is taking the part of the rectified: coordinates tell the pixels of the whole image apart."""
    lens = ("plumb_bob", (-0.2, 0.05, 0.001, 0.002, 0.0))
    whole, part = camera_info(*lens), camera_info(*lens, binning=(2, 2), roi=(100, 40, 400, 320))
    column, row = np.meshgrid(np.arange(640, dtype=np.float32), np.arange(480, dtype=np.float32))

    def rectify(info, image):
        return Rectifier(fields.to_intrinsics(info, "/info"), fields.to_distortion(info, "/info")).depth(image)

    for coordinate in (column, row):
        binned = coordinate[40:440, 100:420].reshape(200, 2, 160, 2).mean(axis=(1, 3))
        found, expected = rectify(part, binned), rectify(whole, coordinate)[40:440, 100:420].reshape(200, 2, 160, 2)
        inside = found > 0
        assert inside.mean() > 0.9
        # A nearest pixel of the part is half of its 2 x 2 off, one of the whole half of 1.
        assert np.abs(found - expected.mean(axis=(1, 3)))[inside].max() < 2


@pytest.mark.parametrize("build", [ros.pose, ros.odometry, pose_with_covariance, transform_stamped])
@given(
    position=st.tuples(*[st.floats(-1e4, 1e4)] * 3),
    quaternion=st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: np.linalg.norm(q) > 1e-3),
    scale=st.floats(0.991, 1.009),
)
def test_poses_agree_with_scipy(build, position, quaternion, scale):
    unit = np.array(quaternion) / np.linalg.norm(quaternion)
    convert = fields.transform_of if build is transform_stamped else fields.to_pose
    T = convert(build(0, position, (unit * scale).tolist()), "/pose")
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
    for build in (ros.pose, ros.odometry, pose_with_covariance, transform_stamped):
        convert = fields.transform_of if build is transform_stamped else fields.to_pose
        with pytest.raises(FrameError, match=r"^/tracker: ") as caught:
            convert(build(0, position, quaternion), "/tracker")
        assert caught.value.reason == "bad_pose"


def test_any_object_with_the_fields_will_do():
    stamp = SimpleNamespace(sec=3, nanosec=5)
    message = SimpleNamespace(
        header=SimpleNamespace(stamp=stamp), height=1, width=2, encoding="mono8", is_bigendian=0, step=2, data=b"\x01\x02"
    )
    assert fields.stamp_ns(message) == 3_000_000_005
    assert images.decode_color(message, "/rgb").tolist() == [[[1, 1, 1], [2, 2, 2]]]
