"""Replica as rendered by the authors of NICE-SLAM: 2,000 frames along a smooth path through each of eight rooms."""

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
    read_json,
    read_rows,
    require_directory,
    require_file,
)
from fus3dmaps_lab.datasets.protocols import Labels, TruePoints
from fus3dmaps_lab.datasets.replica_labels import ReplicaClasses, read_classes, read_labelled_mesh
from fus3dmaps_lab.datasets.sequence import FrameFiles, ImageSequence, every

_RATE_HZ = 30


class ReplicaNiceSlam(ImageSequence):
    """One room: ``results/frameNNNNNN.jpg``, ``results/depthNNNNNN.png``, ``traj.txt``; ``cam_params.json`` one level up.

    ``cam_params.json`` holds ``camera: {w, h, fx, fy, cx, cy, scale}``. A depth pixel is metres times ``scale`` (6553.5) in
    16 bits, 0 without a reading. A line of ``traj.txt`` is a camera-to-world matrix of the optical frame, row by row, in
    metres. (NICE-SLAM's own loader flips y and z, because its renderer looks along -z.) The world is that of the Replica
    meshes. Stamps follow from the frame numbers at 30 Hz.

    The release has no labels. They come from the original Replica release: ``info_semantic.json`` names the classes and
    ``mesh_semantic.ply`` gives the labelled points. Both are looked for in the folder of the option ``habitat``, or in the
    room's own folder ``habitat``.
    """

    name = "replica"

    def __init__(self, directory: Path, *, stride: int = 1, habitat: str = "") -> None:
        """List the frames and read camera, path and classes.

        Args:
            directory: Folder of one room, e.g. ``Replica/office0``.
            stride: Take every n-th frame.
            habitat: Folder of the original release with ``info_semantic.json`` and ``mesh_semantic.ply``.

        Raises:
            RecordingError: A file is missing or invalid, or there is not one pose per image; the message names the file.
        """
        require_directory(directory, "a Replica room as NICE-SLAM rendered it")
        results = directory / "results"
        colors = numbered_files(results, r"frame(\d{6})\.jpg", "frame000000.jpg")
        trajectory = require_file(directory / "traj.txt", "16 numbers a line")
        poses = read_rows(trajectory, 16).reshape(-1, 4, 4)
        if len(poses) != len(colors):
            raise RecordingError(f"'{trajectory}' has {len(poses)} poses, '{results}' {len(colors)} colour images")
        frames = []
        for line, (number, color) in enumerate(colors.items()):
            depth = require_file(results / f"depth{number:06d}.png")
            T = checked_pose(poses[line], f"'{trajectory}' pose {line + 1}")
            frames.append(FrameFiles(frame_stamp_ns(number, _RATE_HZ), color, depth, T))
        K, self._units_per_m = _camera(require_file(directory.resolve().parent / "cam_params.json", "the camera"))
        intrinsics = camera_model(K, image_size(frames[0].rgb), directory.resolve().parent / "cam_params.json")
        folder = Path(habitat) if habitat else directory / "habitat"
        self._classes_known: ReplicaClasses | None = None
        self._mesh = folder / "mesh_semantic.ply"
        if habitat or folder.is_dir():
            self._classes_known = read_classes(require_file(folder / "info_semantic.json"))
            require_file(self._mesh, "faces with object_id")
        labels = self._classes_known.labels if self._classes_known else Labels()
        super().__init__(directory.resolve().name, intrinsics, [frames[i] for i in every(len(frames), stride)], labels)

    def ground_truth_points(self) -> TruePoints | None:
        """Return the centres of the faces of ``mesh_semantic.ply``; None without the original release.

        Raises:
            RecordingError: The mesh cannot be used.
        """
        return None if self._classes_known is None else read_labelled_mesh(self._mesh, self._classes_known)

    def _read_depth(self, path: Path) -> NDArray[np.float32]:
        return read_depth(path, self._units_per_m)


def _camera(path: Path) -> tuple[NDArray[np.float64], float]:
    """Read the 3x3 camera matrix, and the value of a depth pixel at one metre."""
    try:
        fx, fy, cx, cy, scale = (float(read_json(path)["camera"][key]) for key in ("fx", "fy", "cx", "cy", "scale"))
    except (KeyError, TypeError, ValueError) as error:
        raise RecordingError(f"'{path}' holds no camera with fx, fy, cx, cy and scale: {error!r}") from None
    if not (np.isfinite(scale) and scale > 0):
        raise RecordingError(f"'{path}' has a depth scale of {scale}")
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), scale
