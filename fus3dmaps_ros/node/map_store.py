"""Saving the map of a session, reading saved maps, and resuming from one."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from fus3dmaps_core.errors import StorageError
from fus3dmaps_core.saved_maps.directory import list_maps, map_path, map_root
from fus3dmaps_core.saved_maps.manifest import MANIFEST, read_manifest
from fus3dmaps_core.saved_maps.storage import MapInfo, restore_map, save_map
from fus3dmaps_core.voxel_map.semantic_map import SemanticMap
from fus3dmaps_ros.node.session import Session


def save_session(session: Session, root: str, name: str) -> tuple[Path, int]:
    """Save the map as it is now; mapping goes on meanwhile.

    Args:
        session: Has the map.
        root: Directory of saved maps.
        name: The map's name in it.

    Returns:
        The map's path, and its size on disk in bytes.

    Raises:
        StorageError: The name is not allowed, or the map cannot be written; an earlier map of that name stays.
    """
    path = map_path(root, name)
    return path, save_map(path, session.pipeline)


def read_map(session: Session, path: Path) -> tuple[SemanticMap, MapInfo]:
    """Read a saved map into a new one of the session's kind; the session's own map does not change.

    Raises:
        StorageError: There is no map, it is damaged, or it does not fit the session; the message names what differs.
    """
    pipeline = session.pipeline
    fresh = pipeline.empty_map()
    return fresh, restore_map(path, fresh, pipeline.config, pipeline.trio.name)


def named_map(root: str, name: str) -> Path:
    """Return the path of the map with this name, or without a name of the one that was saved last.

    Raises:
        StorageError: There is no such map, or the name is not allowed.
    """
    if name:
        return map_path(root, name)
    names = list_maps(root)
    if not names:
        raise StorageError(f"no map is saved in '{root}'")
    return map_path(root, names[0])


def resume_newest(session: Session, root: str, logger: Any) -> None:
    """Go on from the newest good map among the saved ones; without one the session's map stays empty.

    Args:
        session: Gets the map, which must fit it.
        root: Directory of saved maps.
        logger: The node's logger; gets a line on this map, and on each that is skipped.
    """
    found = _read_newest(session, root, logger.warning)
    if found is None:
        logger.info(f"no map to resume in '{root}'; starting with an empty one")
        return
    name, semantic_map, info = found
    session.worker.restore(semantic_map, info.stamp_ns, info.camera_poses).result()
    logger.info(f"resumed map '{name}': {semantic_map.voxel_count} voxels, {semantic_map.instance_count} instances")


def _read_newest(session: Session, root: str, warn: Callable[[str], object]) -> tuple[str, SemanticMap, MapInfo] | None:
    try:
        names = list_maps(root)
    except StorageError as error:
        warn(f"no map is resumed: {error}")
        return None
    for damaged in sorted({path.parent.name for path in map_root(root).glob(f"*/{MANIFEST}")} - set(names)):
        try:
            read_manifest(map_path(root, damaged))
        except StorageError as error:
            warn(f"map '{damaged}' is not resumed: {error}")
    for name in names:
        try:
            return (name, *read_map(session, map_path(root, name)))
        except StorageError as error:
            warn(f"map '{name}' is not resumed: {error}")
    return None
