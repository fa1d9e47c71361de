"""Fields of messages to arrays: stamps, camera models, poses and transforms, and every refusal."""

from __future__ import annotations

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


def test_stamp_is_exact_in_nanoseconds():
    assert fields.stamp_ns(ros.image(1_700_000_000_123_456_789)) == 1_700_000_000_123_456_789


def test_camera_model():
    intrinsics = fields.to_intrinsics(ros.camera_info(0, 640, 480, 500.0), "/info")
    assert (intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy) == (500, 500, 319.5, 239.5)
    assert (intrinsics.width, intrinsics.height) == (640, 480)


def test_camera_model_of_a_binned_region():
    """A point is projected to its pixel after cropping to the region and binning."""
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
    """Rectifying a part gives the part of the rectified whole. Pixels hold their coordinates, so they can be told apart."""
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
