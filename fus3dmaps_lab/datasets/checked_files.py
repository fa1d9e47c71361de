"""Reading and checking of dataset files. A file that cannot be used raises an error with its name."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from fus3dmaps_core.errors import FrameError, RecordingError
from fus3dmaps_core.frame import Intrinsics, check_pose
from fus3dmaps_core.messages.image_files import decode_pixels, read_header

_EPOCH_NS = 1_356_998_400 * 1_000_000_000  # 1 January 2013; for files without times, any time but 0 (unset) would do.


def frame_stamp_ns(number: int, rate_hz: float) -> int:
    """Make a stamp for a frame number of a sequence without times, nanoseconds."""
    return _EPOCH_NS + round(number * 1e9 / rate_hz)


def require_directory(path: Path, what: str) -> None:
    """Raise RecordingError unless ``path`` is a directory. ``what`` says what it should hold."""
    if not path.is_dir():
        raise RecordingError(f"'{path}' is not a directory, expected {what}")


def require_file(path: Path, what: str = "") -> Path:
    """Return the path; raise RecordingError unless it is a file. ``what`` says what it should hold."""
    if not path.is_file():
        raise RecordingError(f"file '{path}' is missing" + (f", expected {what}" if what else ""))
    return path


def numbered_files(directory: Path, pattern: str, example: str) -> dict[int, Path]:
    """List the files of a directory by the number in their names, in ascending order.

    Args:
        directory: The directory.
        pattern: Regular expression of the whole name whose first group is the number.
        example: Example of a name, for error messages.

    Raises:
        RecordingError: There is no such directory or no such file in it, or two files have the same number.
    """
    require_directory(directory, f"files like {example}")
    found: dict[int, Path] = {}
    for path in sorted(directory.iterdir()):
        match = re.fullmatch(pattern, path.name)
        if match is None:
            continue
        number = int(match[1])
        if number in found:
            raise RecordingError(f"'{found[number]}' and '{path.name}' are both number {number}")
        found[number] = path
    if not found:
        raise RecordingError(f"'{directory}' holds no file like {example}")
    return dict(sorted(found.items()))


def image_size(path: Path) -> tuple[int, int]:
    """Read width and height of a JPEG or PNG from its header, pixels."""
    try:
        header = read_header(_bytes(path))
    except FrameError as error:
        raise RecordingError(f"'{path}': {error}") from None
    return header.width, header.height


def read_rgb(path: Path) -> NDArray[np.uint8]:
    """Read the (H, W, 3) uint8 colours of a JPEG or PNG."""
    return np.asarray(_pixels(path, cv2.IMREAD_COLOR_RGB), np.uint8)


def read_depth(path: Path, units_per_m: float, no_reading: int = 0) -> NDArray[np.float32]:
    """Read depth from a 16-bit PNG as (h, w) float32 metres.

    Args:
        path: The file.
        units_per_m: Value of a pixel at one metre.
        no_reading: Value that means no reading, besides 0.
    """
    raw = _pixels(path, cv2.IMREAD_UNCHANGED)
    _check_kind(path, raw, np.uint16, 2)
    return np.where(raw == no_reading, 0, raw).astype(np.float32) * np.float32(1 / units_per_m)


def read_packed_depth(path: Path) -> NDArray[np.float32]:
    """Read (h, w) float32 metres from a PNG whose four channels, blue first, are the bytes of a little-endian float."""
    raw = _pixels(path, cv2.IMREAD_UNCHANGED)
    if raw.dtype != np.uint8 or raw.ndim != 3 or raw.shape[2] != 4:
        raise RecordingError(f"'{path}' holds {raw.shape} {raw.dtype}, expected 4 channels of 8 bits that pack a float")
    return np.ascontiguousarray(raw).view("<f4")[:, :, 0].astype(np.float32)


def read_ids(path: Path) -> NDArray[np.int32]:
    """Read the (H, W) int32 values of a PNG with one channel of 8 or 16 bits."""
    raw = _pixels(path, cv2.IMREAD_UNCHANGED)
    if raw.ndim != 2 or raw.dtype not in (np.uint8, np.uint16):
        raise RecordingError(f"'{path}' holds {raw.shape} {raw.dtype}, expected one channel of 8 or 16 bits")
    return raw.astype(np.int32)


def read_rows(path: Path, columns: int) -> NDArray[np.float64]:
    """Read (n, columns) numbers from a text file with one row per line; text after a # is left out.

    Raises:
        RecordingError: It cannot be read, or a line holds anything else; the message names file and line.
    """
    rows = []
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        words = line.split("#")[0].split()
        if not words:
            continue
        try:
            values = [float(word) for word in words]
        except ValueError:
            raise RecordingError(f"'{path}' line {number} does not hold numbers: {line[:60]!r}") from None
        if len(values) != columns:
            raise RecordingError(f"'{path}' line {number} holds {len(values)} numbers, expected {columns}")
        rows.append(values)
    return np.array(rows, dtype=np.float64).reshape(-1, columns)


def read_matrix(path: Path, size: int, *, finite: bool = True) -> NDArray[np.float64]:
    """Read a (size, size) matrix from a text file; line breaks do not matter."""
    words = read_text(path).split()
    try:
        values = np.array(words, dtype=np.float64)
    except ValueError:
        raise RecordingError(f"'{path}' does not hold numbers") from None
    if len(values) != size * size:
        raise RecordingError(f"'{path}' holds {len(values)} numbers, expected a {size}x{size} matrix")
    if finite and not np.all(np.isfinite(values)):
        raise RecordingError(f"'{path}' does not hold a finite {size}x{size} matrix")
    return values.reshape(size, size)


def checked_pose(T: NDArray[np.float64], where: str) -> NDArray[np.float64]:
    """Return the pose; raise RecordingError unless it is a rigid transform. ``where`` names file and line."""
    try:
        check_pose(T)
    except FrameError as error:
        raise RecordingError(f"{where}: {error}") from None
    return T


def camera_model(K: NDArray[np.float64], size: tuple[int, int], where: Path) -> Intrinsics:
    """Return the intrinsics in the upper left 3x3 of ``K`` for images of (width, height) ``size``.

    Raises:
        RecordingError: They are not valid; the message names the file ``where`` they come from.
    """
    try:
        return Intrinsics(float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]), *size)
    except FrameError as error:
        raise RecordingError(f"'{where}': {error}") from None


def read_json(path: Path) -> Any:
    """Read a JSON file."""
    try:
        return json.loads(read_text(path))
    except json.JSONDecodeError as error:
        raise RecordingError(f"'{path}' is not JSON: {error}") from None


def read_text(path: Path) -> str:
    """Read a text file."""
    try:
        return path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise RecordingError(f"cannot read '{path}': {error}") from None


def _bytes(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise RecordingError(f"cannot read '{path}': {error.strerror}") from error


def _pixels(path: Path, flags: int) -> NDArray[Any]:
    try:
        return decode_pixels(_bytes(path), flags)
    except FrameError as error:
        raise RecordingError(f"'{path}' is not an image, or is truncated: {error}") from None


def _check_kind(path: Path, image: NDArray[Any], dtype: type[np.generic], dimensions: int) -> None:
    if image.dtype != dtype or image.ndim != dimensions:
        expected = np.dtype(dtype)
        raise RecordingError(f"'{path}' holds {image.shape} {image.dtype}, expected {dimensions} dimensions of {expected}")
