"""Checking and decoding of image messages, raw or compressed by image_transport.

The functions take ``sensor_msgs/Image`` and ``sensor_msgs/CompressedImage``, as rclpy delivers them or as rosbags
deserialises them. A message that cannot be used raises a FrameError
that names the topic.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from fus3dmaps_core.errors import FrameError
from fus3dmaps_core.messages.compressed_depth import (
    check_compressed_depth,
    compressed_depth_size,
    decode_compressed_depth,
    is_compressed_depth,
)
from fus3dmaps_core.messages.image_files import check_ends, decode_pixels, read_header


class _Encoding(NamedTuple):
    """How a pixel is stored: scalar type, number of channels, and which of them are red, green and blue."""

    dtype: np.dtype[Any]
    channels: int = 1
    rgb: slice = slice(0, 1)


_FORWARD, _BACKWARD = slice(0, 3), slice(2, None, -1)


_COLOR_ENCODINGS = {
    "rgb8": _Encoding(np.dtype(np.uint8), 3, _FORWARD),
    "bgr8": _Encoding(np.dtype(np.uint8), 3, _BACKWARD),
    "rgba8": _Encoding(np.dtype(np.uint8), 4, _FORWARD),
    "bgra8": _Encoding(np.dtype(np.uint8), 4, _BACKWARD),
    "mono8": _Encoding(np.dtype(np.uint8)),
}
_DEPTH_ENCODINGS = {
    "16UC1": _Encoding(np.dtype(np.uint16)),
    "mono16": _Encoding(np.dtype(np.uint16)),
    "32FC1": _Encoding(np.dtype(np.float32)),
}
_COLOR_FILES = ("jpeg", "jpg", "png")  # cv_bridge writes jpg.


@contextmanager
def about(topic: str) -> Iterator[None]:
    """Put the topic in front of the message of every FrameError raised inside the ``with`` block."""
    try:
        yield
    except FrameError as error:
        raise FrameError(f"{topic}: {error}", reason=error.reason) from None


def image_size(message: Any, topic: str) -> tuple[int, int]:
    """Read width and height of an image in pixels, without decoding it.

    Raises:
        FrameError: Reasons ``bad_image`` (no pixels), ``bad_compression`` (the header is cut, damaged or none) or
            ``unknown_encoding`` (a ``compressedDepth`` format that is not known).
    """
    with about(topic):
        if _is_compressed(message):
            data = bytes(message.data)
            if is_compressed_depth(message.format):
                return compressed_depth_size(data, message.format)
            header = read_header(data)
            return header.width, header.height
        _check_has_pixels(message)
        return int(message.width), int(message.height)


def check_color(message: Any, topic: str) -> None:
    """Check a colour image without decoding its pixels.

    For a raw image, check encoding, sizes and data length; for a compressed one, format, first bytes, header and end marker.

    Raises:
        FrameError: Reasons ``unknown_encoding``, ``bad_image`` (no pixels, rows too short), ``size_mismatch`` (the data
            is not height x step bytes) or ``bad_compression`` (neither JPEG nor PNG, or truncated).
    """
    with about(topic):
        if _is_compressed(message):
            _check_compressed_color(message)
        else:
            _checked_encoding(message, _COLOR_ENCODINGS)


def check_depth(message: Any, topic: str) -> None:
    """Check a depth image without decoding its pixels; raises the errors of :func:`check_color`."""
    with about(topic):
        if _is_compressed(message):
            check_compressed_depth(bytes(message.data), message.format)
        else:
            _checked_encoding(message, _DEPTH_ENCODINGS)


def decode_color(message: Any, topic: str) -> NDArray[np.uint8]:
    """Decode a colour or grey image into a new (H, W, 3) uint8 array, red first.

    The colours of a compressed image are taken from the JPEG or PNG, whatever its format field says. An orientation tag is
    ignored, because the camera model has none.

    Raises:
        FrameError: As :func:`check_color`, and reason ``bad_compression`` when pixels cannot be decoded.
    """
    with about(topic):
        if _is_compressed(message):
            _check_compressed_color(message)
            bgr = decode_pixels(bytes(message.data), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
            return np.ascontiguousarray(bgr[:, :, ::-1])
        encoding = _checked_encoding(message, _COLOR_ENCODINGS)
    colors = _pixels(message, encoding)[:, :, encoding.rgb]
    return np.array(np.broadcast_to(colors, (*colors.shape[:2], 3)), order="C")


def decode_depth(message: Any, topic: str, unit_m: float) -> NDArray[np.float32]:
    """Decode a depth image into (h, w) float32 metres; pixels without a reading are 0 (16 bit) or 0, NaN or inf (float).

    Args:
        message: Image of encoding 16UC1, mono16 or 32FC1, or CompressedImage: a 16-bit PNG, or ``compressedDepth``.
        topic: Where it came from, for error messages.
        unit_m: Metres per unit of a 16-bit image; float images are metres [REP-118].

    Raises:
        FrameError: As :func:`check_depth`, and reason ``bad_compression`` when pixels cannot be decoded.
    """
    with about(topic):
        if _is_compressed(message):
            return decode_compressed_depth(bytes(message.data), message.format, unit_m)
        encoding = _checked_encoding(message, _DEPTH_ENCODINGS)
    readings = _pixels(message, encoding)[:, :, 0].astype(np.float32)
    if encoding.dtype == np.uint16:
        readings *= np.float32(unit_m)
    return readings


def _is_compressed(message: Any) -> bool:
    return hasattr(message, "format")


def _check_compressed_color(message: Any) -> None:
    _, separator, coding = message.format.partition(";")
    words = (coding if separator else message.format).split()
    if words[:1] == [] or words[0] not in _COLOR_FILES:
        raise FrameError(
            f"unknown format '{message.format}', known for colour are {', '.join(_COLOR_FILES)}", reason="unknown_encoding"
        )
    header = check_ends(bytes(message.data))
    if header.bits > 8:
        raise FrameError(f"{header.kind} of {header.bits} bits per channel is no colour image", reason="unknown_encoding")


def _check_has_pixels(message: Any) -> None:
    if int(message.height) <= 0 or int(message.width) <= 0:
        raise FrameError(f"image of {message.width}x{message.height} pixels", reason="bad_image")


def _checked_encoding(message: Any, encodings: dict[str, _Encoding]) -> _Encoding:
    encoding = encodings.get(message.encoding)
    if encoding is None:
        raise FrameError(
            f"unknown encoding '{message.encoding}', known are {', '.join(encodings)}", reason="unknown_encoding"
        )
    _check_has_pixels(message)
    height, width, step = int(message.height), int(message.width), int(message.step)
    row_bytes = width * encoding.channels * encoding.dtype.itemsize
    if step < row_bytes:
        raise FrameError(
            f"step of {step} bytes is too short for {width} pixels of {message.encoding} ({row_bytes} bytes)",
            reason="bad_image",
        )
    if len(message.data) != height * step:
        raise FrameError(
            f"image of {height} rows of {step} bytes holds {len(message.data)} bytes, not {height * step}",
            reason="size_mismatch",
        )
    return encoding


def _pixels(message: Any, encoding: _Encoding) -> NDArray[Any]:
    """Return the pixels as (H, W, channels), in the byte order of the message."""
    height, width, step = int(message.height), int(message.width), int(message.step)
    row_bytes = width * encoding.channels * encoding.dtype.itemsize
    rows = np.frombuffer(message.data, dtype=np.uint8).reshape(height, step)[:, :row_bytes]
    dtype = encoding.dtype.newbyteorder(">" if message.is_bigendian else "<")
    return np.ascontiguousarray(rows).view(dtype).reshape(height, width, encoding.channels)
