"""Walks through houses of Habitat-Matterport 3D Semantics, rendered along the paths that HOV-SG publishes."""

from __future__ import annotations

import csv
import re
from pathlib import Path
from typing import Any

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
    read_ids,
    read_matrix,
    read_text,
    require_directory,
    require_file,
)
from fus3dmaps_lab.datasets.poses import FROM_OPENGL
from fus3dmaps_lab.datasets.protocols import Labels
from fus3dmaps_lab.datasets.sequence import FrameFiles, ImageSequence, every, look_up, lookup_table

_RATE_HZ = 30
_IGNORED = frozenset({"", "void", "unlabeled", "unknown", "remove"})
_BACKGROUND = frozenset({"wall", "floor", "ceiling", "door", "window", "background"})


class Hm3dSem(ImageSequence):
    """One walk: ``rgb/NAME_NNNNNN.png``, ``depth/NAME_NNNNNN.png``, ``pose/NAME_NNNNNN.txt``, ``semantic/NAME_NNNNNN.npy``.

    NAME is the scene's hash and may be missing; a - may replace the _. HOV-SG's generator writes 1080x720 images with a
    horizontal field of view of 90 degrees and a centred axis: fx = fy = width / 2, cx = (width - 1) / 2, cy =
    (height - 1) / 2. Depth is 16-bit millimetres along the axis, 0 without a reading. A pose file is one line: a camera-to-
    world matrix row by row, metres. Its camera looks along -z with y up, as in Habitat; the poses are turned into the
    optical frame here. The world remains Habitat's, where y points up. Stamps follow from the frame numbers at 30 Hz.

    Semantic images hold object ids. ``HASH.semantic.txt`` of the HM3D release (lines of ``id,COLOUR,"category",region``), in
    the walk's folder or at ``objects``, names the category of each. With the table ``categories`` (Habitat's
    ``matterport_category_mappings.tsv`` or Matterport3D's ``category_mapping.tsv``), categories become the 40 Matterport
    classes (``mpcat40``); without it, each category is a class.
    """

    name = "hm3dsem"

    def __init__(self, directory: Path, *, stride: int = 1, objects: str = "", categories: str = "") -> None:
        """List the frames and read poses and classes.

        Args:
            directory: Folder of one walk, e.g. ``hm3dsem_walks/val/00824-Dd4bFSTQ8gi``.
            stride: Take every n-th frame.
            objects: Path of ``HASH.semantic.txt``, if it is not in the walk's folder.
            categories: Path of the table; if empty, either one is looked for in the walk's folder and the two above.

        Raises:
            RecordingError: A file is missing or invalid; the message names it.
        """
        require_directory(directory, "a walk through an HM3DSem scene")
        walk = directory.resolve()
        colors = numbered_files(walk / "rgb", r"(?:.*[-_])?(\d{6})\.png", "Dd4bFSTQ8gi_000000.png")
        objects_file = require_file(Path(objects)) if objects else next(iter(sorted(walk.glob("*.semantic.txt"))), None)
        semantic = objects_file is not None and (walk / "semantic").is_dir()
        frames = []
        for number, color in colors.items():
            pose_file = require_file(walk / "pose" / f"{color.stem}.txt")
            T_world_optical = checked_pose(read_matrix(pose_file, 4), f"'{pose_file}'") @ FROM_OPENGL
            depth = require_file(walk / "depth" / color.name)
            ids = _semantic_file(walk / "semantic", color.stem) if semantic else None
            frames.append(FrameFiles(frame_stamp_ns(number, _RATE_HZ), color, depth, T_world_optical, ids, ids))
        self._table, labels = np.zeros(1, np.int32), Labels()
        if semantic and objects_file is not None:
            self._table, labels = _classes_of(objects_file, _mapping_file(walk, categories))
        width, height = image_size(frames[0].rgb)
        K = np.array([[width / 2, 0, (width - 1) / 2], [0, width / 2, (height - 1) / 2], [0, 0, 1]])
        super().__init__(
            re.sub(r"^(\d{5})-\w+$", r"\1", walk.name),
            camera_model(K, (width, height), frames[0].rgb),
            [frames[i] for i in every(len(frames), stride)],
            labels,
        )

    def _read_depth(self, path: Path) -> NDArray[np.float32]:
        return read_depth(path, 1000)

    def _read_ids(self, path: Path) -> NDArray[np.int32]:
        if path.suffix == ".png":
            return read_ids(path)
        try:
            ids: NDArray[Any] = np.load(path, allow_pickle=False)
        except (OSError, ValueError, EOFError) as error:
            raise RecordingError(f"cannot read '{path}': {error}") from None
        if ids.ndim != 2 or ids.dtype.kind not in "iu" or ids.size == 0 or ids.min() < 0:
            raise RecordingError(f"'{path}' holds {ids.shape} {ids.dtype}, expected 2 dimensions of whole numbers from 0")
        return ids.astype(np.int32)

    def _classes(self, raw: NDArray[np.int32], path: Path) -> NDArray[np.int32]:
        return look_up(self._table, raw)


def _semantic_file(folder: Path, stem: str) -> Path:
    image = folder / f"{stem}.png"
    return image if image.is_file() else require_file(folder / f"{stem}.npy", "object ids")


def _mapping_file(walk: Path, given: str) -> Path | None:
    if given:
        return require_file(Path(given), "categories of Matterport3D")
    folders = (walk, *walk.parents[:2])
    places = [folder / name for folder in folders for name in ("matterport_category_mappings.tsv", "category_mapping.tsv")]
    return next((place for place in places if place.is_file()), None)


def _classes_of(objects_file: Path, mapping_file: Path | None) -> tuple[NDArray[np.int32], Labels]:
    """Return the class of each object id, and the classes in the order of their names."""
    category_of_object: dict[int, str] = {}
    for number, row in enumerate(csv.reader(read_text(objects_file).splitlines()), start=1):
        if number == 1 and row and row[0].startswith("HM3D Semantic"):
            continue
        try:
            category_of_object[int(row[0])] = row[2].strip()
        except (IndexError, ValueError):
            raise RecordingError(f"'{objects_file}' line {number} is no id, colour, category and region") from None
    if mapping_file is not None:
        mapping = _mapping(mapping_file)
        category_of_object = {i: mapping.get(name, "") for i, name in category_of_object.items()}
    listed = sorted({name for name in category_of_object.values() if name not in _IGNORED})
    class_of_name = {name: number for number, name in enumerate(listed, start=1)}
    table = lookup_table({i: class_of_name.get(name, 0) for i, name in category_of_object.items()})
    return table, Labels.of(listed, _BACKGROUND)


def _mapping(path: Path) -> dict[str, str]:
    # Habitat's copy of the table separates columns by four spaces, Matterport's own by a tab.
    rows = csv.DictReader(read_text(path).replace("    ", "\t").splitlines(), delimiter="\t")
    if not {"raw_category", "mpcat40"} <= set(rows.fieldnames or ()):
        raise RecordingError(f"'{path}' has no columns raw_category and mpcat40")
    return {row["raw_category"]: (row["mpcat40"] or "").replace("_", " ") for row in rows}
