"""Raw images against arrays built the other way round: every encoding, byte order and padding, and every refusal."""

from __future__ import annotations

from array import array

import numpy as np
import pytest
import ros_messages as ros

from fus3dmaps_core.errors import FrameError
from fus3dmaps_core.messages import images

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
