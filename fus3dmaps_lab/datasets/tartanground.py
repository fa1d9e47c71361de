"""TartanGround: simulated walks of ground robots by the AirLab of CMU (Patel et al. 2025), in TartanAir v2's layout."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fus3dmaps_core.errors import RecordingError
from fus3dmaps_lab.datasets.checked_files import (
    camera_model,
    frame_stamp_ns,
    image_size,
    numbered_files,
    read_json,
    read_packed_depth,
    read_rows,
    require_directory,
    require_file,
)
from fus3dmaps_lab.datasets.poses import FROM_FORWARD_RIGHT_DOWN, pose_of_quaternion
from fus3dmaps_lab.datasets.protocols import Labels
from fus3dmaps_lab.datasets.sequence import FrameFiles, ImageSequence, every, look_up, lookup_table

_RATE_HZ = 10
_FAR_M = 1000.0  # The sky is a sphere around the scene, about 10 km away; nothing else is so far.
_BACKGROUND = frozenset({"wall", "floor", "ceiling", "door", "window", "background", "ground", "sky"})


class TartanGround(ImageSequence):
    """One trajectory: ``image_lcam_front``, ``depth_lcam_front``, ``seg_lcam_front`` and ``pose_lcam_front.txt``.

    Files are ``NNNNNN_lcam_front.png``, ``NNNNNN_lcam_front_depth.png`` and ``NNNNNN_lcam_front_seg.png``. The release
    documents: 10 Hz; 640x640 pixels with a field of view of 90 degrees, focal length and principal point 320; depth is a
    float32 in metres whose four bytes are the channels of the PNG. A line of the pose file is ``tx ty tz qx qy qz qw`` in a
    NED world, for a camera frame with x forward, y right and z down. Poses are turned into the optical frame, while the
    world stays NED (z points down). The sky is no reading.

    ``seg_label_map.json`` of the environment, in the trajectory's folder or one or two above, has a ``name_map`` from names
    to values of the 8-bit label images. A name with several values is one class. Classes are in the order of their names;
    other values are unlabelled.
    """

    name = "tartanground"

    def __init__(self, directory: Path, *, stride: int = 1) -> None:
        """List the frames and read poses and classes.

        Args:
            directory: Folder of one trajectory, e.g. ``AbandonedFactory/Data_omni/P0000``.
            stride: Take every n-th frame.

        Raises:
            RecordingError: A file is missing or invalid, or there is not one pose per image; the message names the file.
        """
        require_directory(directory, "a TartanGround trajectory")
        folder = directory.resolve()
        colors = numbered_files(folder / "image_lcam_front", r"(\d{6})_lcam_front\.png", "000000_lcam_front.png")
        pose_file = require_file(folder / "pose_lcam_front.txt", "tx ty tz qx qy qz qw a line")
        rows = read_rows(pose_file, 7)
        if len(rows) != len(colors):
            raise RecordingError(
                f"'{pose_file}' has {len(rows)} poses, '{folder / 'image_lcam_front'}' {len(colors)} colour images"
            )
        label_map = next(
            (p / "seg_label_map.json" for p in (folder, *folder.parents[:2]) if (p / "seg_label_map.json").is_file()), None
        )
        segmented = label_map is not None and (folder / "seg_lcam_front").is_dir()
        frames = []
        for line, (number, color) in enumerate(colors.items()):
            stem = f"{number:06d}_lcam_front"
            T_ned_optical = pose_of_quaternion(rows[line], f"'{pose_file}' pose {line + 1}") @ FROM_FORWARD_RIGHT_DOWN
            frames.append(
                FrameFiles(
                    frame_stamp_ns(number, _RATE_HZ),
                    color,
                    require_file(folder / "depth_lcam_front" / f"{stem}_depth.png"),
                    T_ned_optical,
                    require_file(folder / "seg_lcam_front" / f"{stem}_seg.png") if segmented else None,
                )
            )
        self._table, labels = np.zeros(1, np.int32), Labels()
        if segmented and label_map is not None:
            self._table, labels = _classes_of(label_map)
        width, height = image_size(frames[0].rgb)
        K = np.array([[width / 2, 0, width / 2], [0, width / 2, height / 2], [0, 0, 1]])
        super().__init__(
            "_".join(part.name for part in (folder.parent.parent, folder)),
            camera_model(K, (width, height), frames[0].rgb),
            [frames[i] for i in every(len(frames), stride)],
            labels,
        )

    def _read_depth(self, path: Path) -> NDArray[np.float32]:
        depth_m = read_packed_depth(path)
        return np.where(np.isfinite(depth_m) & (depth_m > 0) & (depth_m < _FAR_M), depth_m, np.float32(0))

    def _classes(self, raw: NDArray[np.int32], path: Path) -> NDArray[np.int32]:
        return look_up(self._table, raw)


def _classes_of(path: Path) -> tuple[NDArray[np.int32], Labels]:
    """Return the class by value, (256,), and the classes."""
    content = read_json(path)
    try:
        values = {
            str(name): [int(value) for value in (found if isinstance(found, list) else [found])]
            for name, found in content["name_map"].items()
        }
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise RecordingError(f"'{path}' has no name_map from names to values: {error!r}") from None
    listed = sorted(values)
    class_of_value = dict.fromkeys(range(256), 0)
    for number, name in enumerate(listed, start=1):
        for value in values[name]:
            if not 0 <= value < 256:
                raise RecordingError(f"'{path}': value {value} of '{name}' does not fit in 8 bits")
            class_of_value[value] = number
    return lookup_table(class_of_value), Labels.of(listed, _BACKGROUND)
