"""Replica as rendered by the authors of Semantic-NeRF: two sequences of 900 frames per room, with labels of pixels."""

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
    read_rows,
    require_directory,
    require_file,
)
from fus3dmaps_lab.datasets.protocols import Labels
from fus3dmaps_lab.datasets.replica_labels import read_classes
from fus3dmaps_lab.datasets.sequence import FrameFiles, ImageSequence, every, look_up

_RATE_HZ = 30


class ReplicaSemanticNerf(ImageSequence):
    """One sequence: ``rgb/rgb_N.png``, ``depth/depth_N.png``, ``semantic_class/semantic_class_N.png``, ``traj_w_c.txt``.

    Depth is 16-bit millimetres along the optical axis. A line of ``traj_w_c.txt`` is a camera-to-world matrix of the optical
    frame, row by row, metres. Images are 640x480 (or 320x240 if they were shrunk), with a horizontal field of view of 90
    degrees and a centred axis: fx = fy = width / 2, cx = (width - 1) / 2, cy = (height - 1) / 2, as in the release's own
    trainer. ``semantic_instance/semantic_instance_N.png`` is optional. Class ids are those of Replica, named by
    ``info_semantic.json`` of the original release. It is looked for at ``semantic_info/ROOM/info_semantic.json`` beside the
    rooms, where the release has it, and in the room's folder. Stamps follow from the frame numbers at 30 Hz.
    """

    name = "replica_semantic_nerf"

    def __init__(self, directory: Path, *, stride: int = 1, sequence: str = "Sequence_1", info: str = "") -> None:
        """List the frames and read path and classes.

        Args:
            directory: Folder of one room, e.g. ``office_0``, or of one of its sequences.
            stride: Take every n-th frame.
            sequence: Folder of the sequence within the room.
            info: Path of ``info_semantic.json``, if it is elsewhere.

        Raises:
            RecordingError: A file is missing or invalid, or there is not one pose per image; the message names the file.
        """
        require_directory(directory, "a Replica room as Semantic-NeRF rendered it")
        folder = directory.resolve()
        folder = folder if (folder / "rgb").is_dir() else folder / sequence
        colors = numbered_files(folder / "rgb", r"rgb_(\d+)\.png", "rgb_0.png")
        trajectory = require_file(folder / "traj_w_c.txt", "16 numbers a line")
        poses = read_rows(trajectory, 16).reshape(-1, 4, 4)
        if len(poses) != len(colors):
            raise RecordingError(f"'{trajectory}' has {len(poses)} poses, '{folder / 'rgb'}' {len(colors)} colour images")
        info_file = _info_file(folder, info)
        has_classes = info_file is not None and (folder / "semantic_class").is_dir()
        has_instances = (folder / "semantic_instance").is_dir()
        frames = []
        for line, (number, color) in enumerate(colors.items()):
            frames.append(
                FrameFiles(
                    frame_stamp_ns(number, _RATE_HZ),
                    color,
                    require_file(folder / "depth" / f"depth_{number}.png"),
                    checked_pose(poses[line], f"'{trajectory}' pose {line + 1}"),
                    require_file(folder / "semantic_class" / f"semantic_class_{number}.png") if has_classes else None,
                    require_file(folder / "semantic_instance" / f"semantic_instance_{number}.png")
                    if has_instances
                    else None,
                )
            )
        width, height = image_size(frames[0].rgb)
        K = np.array([[width / 2, 0, (width - 1) / 2], [0, width / 2, (height - 1) / 2], [0, 0, 1]])
        classes = read_classes(info_file) if has_classes and info_file is not None else None
        self._table = np.zeros(1, np.int32) if classes is None else classes.table
        super().__init__(
            folder.parent.name.replace("_", ""),
            camera_model(K, (width, height), frames[0].rgb),
            [frames[i] for i in every(len(frames), stride)],
            Labels() if classes is None else classes.labels,
        )

    def _read_depth(self, path: Path) -> NDArray[np.float32]:
        return read_depth(path, 1000)

    def _classes(self, raw: NDArray[np.int32], path: Path) -> NDArray[np.int32]:
        return look_up(self._table, raw)


def _info_file(folder: Path, info: str) -> Path | None:
    if info:
        return require_file(Path(info), "the classes of the scene")
    room = folder.parent
    places = (room.parent / "semantic_info" / room.name, room, folder)
    return next((place / "info_semantic.json" for place in places if (place / "info_semantic.json").is_file()), None)
