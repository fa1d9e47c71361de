"""7-Scenes: Kinect recordings of seven rooms by Microsoft Research (Shotton et al. 2013), or others in their layout."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fus3dmaps_core.errors import RecordingError
from fus3dmaps_lab.datasets.checked_files import (
    camera_model,
    checked_pose,
    frame_stamp_ns,
    image_size,
    numbered_files,
    read_depth,
    read_matrix,
    require_directory,
    require_file,
)
from fus3dmaps_lab.datasets.sequence import FrameFiles, ImageSequence, every

_NO_READING = 65535
_RATE_HZ = 30
_NOMINAL_K = np.array([[585.0, 0.0, 320.0], [0.0, 585.0, 240.0], [0.0, 0.0, 1.0]])


class SevenScenes(ImageSequence):
    """One sequence: ``frame-NNNNNN.color.png`` (or .jpg), ``.depth.png`` (16-bit millimetres), ``.pose.txt``.

    Poses are camera-to-world matrices of the optical frame, metres. Depth of 0 and 65535 is no reading. Intrinsics are read
    from ``camera-intrinsics.txt`` (3x3) if it exists; otherwise the dataset's nominal ones are used (585, 585, 320, 240).
    Stamps follow from the frame numbers at 30 Hz. The dataset's page states all of this except the intrinsics file.
    """

    name = "sevenscenes"

    def __init__(self, directory: Path, *, stride: int = 1) -> None:
        """List the sequence and read its poses.

        Args:
            directory: Folder of one sequence, e.g. ``seq-01``.
            stride: Take every n-th frame.

        Raises:
            RecordingError: The directory is missing or holds no frames, a frame lacks its depth or pose file, a pose is not
                rigid, or the intrinsics are not a camera matrix; the message names the file.
        """
        require_directory(directory, "a 7-Scenes sequence")
        sequences = ", ".join(path.name for path in sorted(directory.glob("seq-*")))
        if sequences and not list(directory.glob("frame-*")):
            raise RecordingError(f"'{directory}' has the sequences {sequences}, give one of them")
        colors = numbered_files(directory, r"frame-(\d{6})\.color\.(?:png|jpg)", "frame-000000.color.png")
        frames = []
        for number, color in colors.items():
            stem = directory / f"frame-{number:06d}"
            depth, pose = (require_file(stem.with_name(stem.name + end)) for end in (".depth.png", ".pose.txt"))
            T = checked_pose(read_matrix(pose, 4), f"'{pose}'")
            frames.append(FrameFiles(frame_stamp_ns(number, _RATE_HZ), color, depth, T))
        intrinsics_file = directory / "camera-intrinsics.txt"
        K = read_matrix(intrinsics_file, 3) if intrinsics_file.exists() else _NOMINAL_K
        intrinsics = camera_model(K, image_size(frames[0].rgb), intrinsics_file)
        super().__init__(directory.resolve().name, intrinsics, [frames[i] for i in every(len(frames), stride)])

    def _read_depth(self, path: Path) -> NDArray[np.float32]:
        return read_depth(path, 1000, _NO_READING)
