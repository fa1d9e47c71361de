"""Compressed depth images against plain encoders of known depth; truncated, damaged and other images are refused."""

from __future__ import annotations

import struct

import cv2
import numpy as np
import pytest
import ros_messages as ros
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays
from reference.depth_codes import png, quantised, transport

from fus3dmaps_core.errors import FrameError
from fus3dmaps_core.messages import images

PLAIN = ["png", "16UC1; png compressed ", "16UC1; png compressed", "mono16; png compressed "]
TRANSPORT_16_BIT = {
    "16UC1; compressedDepth": "png",
    "16UC1; compressedDepth ": "png",
    "16UC1; compressedDepth png": "png",
    "mono16; compressedDepth png": "png",
    "16UC1; compressedDepth rvl": "rvl",
}
TRANSPORT_FLOAT = {"32FC1; compressedDepth": "png", "32FC1; compressedDepth png": "png", "32FC1; compressedDepth rvl": "rvl"}
DEPTH_MAX_M, QUANTISATION = 10.0, 100.0

readings = arrays(np.uint16, array_shapes(min_dims=2, max_dims=2, max_side=12), elements=st.sampled_from([0, 1, 900, 65535]))


def compressed(text: str, data: bytes):
    return ros.make("sensor_msgs/msg/CompressedImage", ros.header(0), text, np.frombuffer(data, np.uint8))


@pytest.fixture
def millimetres(rng) -> np.ndarray:
    image = rng.integers(1, 65536, (5, 7)).astype(np.uint16)
    image[1, 2:5] = 0
    return image


@pytest.mark.parametrize("text", [*PLAIN, *TRANSPORT_16_BIT])
def test_16_bit_depth_comes_back_exactly(text, millimetres):
    code = TRANSPORT_16_BIT.get(text)
    message = compressed(text, transport(millimetres, code) if code else png(millimetres))
    images.check_depth(message, "/depth")
    assert images.image_size(message, "/depth") == (7, 5)
    depth_m = images.decode_depth(message, "/depth", 0.001)
    raw = images.decode_depth(ros.image(0, "16UC1", millimetres), "/depth", 0.001)
    assert depth_m.dtype == np.float32
    np.testing.assert_array_equal(depth_m, raw)
    np.testing.assert_allclose(images.decode_depth(message, "/depth", 0.0002), millimetres * 0.0002, rtol=1e-6)


@pytest.mark.parametrize("text", TRANSPORT_FLOAT)
def test_float_depth_comes_back_to_within_its_quantisation(text, rng):
    depth_m = rng.uniform(0.3, 9.9, (6, 9)).astype(np.float32)
    depth_m[0, :3] = np.nan, np.inf, 10.5
    stored, a, b = quantised(depth_m, DEPTH_MAX_M, QUANTISATION)
    message = compressed(text, transport(stored, TRANSPORT_FLOAT[text], a, b))
    images.check_depth(message, "/depth")
    decoded = images.decode_depth(message, "/depth", 0.001)
    assert decoded.dtype == np.float32
    assert np.isnan(decoded[0, :3]).all()
    # Cutting to an integer moves A / depth by less than 1, and so depth by less than depth^2 / A, and only away.
    known = ~np.isnan(decoded)
    assert known.sum() == depth_m.size - 3
    error = decoded[known] - depth_m[known]
    limit = depth_m[known] * decoded[known] / a
    assert (error > -1e-5).all()
    assert (error < limit + 1e-5).all()


def test_inverse_depth_worked_out_by_hand():
    message = compressed("32FC1; compressedDepth rvl", transport(np.array([[0, 3, 25, 1]], np.uint16), "rvl", 50.0, 5.0))
    # 50 / (25 - 5); at or under B = 5 there is nothing.
    np.testing.assert_array_equal(images.decode_depth(message, "/depth", 1.0), np.float32([[np.nan, np.nan, 2.5, np.nan]]))


@pytest.mark.parametrize(
    "text",
    ["", "jpeg", "16UC1; jpeg compressed ", "32FC1; png compressed ", "rgb8; png compressed bgr8", "16UC1", "theora",
     "16UC1; compressedDepth zstd", "8UC1; compressedDepth png", "compressedDepth png"],
)  # fmt: skip
def test_unknown_formats_are_refused(text, millimetres):
    for call in (images.check_depth, decode):
        assert_refused(call, compressed(text, transport(millimetres, "png")), "unknown_encoding")


@pytest.mark.parametrize(
    ("image", "reason"),
    [
        (cv2.imencode(".png", np.zeros((4, 6), np.uint8))[1].tobytes(), "unknown_encoding"),
        (cv2.imencode(".png", np.zeros((4, 6, 3), np.uint16))[1].tobytes(), "unknown_encoding"),
        (cv2.imencode(".jpg", np.zeros((4, 6), np.uint8))[1].tobytes(), "unknown_encoding"),
        (b"", "bad_compression"),
        (b"\x00" * 40, "bad_compression"),
    ],
)
def test_images_that_are_no_16_bit_png_are_refused(image, reason):
    for message in (compressed("png", image), compressed("16UC1; compressedDepth png", bytes(12) + image)):
        assert_refused(images.check_depth, message, reason)
        assert_refused(decode, message, reason)


@pytest.mark.parametrize(("a", "b"), [(np.nan, 0.0), (1.0, np.inf), (0.0, 1.0), (-5.0, 1.0)])
def test_quantisation_that_is_none_is_refused(a, b, millimetres):
    for code in ("png", "rvl"):
        message = compressed(f"32FC1; compressedDepth {code}", transport(millimetres, code, a, b))
        assert_refused(images.check_depth, message, "bad_compression")


@pytest.mark.parametrize(("width", "height"), [(0, 5), (5, 0), (2**31, 2**31), (2**16, 2**16)])
def test_sizes_that_are_none_are_refused(width, height, millimetres):
    good = transport(millimetres, "rvl")
    message = compressed("16UC1; compressedDepth rvl", good[:12] + struct.pack("<II", width, height) + good[20:])
    for call in (images.check_depth, images.image_size, decode):
        assert_refused(call, message, "bad_image")


@settings(max_examples=60)
@given(readings, st.sampled_from([*PLAIN[:2], *TRANSPORT_16_BIT, *TRANSPORT_FLOAT]), st.data())
def test_every_truncation_is_refused(image, text, data):
    code = {**TRANSPORT_16_BIT, **TRANSPORT_FLOAT}.get(text)
    whole = transport(image, code, 50.0, 0.5) if code else png(image)
    assert decode(compressed(text, whole), "/depth").shape == image.shape
    cut = data.draw(st.integers(0, len(whole) - 1))
    assert_refused(decode, compressed(text, whole[:cut]), "bad_compression")


@settings(max_examples=100)
@given(readings, st.sampled_from(["png", *TRANSPORT_16_BIT, *TRANSPORT_FLOAT]), st.data())
def test_flipped_bits_give_an_image_or_a_refusal(image, text, data):
    code = {**TRANSPORT_16_BIT, **TRANSPORT_FLOAT}.get(text)
    damaged = bytearray(transport(image, code, 50.0, 0.5) if code else png(image))
    for _ in range(data.draw(st.integers(1, 3))):
        bit = data.draw(st.integers(0, 8 * len(damaged) - 1))
        damaged[bit // 8] ^= 1 << bit % 8
    message = compressed(text, bytes(damaged))
    try:
        outcome = decode(message, "/depth").shape[::-1]
    except FrameError as error:
        outcome = error.reason
    refusals = ("bad_compression", "bad_image", "unknown_encoding")
    assert outcome in refusals or outcome == images.image_size(message, "/depth")


def decode(message, topic: str) -> np.ndarray:
    return images.decode_depth(message, topic, 0.001)


def assert_refused(call, message, reason: str) -> None:
    with pytest.raises(FrameError, match=r"^/depth: ") as caught:
        call(message, "/depth")
    assert caught.value.reason == reason
