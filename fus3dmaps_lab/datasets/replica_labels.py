"""Classes of a Replica scene, and the labelled surface of its original release."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fus3dmaps_core.errors import RecordingError
from fus3dmaps_lab.datasets.checked_files import read_json
from fus3dmaps_lab.datasets.ply import read_ply
from fus3dmaps_lab.datasets.protocols import Labels, TruePoints
from fus3dmaps_lab.datasets.sequence import lookup_table

BACKGROUND = frozenset({"wall", "floor", "ceiling", "door", "window", "background"})
"""Names of the classes that the published protocol removes if background does not count."""


@dataclass(frozen=True)
class ReplicaClasses:
    """The classes in ``info_semantic.json`` of the original release.

    Attributes:
        labels: Classes of the scene, in the order of the release's ids.
        table: (n,) class by the release's class id.
        class_of_object: Class by object id; empty if the file lists no objects.
    """

    labels: Labels
    table: NDArray[np.int32]
    class_of_object: dict[int, int]


def read_classes(path: Path) -> ReplicaClasses:
    """Read ``info_semantic.json``: ``classes`` with ``id`` and ``name``, ``objects`` with ``id`` and ``class_id``.

    The classes of the scene are numbered 1, 2, ... in the order of their ids. Ids of 0 and less are unlabelled.

    Raises:
        RecordingError: The file cannot be read or has another form.
    """
    content = read_json(path)
    try:
        listed = sorted((int(item["id"]), str(item["name"])) for item in content["classes"] if int(item["id"]) > 0)
        objects = {int(item["id"]): int(item["class_id"]) for item in content.get("objects", [])}
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise RecordingError(f"'{path}' lists no classes as Replica does: {error!r}") from None
    if not listed:
        raise RecordingError(f"'{path}' lists no classes")
    class_of_id = {release_id: number for number, (release_id, _) in enumerate(listed, start=1)}
    return ReplicaClasses(
        Labels.of([name for _, name in listed], BACKGROUND),
        lookup_table(class_of_id),
        {object_id: class_of_id.get(class_id, 0) for object_id, class_id in objects.items()},
    )


def read_labelled_mesh(path: Path, classes: ReplicaClasses) -> TruePoints:
    """Read the centre of every face of ``mesh_semantic.ply``, whose faces have an ``object_id``.

    The faces of the release are smaller than voxels, so the centres reach every voxel of the surface. Instances are object
    ids plus one, because ids begin at 0; unlabelled faces have no instance.

    Raises:
        RecordingError: The file cannot be read, lacks a property, or names an object that is not in the JSON file.
    """
    elements = read_ply(path)
    try:
        vertices, faces = elements["vertex"], elements["face"]
        corners_m = np.stack([vertices[axis] for axis in "xyz"], axis=1).astype(np.float64)
        places = next(faces[key] for key in ("vertex_indices", "vertex_index") if key in (faces.dtype.names or ()))
        objects = faces["object_id"].astype(np.int64)
    except (KeyError, ValueError, StopIteration):
        raise RecordingError(f"'{path}' has no vertices x, y, z, or no faces with vertex_indices and object_id") from None
    if places.size and not 0 <= places.min() <= places.max() < len(corners_m):
        raise RecordingError(f"'{path}' has a face with a corner that is not there")
    found, where = np.unique(objects, return_inverse=True)
    class_ids = np.array([classes.class_of_object.get(int(i), 0) for i in found], np.int32)[where]
    instances = np.where(class_ids > 0, objects + 1, 0).astype(np.int32)
    return corners_m[places].mean(axis=1), class_ids, instances
