"""TUM RGB-D benchmark: Kinect sequences with the poses of a motion capture system (Sturm et al. 2012)."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fus3dmaps_core.errors import ConfigError, RecordingError
from fus3dmaps_core.frame import Intrinsics
from fus3dmaps_core.geometry.distortion import Distortion, Rectifier
from fus3dmaps_core.geometry.trajectory import PoseBuffer, PoseGap
from fus3dmaps_lab.datasets.checked_files import (
    image_size,
    read_depth,
    read_rgb,
    read_rows,
    read_text,
    require_directory,
    require_file,
)
from fus3dmaps_lab.datasets.poses import pose_of_quaternion
from fus3dmaps_lab.datasets.sequence import FrameFiles, ImageSequence, every

_DEPTH_UNITS_PER_M = 5000
_PAIR_WITHIN_NS = 20_000_000  # As in the benchmark's own associate.py.
_POSE_GAP_S = 0.1  # Motion capture runs at 100 Hz; a longer gap means that the markers were out of sight.
# fx, fy, cx, cy and k1, k2, p1, p2, k3 of the three cameras, as the benchmark's page lists them. Camera 3 is rectified.
_CAMERAS = {
    "1": ((517.3, 516.5, 318.6, 255.3), (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
    "2": ((520.9, 521.0, 325.1, 249.7), (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)),
    "3": ((535.4, 539.2, 320.1, 247.6), None),
}


class TumRgbd(ImageSequence):
    """One sequence: ``rgb.txt`` and ``depth.txt`` (stamp and file a line), ``groundtruth.txt``, and the images they name.

    Depth has 16 bits, 5000 per metre, 0 without a reading, and is already registered to the colour image. A line of
    ``groundtruth.txt`` is ``stamp tx ty tz qx qy qz qw``: the pose of the colour camera's optical frame in the world of the
    motion capture system, seconds and metres. A colour image gets the depth image nearest in time, within 20 ms, and the
    pose interpolated at its stamp. Without one it is left out and counted in ``unpaired`` or ``lost_poses``. Lens distortion
    is removed from both images. The camera follows from the sequence's name (freiburg1, 2 or 3) or the option ``camera``.
    """

    name = "tum"

    def __init__(self, directory: Path, *, stride: int = 1, camera: str = "") -> None:
        """Read the lists, pair the images and find their poses.

        Args:
            directory: Folder of one sequence, e.g. ``rgbd_dataset_freiburg1_desk``.
            stride: Take every n-th colour image.
            camera: ``1``, ``2`` or ``3``, if the folder's name does not say.

        Raises:
            RecordingError: A file is missing or invalid, or the camera is unknown; the message names the file.
            ConfigError: ``camera`` is something else.
        """
        require_directory(directory, "a TUM RGB-D sequence")
        sequence = directory.resolve()
        named = re.search(r"freiburg([123])", sequence.name)
        if camera and camera not in _CAMERAS:
            raise ConfigError(f"option 'camera' must be 1, 2 or 3, got '{camera}'")
        if not camera and named is None:
            raise RecordingError(f"'{sequence}' does not say freiburg1, 2 or 3: give the option camera=1, 2 or 3")
        values, coefficients = _CAMERAS[camera or (named[1] if named else "")]
        colors = _list(sequence / "rgb.txt")
        depths = _list(sequence / "depth.txt")
        poses = _poses(require_file(sequence / "groundtruth.txt", "stamp tx ty tz qx qy qz qw a line"))
        depth_stamps = np.array([stamp for stamp, _ in depths])
        frames, lost, self.unpaired = [], 0, 0
        for stamp, color in (colors[i] for i in every(len(colors), stride)):
            nearest = int(np.argmin(np.abs(depth_stamps - stamp)))
            T = poses.lookup(stamp)
            if abs(int(depth_stamps[nearest]) - stamp) > _PAIR_WITHIN_NS:
                self.unpaired += 1
            elif isinstance(T, PoseGap):
                lost += 1
            else:
                frames.append(FrameFiles(stamp, require_file(color), require_file(depths[nearest][1]), T))
        if not frames:
            raise RecordingError(f"'{sequence}': {self.unpaired} of the images lack depth, {lost} a pose")
        intrinsics = Intrinsics(*values, *image_size(frames[0].rgb))
        self._rectifier = Rectifier(intrinsics, Distortion("plumb_bob", coefficients)) if coefficients else None
        super().__init__(sequence.name, intrinsics, frames, lost_poses=lost)

    def _read_rgb(self, path: Path) -> NDArray[np.uint8]:
        rgb = read_rgb(path)
        self._check_size(rgb.shape[:2], path)
        return rgb if self._rectifier is None else self._rectifier.color(rgb)

    def _read_depth(self, path: Path) -> NDArray[np.float32]:
        depth_m = read_depth(path, _DEPTH_UNITS_PER_M)
        self._check_size(depth_m.shape, path)
        return depth_m if self._rectifier is None else self._rectifier.depth(depth_m)

    def _check_size(self, shape: tuple[int, ...], path: Path) -> None:
        expected = (self.intrinsics.height, self.intrinsics.width)
        if shape != expected:
            raise RecordingError(f"'{path}' is {shape[1]}x{shape[0]}, the first image {expected[1]}x{expected[0]}")


def _stamp_ns(text: str, where: str) -> int:
    # Not by float, which is too short for seconds since 1970 with nanoseconds.
    match = re.fullmatch(r"(\d+)(?:\.(\d{1,9})\d*)?", text)
    if match is None:
        raise RecordingError(f"{where} has no stamp in seconds: {text[:30]!r}")
    return int(match[1]) * 1_000_000_000 + int((match[2] or "0").ljust(9, "0"))


def _lines(path: Path) -> list[tuple[str, list[str]]]:
    """Split lines into words, each with its place in the file; leave out comments and empty lines."""
    lines = enumerate(read_text(require_file(path)).splitlines(), start=1)
    return [(f"'{path}' line {n}", line.split()) for n, line in lines if line.strip() and not line.startswith("#")]


def _list(path: Path) -> list[tuple[int, Path]]:
    """Read stamps and files from ``rgb.txt`` or ``depth.txt``, in order of stamps."""
    found = []
    for where, words in _lines(path):
        if len(words) != 2:
            raise RecordingError(f"{where} holds {len(words)} words, expected a stamp and a file")
        found.append((_stamp_ns(words[0], where), path.parent / words[1]))
    if not found:
        raise RecordingError(f"'{path}' lists no images")
    return sorted(found)


def _poses(path: Path) -> PoseBuffer:
    rows = read_rows(path, 8)
    stamps = [_stamp_ns(words[0], where) for where, words in _lines(path)]
    buffer = PoseBuffer(_POSE_GAP_S)
    for row, stamp, (where, _) in zip(rows, stamps, _lines(path), strict=True):
        if buffer.last_ns is not None and stamp <= buffer.last_ns:
            raise RecordingError(f"{where} is not later than the line before")
        buffer.add(stamp, pose_of_quaternion(row[1:], where))
    if not stamps:
        raise RecordingError(f"'{path}' holds no poses")
    return buffer
