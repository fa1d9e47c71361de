"""JPEG and PNG data in memory: reading headers, checking that the data is complete, decoding pixels.

Image decoders fill missing pixels with grey or noise and report no error. A truncated frame must not get into the map, so
completeness is checked here before pixels are decoded.
"""

from __future__ import annotations

import struct
import zlib
from typing import Any, Literal, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from fus3dmaps_core.errors import FrameError

MAX_PIXELS = 2**26  # Twice the 33 million of an 8K image: a header that claims more would only exhaust the memory.

_JPEG_START, _JPEG_END = b"\xff\xd8\xff", b"\xff\xd9"
_JPEG_NO_LENGTH = {0x01, *range(0xD0, 0xD9)}  # Markers without a segment: TEM, RST0-RST7, SOI.
_JPEG_FRAMES = set(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}  # SOFn hold the size; DHT, JPG and DAC lie between them.
_JPEG_PIXELS_FOLLOW = {0xD9, 0xDA}  # EOI and SOS: no frame header comes after them.
_PNG_START = b"\x89PNG\r\n\x1a\n"
_PNG_END = b"\x00\x00\x00\x00IEND\xaeB`\x82"


class ImageHeader(NamedTuple):
    """The header of a JPEG or PNG.

    Attributes:
        kind: The container, by its first bytes.
        width: Pixels.
        height: Pixels.
        bits: Bits per channel.
        grey: Whether there is one channel, and no palette and no alpha.
    """

    kind: Literal["jpeg", "png"]
    width: int
    height: int
    bits: int
    grey: bool


def read_header(data: bytes) -> ImageHeader:
    """Read the header of a JPEG or PNG, without decoding pixels.

    Raises:
        FrameError: Reason ``bad_compression`` (neither JPEG nor PNG, or the header is cut or damaged) or ``bad_image`` (no
            pixels, or more than ``MAX_PIXELS``).
    """
    if data.startswith(_PNG_START):
        header = _png_header(data)
    elif data.startswith(_JPEG_START):
        header = _jpeg_header(data)
    else:
        raise _damaged(f"{len(data)} bytes that begin with {data[:8].hex(' ') or 'nothing'} are neither JPEG nor PNG")
    check_size(header.width, header.height)
    return header


def check_size(width: int, height: int) -> None:
    """Raise FrameError (reason ``bad_image``) for a compressed image of no pixels, or of more than ``MAX_PIXELS``."""
    if width <= 0 or height <= 0 or width * height > MAX_PIXELS:
        raise FrameError(f"compressed image of {width}x{height} pixels", reason="bad_image")


def check_ends(data: bytes) -> ImageHeader:
    """Check first bytes, header and end marker of a JPEG or PNG, which is cheap. Zero bytes may follow the end marker.

    Returns:
        The header.

    Raises:
        FrameError: As :func:`read_header`, and reason ``bad_compression`` when the end is missing.
    """
    header = read_header(data)
    end = _PNG_END if header.kind == "png" else _JPEG_END
    if not data.rstrip(b"\0").endswith(end):  # Cameras pad what they send to whole transfers.
        raise _damaged(f"{header.kind} of {len(data)} bytes has no end marker: it is truncated")
    return header


def decode_pixels(data: bytes, flags: int) -> NDArray[Any]:
    """Decode a JPEG or PNG by OpenCV's ``IMREAD_`` flags; blue comes first.

    Raises:
        FrameError: As :func:`check_ends`, and reason ``bad_compression`` when a part of a PNG does not match its checksum or
            the pixels cannot be decoded. Damage inside a JPEG, which has no checksums, can go unnoticed.
    """
    header = check_ends(data)
    if header.kind == "png":
        _check_png_parts(data)
    try:
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error as error:
        raise _damaged(f"{header.kind} cannot be decoded: {error}") from None
    if pixels is None or pixels.shape[:2] != (header.height, header.width):
        raise _damaged(f"{header.kind} of {header.width}x{header.height} pixels cannot be decoded")
    return np.asarray(pixels)


def _png_header(data: bytes) -> ImageHeader:
    part = data[8:33]  # Length, name, 13 bytes, checksum.
    if len(part) < 25 or part[:8] != b"\x00\x00\x00\rIHDR" or zlib.crc32(part[4:21]) != int.from_bytes(part[21:], "big"):
        raise _damaged("png has a damaged header")
    width, height, bits, color_type = struct.unpack(">IIBB", part[8:18])
    return ImageHeader("png", width, height, bits, grey=color_type == 0)


def _jpeg_header(data: bytes) -> ImageHeader:
    at = 2
    while at + 4 <= len(data) and data[at] == 0xFF:
        marker = data[at + 1]
        if marker == 0xFF:  # Fill byte.
            at += 1
        elif marker in _JPEG_NO_LENGTH:
            at += 2
        elif marker in _JPEG_FRAMES and at + 10 <= len(data):
            bits, height, width, channels = struct.unpack_from(">BHHB", data, at + 4)
            return ImageHeader("jpeg", width, height, bits, grey=channels == 1)
        elif marker in _JPEG_PIXELS_FOLLOW:
            break
        else:
            at += 2 + max(int.from_bytes(data[at + 2 : at + 4], "big"), 2)
    raise _damaged("jpeg has no frame header")


def _check_png_parts(data: bytes) -> None:
    at = len(_PNG_START)
    while True:
        if at + 12 > len(data):
            raise _damaged(f"png of {len(data)} bytes is truncated")
        length = int.from_bytes(data[at : at + 4], "big")
        stop = at + 8 + length
        name = data[at + 4 : at + 8]
        if zlib.crc32(data[at + 4 : stop]) != int.from_bytes(data[stop : stop + 4], "big"):
            raise _damaged(f"png part {name!r} at byte {at} does not match its checksum")
        if name == b"IEND":
            return
        at = stop + 4


def _damaged(message: str) -> FrameError:
    return FrameError(message, reason="bad_compression")
