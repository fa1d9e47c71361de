"""Posed frames from a sequence of Microsoft's 7-Scenes dataset, or of any recording stored in its layout."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from fus3dmaps_core.errors import FrameError, RecordingError
from fus3dmaps_core.frame import Intrinsics, PosedFrame, check_pose

_COLOR_NAME = re.compile(r"frame-(\d{6})\.color\.(?:png|jpg)")
_NO_READING = 65535
_RATE_HZ = 30
_EPOCH_NS = 1_356_998_400 * 1_000_000_000  # Files carry no time: 1 January 2013, the year of the dataset.
_NOMINAL_K = np.array([[585.0, 0.0, 320.0], [0.0, 585.0, 240.0], [0.0, 0.0, 1.0]])


class SevenScenes:
    """One sequence: ``frame-NNNNNN.color.png`` (or .jpg), ``.depth.png`` (16-bit millimetres), ``.pose.txt``.

    Poses are camera-to-world matrices of the optical frame. Depth of 0 and 65535 is no reading. Intrinsics come from
    ``camera-intrinsics.txt`` (3x3) if it is there, else they are the dataset's nominal ones (585, 585, 320, 240). Stamps
    follow from the frame numbers at 30 Hz.
    """

    def __init__(self, directory: Path) -> None:
        """List the sequence.

        Raises:
            RecordingError: The directory is missing or holds no frames, a frame lacks its depth or pose file, or the
                intrinsics are not a camera matrix; the message names the file.
        """
        if not directory.is_dir():
            raise RecordingError(f"7-Scenes sequence '{directory}' is not a directory")
        self._directory = directory
        self._color_files: dict[int, Path] = {}
        for path in sorted(directory.iterdir()):
            match = _COLOR_NAME.fullmatch(path.name)
            if match is None:
                continue
            number = int(match[1])
            if number in self._color_files:
                raise RecordingError(
                    f"frame {number} has two colour images, '{self._color_files[number]}' and '{path.name}'"
                )
            self._color_files[number] = path
        if not self._color_files:
            sequences = ", ".join(path.name for path in sorted(directory.glob("seq-*")))
            hint = f"; it has the sequences {sequences}, give one of them" if sequences else ""
            raise RecordingError(f"'{directory}' holds no frame-NNNNNN.color.png or .jpg{hint}")
        for number in self._color_files:
            for path in (self._depth_file(number), self._pose_file(number)):
                if not path.is_file():
                    raise RecordingError(f"file '{path}' is missing")
        self._K = self._read_intrinsics()

    def __len__(self) -> int:
        """Number of frames."""
        return len(self._color_files)

    def __iter__(self) -> Iterator[PosedFrame]:
        """The frames in order of their numbers.

        Raises:
            RecordingError: A file cannot be read or holds something else than it should; the message names the file.
        """
        for number, color_file in self._color_files.items():
            rgb: NDArray[np.uint8] = _read_image(color_file, cv2.IMREAD_COLOR_RGB, np.dtype(np.uint8), 3)
            depth_file = self._depth_file(number)
            depth_mm = _read_image(depth_file, cv2.IMREAD_UNCHANGED, np.dtype(np.uint16), 2)
            depth_m = np.where(depth_mm == _NO_READING, 0, depth_mm).astype(np.float32) * np.float32(0.001)
            height, width = rgb.shape[:2]
            intrinsics = Intrinsics(self._K[0, 0], self._K[1, 1], self._K[0, 2], self._K[1, 2], width, height)
            yield PosedFrame(_stamp_ns(number), rgb, depth_m, intrinsics, self._read_pose(number))

    @property
    def _intrinsics_file(self) -> Path:
        return self._directory / "camera-intrinsics.txt"

    def _depth_file(self, number: int) -> Path:
        return self._directory / f"frame-{number:06d}.depth.png"

    def _pose_file(self, number: int) -> Path:
        return self._directory / f"frame-{number:06d}.pose.txt"

    def _read_intrinsics(self) -> NDArray[np.float64]:
        if not self._intrinsics_file.exists():
            return _NOMINAL_K
        K = _read_matrix(self._intrinsics_file, (3, 3))
        if K[0, 0] <= 0 or K[1, 1] <= 0:
            raise RecordingError(f"'{self._intrinsics_file}' has a focal length that is not positive")
        return K

    def _read_pose(self, number: int) -> NDArray[np.float64]:
        path = self._pose_file(number)
        T_world_camera = _read_matrix(path, (4, 4))
        try:
            check_pose(T_world_camera)
        except FrameError as error:
            raise RecordingError(f"'{path}': {error}") from None
        return T_world_camera


def _stamp_ns(number: int) -> int:
    return _EPOCH_NS + round(number * 1_000_000_000 / _RATE_HZ)


def _read_image(path: Path, flags: int, dtype: np.dtype[Any], dimensions: int) -> NDArray[Any]:
    try:
        data = np.frombuffer(path.read_bytes(), dtype=np.uint8)
    except OSError as error:
        raise RecordingError(f"cannot read '{path}': {error.strerror}") from error
    image = cv2.imdecode(data, flags) if data.size else None
    if image is None:
        raise RecordingError(f"'{path}' is not an image, or is truncated")
    if image.dtype != dtype or image.ndim != dimensions:
        raise RecordingError(f"'{path}' holds {image.shape} {image.dtype}, expected {dimensions} dimensions of {dtype}")
    return np.asarray(image)


def _read_matrix(path: Path, shape: tuple[int, int]) -> NDArray[np.float64]:
    try:
        rows = [line.split() for line in path.read_text().splitlines() if line.strip()]
        matrix = np.array(rows, dtype=np.float64)
    except (OSError, ValueError) as error:
        raise RecordingError(f"cannot read '{path}': {error}") from None
    if matrix.shape != shape or not np.all(np.isfinite(matrix)):
        raise RecordingError(f"'{path}' does not hold a finite {shape[0]}x{shape[1]} matrix")
    return matrix
