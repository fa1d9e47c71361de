"""Compressed depth images: 16-bit PNG, and what image_transport's ``compressedDepth`` plugin writes.

The plugin puts 12 bytes before the image: an int32 and two float32, A and B. The image is a PNG, or two uint32 (columns and
rows) and RVL code. It holds a 16UC1 image as it is, and a 32FC1 image as A / depth + B cut to an integer, with 0 for no
reading. All numbers are little-endian.
"""

from __future__ import annotations

import struct
from typing import Literal, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from fus3dmaps_core.errors import FrameError
from fus3dmaps_core.messages.image_files import ImageHeader, check_ends, check_size, decode_pixels, read_header
from fus3dmaps_core.messages.rvl import decode_rvl

_TRANSPORT = "compressedDepth"
_CONFIG_BYTES = 12
_RVL_SIZE_BYTES = 8
_16_BIT, _FLOAT = ("16UC1", "mono16"), "32FC1"


class DepthFormat(NamedTuple):
    """How a compressed depth image is stored.

    Attributes:
        is_float: Whether it was 32FC1 and holds inverse depth.
        code: ``png`` or ``rvl``.
        offset: Bytes before the image.
    """

    is_float: bool
    code: Literal["png", "rvl"]
    offset: int


def is_compressed_depth(text: str) -> bool:
    """Return whether a message's ``format`` names the ``compressedDepth`` transport."""
    return _TRANSPORT in text


def parse_depth_format(text: str) -> DepthFormat:
    """Parse a message's ``format``, such as ``16UC1; compressedDepth rvl``, ``16UC1; png compressed`` or ``png``.

    Raises:
        FrameError: Reason ``unknown_encoding``: neither a PNG of 16 bits nor ``compressedDepth`` of 16UC1 or 32FC1.
    """
    encoding, separator, coding = text.partition(";")
    encoding, words = (encoding.strip(), coding.split()) if separator else ("", text.split())
    if words[:1] == ["png"] and encoding in ("", *_16_BIT):
        return DepthFormat(False, "png", 0)
    # Plugins before RVL named no code.
    if words[:1] == [_TRANSPORT] and encoding in (*_16_BIT, _FLOAT) and words[1:] in ([], ["png"], ["rvl"]):
        return DepthFormat(encoding == _FLOAT, "rvl" if words[1:] == ["rvl"] else "png", _CONFIG_BYTES)
    raise FrameError(
        f"unknown depth format '{text}', known are 'png', '16UC1; png compressed', "
        f"'16UC1; {_TRANSPORT} png', '16UC1; {_TRANSPORT} rvl' and both with 32FC1",
        reason="unknown_encoding",
    )


def compressed_depth_size(data: bytes, text: str) -> tuple[int, int]:
    """Read width and height of a compressed depth image from its header.

    Args:
        data: The message's data.
        text: The message's format.

    Raises:
        FrameError: Reasons ``unknown_encoding``, ``bad_compression`` (the header is cut, damaged or none) or ``bad_image``
            (no pixels, or more than ``MAX_PIXELS``).
    """
    form = parse_depth_format(text)
    if form.code == "rvl":
        return _rvl_size(data, form.offset)
    header = read_header(data[form.offset :])
    return header.width, header.height


def check_compressed_depth(data: bytes, text: str) -> None:
    """Check format and size, and for a PNG also pixel type and end marker, without decoding pixels.

    Raises:
        FrameError: As :func:`compressed_depth_size`; ``unknown_encoding`` also when an image is not grey of 16 bits.
    """
    form = parse_depth_format(text)
    if form.code == "rvl":
        _rvl_size(data, form.offset)
    else:
        _check_16_bit(check_ends(data[form.offset :]))
    if form.is_float:
        _quantisation(data)


def decode_compressed_depth(data: bytes, text: str, unit_m: float) -> NDArray[np.float32]:
    """Decode a compressed depth image into (h, w) float32 metres; no reading is 0 (16 bit) or NaN (float).

    Args:
        data: The message's data.
        text: The message's format.
        unit_m: Metres per unit of a 16-bit image.

    Raises:
        FrameError: As :func:`check_compressed_depth`, and reason ``bad_compression`` when pixels are missing or damaged.
    """
    check_compressed_depth(data, text)
    form = parse_depth_format(text)
    if form.code == "rvl":
        width, height = _rvl_size(data, form.offset)
        stored = decode_rvl(data[form.offset + _RVL_SIZE_BYTES :], width * height).reshape(height, width)
    else:
        stored = decode_pixels(data[form.offset :], cv2.IMREAD_UNCHANGED)
    if not form.is_float:
        return stored.astype(np.float32) * np.float32(unit_m)
    numerator, offset = _quantisation(data)
    inverse = stored.astype(np.float32) - np.float32(offset)
    # The plugin writes no value at or under B: there is no depth behind infinity.
    known = (stored > 0) & (inverse > 0)
    return np.where(known, np.float32(numerator) / np.where(known, inverse, np.float32(1)), np.float32(np.nan))


def _rvl_size(data: bytes, offset: int) -> tuple[int, int]:
    if len(data) < offset + _RVL_SIZE_BYTES:
        raise FrameError(f"RVL image of {len(data)} bytes is truncated", reason="bad_compression")
    width, height = struct.unpack_from("<II", data, offset)
    check_size(width, height)
    return width, height


def _check_16_bit(header: ImageHeader) -> None:
    if (header.kind, header.bits, header.grey) != ("png", 16, True):
        raise FrameError(
            f"depth must be a png of 16 bits and one channel, not a {header.kind} of {header.bits} bits"
            f"{'' if header.grey else ' and several channels'}",
            reason="unknown_encoding",
        )


def _quantisation(data: bytes) -> tuple[float, float]:
    """Read A and B of inverse depth from data that is known to be long enough."""
    numerator, offset = struct.unpack_from("<ff", data, 4)
    if not (np.isfinite(numerator) and np.isfinite(offset) and numerator > 0):
        raise FrameError(f"inverse depth cannot be quantised by A = {numerator}, B = {offset}", reason="bad_compression")
    return numerator, offset
