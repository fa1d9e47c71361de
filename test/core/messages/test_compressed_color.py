"""Compressed colour images against OpenCV's encoder; sizes; truncated, damaged and other images are refused."""

from __future__ import annotations

from array import array
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import ros_messages as ros
from hypothesis import given, settings
from hypothesis import strategies as st

from fus3dmaps_core.errors import FrameError
from fus3dmaps_core.messages import images

JPEG_FORMATS = [
    "jpeg",
    "jpg",
    "rgb8; jpeg compressed bgr8",
    "bgr8; jpeg compressed bgr8",
    "bayer_rggb8; jpeg compressed bgr8",
]
PNG_FORMATS = ["png", "bgr8; png compressed ", "rgb8; png compressed bgr8", "bgra8; png compressed bgr8"]


def compressed(text: str, data: bytes):
    return ros.make("sensor_msgs/msg/CompressedImage", ros.header(0), text, np.frombuffer(data, np.uint8))


def encoded(kind: str, rgb: np.ndarray, *options: int) -> bytes:
    bgr = rgb[:, :, ::-1] if rgb.ndim == 3 else rgb
    return cv2.imencode(f".{kind}", np.ascontiguousarray(bgr), options)[1].tobytes()


def smooth_rgb(height: int = 24, width: int = 36) -> np.ndarray:
    """Make an image whose red grows to the right, green downwards, blue to the left: swapped channels or axes show."""
    right, down = np.linspace(20, 230, width), np.linspace(40, 200, height)
    return np.stack(np.broadcast_arrays(right, down[:, None], right[::-1]), axis=2).round().astype(np.uint8)


@pytest.mark.parametrize("text", PNG_FORMATS)
def test_png_comes_back_exactly(text, rng):
    rgb = rng.integers(0, 256, (5, 7, 3), dtype=np.uint8)
    message = compressed(text, encoded("png", rgb))
    images.check_color(message, "/rgb")
    decoded = images.decode_color(message, "/rgb")
    assert decoded.flags.c_contiguous
    assert decoded.flags.writeable
    assert decoded.dtype == np.uint8
    np.testing.assert_array_equal(decoded, rgb)


@pytest.mark.parametrize("text", JPEG_FORMATS)
def test_jpeg_comes_back_nearly(text):
    rgb = smooth_rgb()
    message = compressed(text, encoded("jpg", rgb, cv2.IMWRITE_JPEG_QUALITY, 98))
    images.check_color(message, "/rgb")
    decoded = images.decode_color(message, "/rgb")
    assert decoded.flags.c_contiguous
    assert np.abs(decoded.astype(int) - rgb).max() <= 12


@pytest.mark.parametrize(("kind", "text"), [("png", "mono8; png compressed "), ("jpg", "mono8; jpeg compressed ")])
def test_grey_becomes_three_equal_channels(kind, text):
    grey = smooth_rgb()[:, :, 1]
    decoded = images.decode_color(compressed(text, encoded(kind, grey)), "/rgb")
    np.testing.assert_allclose(decoded, np.stack([grey] * 3, axis=2), atol=2)
    np.testing.assert_array_equal(decoded[:, :, 0], decoded[:, :, 2])


def test_alpha_is_dropped(rng):
    bgra = rng.integers(0, 256, (4, 5, 4), dtype=np.uint8)
    data = cv2.imencode(".png", bgra)[1].tobytes()
    np.testing.assert_array_equal(images.decode_color(compressed("png", data), "/rgb"), bgra[:, :, 2::-1])


def test_orientation_in_a_jpeg_is_ignored():
    data = encoded("jpg", smooth_rgb())
    # Exif of one entry: orientation (0x112), 6 = turned by 90 degrees.
    exif = b"Exif\0\0MM\0\x2a\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\0\0\0\0"
    turned = data[:2] + b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif + data[2:]
    assert cv2.imdecode(np.frombuffer(turned, np.uint8), cv2.IMREAD_COLOR).shape == (36, 24, 3)
    message = compressed("jpeg", turned)
    assert images.image_size(message, "/rgb") == (36, 24)
    np.testing.assert_array_equal(
        images.decode_color(message, "/rgb"), images.decode_color(compressed("jpeg", data), "/rgb")
    )


@pytest.mark.parametrize("kind", ["png", "jpg"])
@pytest.mark.parametrize("progressive", [0, 1])
def test_size_of_a_compressed_image(kind, progressive, rng):
    options = (cv2.IMWRITE_JPEG_PROGRESSIVE, progressive) if kind == "jpg" else ()
    for height, width in [(1, 1), (3, 300), (257, 2)]:
        data = encoded(kind, rng.integers(0, 256, (height, width, 3), dtype=np.uint8), *options)
        assert images.image_size(compressed(kind, data), "/rgb") == (width, height)


def test_size_of_a_raw_image():
    assert images.image_size(ros.image(), "/rgb") == (6, 4)
    with pytest.raises(FrameError, match=r"^/rgb: ") as caught:
        images.image_size(ros.image(width=0), "/rgb")
    assert caught.value.reason == "bad_image"


@pytest.mark.parametrize("container", [bytes, bytearray, lambda data: array("B", data), memoryview])
def test_data_may_be_any_buffer(container):
    rgb = smooth_rgb()
    message = SimpleNamespace(format="png", data=container(encoded("png", rgb)))
    np.testing.assert_array_equal(images.decode_color(message, "/rgb"), rgb)


@pytest.mark.parametrize("kind", ["png", "jpg"])
def test_zeros_after_the_end_are_padding(kind):
    data = encoded(kind, smooth_rgb())
    whole = images.decode_color(compressed(kind, data), "/rgb")
    np.testing.assert_array_equal(images.decode_color(compressed(kind, data + bytes(500)), "/rgb"), whole)


@pytest.mark.parametrize(
    ("text", "data", "reason"),
    [
        ("", encoded("png", smooth_rgb()), "unknown_encoding"),
        ("webp", encoded("png", smooth_rgb()), "unknown_encoding"),
        ("h264", encoded("jpg", smooth_rgb()), "unknown_encoding"),
        ("16UC1; compressedDepth png", encoded("png", smooth_rgb()), "unknown_encoding"),
        ("png", cv2.imencode(".png", np.ones((4, 5), np.uint16))[1].tobytes(), "unknown_encoding"),
        ("jpeg", b"", "bad_compression"),
        ("jpeg", b"\xff\xd8\xff", "bad_compression"),
        ("jpeg", b"\xff\xd8\xff\xd9", "bad_compression"),
        ("jpeg", b"not an image at all", "bad_compression"),
        ("png", b"\x89PNG\r\n\x1a\n", "bad_compression"),
        ("png", bytes(1000), "bad_compression"),
    ],
)
def test_unusable_images_are_refused_by_check_and_by_decode(text, data, reason):
    for refuse in (images.check_color, images.decode_color):
        assert_refused(refuse, compressed(text, data), reason)


@settings(max_examples=60)
@given(st.sampled_from(["png", "jpg"]), st.data())
def test_every_truncation_is_refused(kind, data):
    whole = encoded(kind, smooth_rgb())
    message = compressed(kind, whole[: data.draw(st.integers(0, len(whole) - 1))])
    for refuse in (images.check_color, images.decode_color):
        assert_refused(refuse, message, "bad_compression")


@settings(max_examples=80)
@given(st.data())
def test_a_png_with_a_flipped_bit_is_refused(data):
    damaged = bytearray(encoded("png", smooth_rgb()))
    bit = data.draw(st.integers(0, 8 * len(damaged) - 1))
    damaged[bit // 8] ^= 1 << bit % 8
    assert_refused(images.decode_color, compressed("png", bytes(damaged)), "bad_compression")


@settings(max_examples=80)
@given(st.data())
def test_a_jpeg_with_flipped_bits_gives_an_image_or_a_refusal(data):
    damaged = bytearray(encoded("jpg", smooth_rgb()))
    for _ in range(data.draw(st.integers(1, 3))):
        bit = data.draw(st.integers(0, 8 * len(damaged) - 1))
        damaged[bit // 8] ^= 1 << bit % 8
    message = compressed("jpeg", bytes(damaged))
    try:
        outcome = images.decode_color(message, "/rgb").shape[1::-1]
    except FrameError as error:
        outcome = error.reason
    refusals = ("bad_compression", "bad_image", "unknown_encoding")
    assert outcome in refusals or outcome == images.image_size(message, "/rgb")


def assert_refused(call, message, reason: str) -> None:
    with pytest.raises(FrameError, match=r"^/rgb: ") as caught:
        call(message, "/rgb")
    assert caught.value.reason == reason
