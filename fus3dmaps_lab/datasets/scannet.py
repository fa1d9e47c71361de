"""ScanNet: scans of rooms with an iPad and a depth sensor (Dai et al. 2017), exported from their .sens files."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fus3dmaps_core.errors import ConfigError, RecordingError
from fus3dmaps_core.frame import Intrinsics
from fus3dmaps_lab.datasets.checked_files import (
    camera_model,
    checked_pose,
    frame_stamp_ns,
    image_size,
    numbered_files,
    read_depth,
    read_matrix,
    read_text,
    require_directory,
    require_file,
)
from fus3dmaps_lab.datasets.ply import read_ply
from fus3dmaps_lab.datasets.protocols import Labels, TruePoints
from fus3dmaps_lab.datasets.sequence import FrameFiles, ImageSequence, every, look_up, lookup_table

_RATE_HZ = 30
_VIEWS_DIFFER = 0.03  # Focal lengths and centres of the two cameras may differ by this share of the image's width.
_IGNORED = frozenset({"otherprop", "otherstructure", "otherfurniture", "void", "unannotated"})
_BACKGROUND = frozenset({"wall", "floor", "ceiling", "door", "window", "background"})
_TRUTHS = ("auto", "images", "mesh")


class ScanNet(ImageSequence):
    """One scan: ``color/N.jpg``, ``depth/N.png``, ``pose/N.txt``, ``intrinsic/intrinsic_color.txt`` and ``_depth.txt``.

    This is how the release's SensReader exports a .sens file. Depth is 16-bit millimetres, 0 without a reading. Poses are
    camera-to-world matrices of the optical frame, metres. They are all -inf while tracking was lost; those frames are left
    out and counted in ``lost_poses``. Intrinsics are 4x4 matrices. Colour (1296x968) and depth (640x480) show the same view
    at two sizes. Depth keeps its own size; a scan whose two cameras see different views is refused. Stamps follow from the
    frame numbers at 30 Hz.

    Label images are ``label-filt/N.png``, of the size of the colour images, in the scan's folder or where the release's
    archive unpacks them (``SCAN_2d-label-filt/label-filt``); likewise ``instance-filt/N.png`` for instances. The table
    ``scannetv2-labels.combined.tsv``, looked for in the scan's folder and the two above, turns label ids into NYU40 classes.
    Of these, otherprop, otherstructure and otherfurniture are unlabelled.
    """

    name = "scannet"

    def __init__(self, directory: Path, *, stride: int = 1, labels: str = "", truth: str = "auto") -> None:
        """List the frames and read camera, poses and classes.

        Args:
            directory: Folder of one scan, e.g. ``scans/scene0011_00``.
            stride: Take every n-th frame, counting lost ones.
            labels: Path of ``scannetv2-labels.combined.tsv``, if it is elsewhere.
            truth: Source of the labels: ``images`` (the published protocol) or ``mesh`` (``SCAN_vh_clean_2.labels.ply``);
                ``auto`` takes the images if they exist.

        Raises:
            RecordingError: A file is missing or invalid; the message names it, or says how to export a .sens file.
            ConfigError: ``truth`` is something else.
        """
        if truth not in _TRUTHS:
            raise ConfigError(f"option 'truth' must be one of {', '.join(_TRUTHS)}, got '{truth}'")
        require_directory(directory, "an exported ScanNet scan")
        scan = directory.resolve()
        _refuse_unexported(scan)
        colors = numbered_files(scan / "color", r"(\d+)\.jpg", "0.jpg")
        label_images = None if truth == "mesh" else _filtered(scan, "label-filt")
        instance_images = _filtered(scan, "instance-filt")
        frames, lost = [], 0
        numbers = list(colors)
        for number in (numbers[i] for i in every(len(numbers), stride)):
            depth = require_file(scan / "depth" / f"{number}.png")
            pose_file = require_file(scan / "pose" / f"{number}.txt")
            T = read_matrix(pose_file, 4, finite=False)
            if np.isinf(T).any():
                lost += 1
                continue
            T = checked_pose(T, f"'{pose_file}'")
            label, instance = (
                None if folder is None else require_file(folder / f"{number}.png")
                for folder in (label_images, instance_images)
            )
            frames.append(FrameFiles(frame_stamp_ns(number, _RATE_HZ), colors[number], depth, T, label, instance))
        self._mesh = scan / f"{scan.name}_vh_clean_2.labels.ply"
        if truth == "mesh":
            require_file(self._mesh, "vertices with NYU40 labels")
        self._use_mesh = label_images is None and self._mesh.is_file()
        self._table, self._nyu40, names = np.zeros(1, np.int32), np.zeros(1, np.int32), Labels()
        if label_images is not None or self._use_mesh:
            self._table, self._nyu40, names = _classes_of(_tsv(scan, labels))
        intrinsics = _intrinsics(scan, colors[numbers[0]], scan / "depth" / f"{numbers[0]}.png")
        match = re.fullmatch(r"scene(\d{4})_00", scan.name)
        super().__init__(match[1] if match else scan.name, intrinsics, frames, names, lost)

    def ground_truth_points(self) -> TruePoints | None:
        """Return the labelled vertices of the scan's mesh, without instances; None if the label images are the truth.

        Raises:
            RecordingError: The mesh cannot be used.
        """
        if not self._use_mesh:
            return None
        vertices = read_ply(self._mesh).get("vertex")
        if vertices is None or not {"x", "y", "z", "label"} <= set(vertices.dtype.names or ()):
            raise RecordingError(f"'{self._mesh}' has no vertices with x, y, z and label")
        try:
            classes = look_up(self._nyu40, vertices["label"].astype(np.int32))
        except IndexError:
            raise RecordingError(f"'{self._mesh}' has a label that is none of NYU40: {vertices['label'].max()}") from None
        points_m = np.stack([vertices[axis] for axis in "xyz"], axis=1).astype(np.float64)
        return points_m, classes, np.zeros(len(classes), np.int32)

    def _read_depth(self, path: Path) -> NDArray[np.float32]:
        return read_depth(path, 1000)

    def _classes(self, raw: NDArray[np.int32], path: Path) -> NDArray[np.int32]:
        return look_up(self._table, raw)


def _refuse_unexported(scan: Path) -> None:
    sens = next(iter(sorted(scan.glob("*.sens"))), None)
    if sens is not None and not (scan / "color").is_dir():
        raise RecordingError(
            f"'{sens}' is not exported; run ScanNet's SensReader/python: reader.py --filename {sens} --output_path {scan} "
            "--export_color_images --export_depth_images --export_poses --export_intrinsics"
        )


def _filtered(scan: Path, kind: str) -> Path | None:
    places = (scan / kind, scan / f"{scan.name}_2d-{kind}" / kind)
    return next((place for place in places if place.is_dir()), None)


def _tsv(scan: Path, given: str) -> Path:
    file_name = "scannetv2-labels.combined.tsv"
    if given:
        return require_file(Path(given), file_name)
    places = [folder / file_name for folder in (scan, scan.parent, scan.parent.parent)]
    return next((place for place in places if place.is_file()), None) or require_file(places[1], "the classes of the labels")


def _classes_of(path: Path) -> tuple[NDArray[np.int32], NDArray[np.int32], Labels]:
    """Return the class by ScanNet id, the class by NYU40 id, and the classes, numbered in the order of NYU40 ids."""
    lines = read_text(path).splitlines()
    columns = lines[0].split("\t") if lines else []
    missing = [column for column in ("id", "nyu40id", "nyu40class") if column not in columns]
    if missing:
        raise RecordingError(f"'{path}' has no column {', '.join(missing)}")
    places = [columns.index(column) for column in ("id", "nyu40id", "nyu40class")]
    rows = []
    for number, line in enumerate(lines[1:], start=2):
        cells = line.split("\t")
        try:
            rows.append((int(cells[places[0]]), int(cells[places[1]]), cells[places[2]]))
        except (IndexError, ValueError):
            raise RecordingError(f"'{path}' line {number} has no id, nyu40id and nyu40class") from None
    named = {nyu: name for _, nyu, name in rows if nyu > 0 and name not in _IGNORED}
    class_of_nyu = {nyu: number for number, nyu in enumerate(sorted(named), start=1)}
    return (
        lookup_table({scannet_id: class_of_nyu.get(nyu, 0) for scannet_id, nyu, _ in rows}),
        lookup_table({nyu: class_of_nyu.get(nyu, 0) for nyu in range(41)}),
        Labels.of([named[nyu] for nyu in sorted(named)], _BACKGROUND),
    )


def _intrinsics(scan: Path, color: Path, depth: Path) -> Intrinsics:
    color_file, depth_file = (
        require_file(scan / "intrinsic" / f"intrinsic_{kind}.txt", "a 4x4 camera matrix") for kind in ("color", "depth")
    )
    intrinsics = camera_model(read_matrix(color_file, 4), image_size(color), color_file)
    other = camera_model(read_matrix(depth_file, 4), image_size(depth), depth_file).resized(
        intrinsics.width, intrinsics.height
    )
    if np.abs((intrinsics.matrix - other.matrix)[:2]).max() > _VIEWS_DIFFER * intrinsics.width:
        raise RecordingError(
            f"'{color_file}' and '{depth_file}' are of cameras that do not see one view: {intrinsics}, {other}"
        )
    return intrinsics
