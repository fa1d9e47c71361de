"""A saved map: a directory with a manifest and one .npy file per array.

It is written under a temporary name beside its place, flushed to disk and renamed, so that a directory under its final name
is always complete. The manifest holds the SHA-256 of every array; nothing in it is ever unpickled.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fus3dmaps_core.config import Config, MapConfig
from fus3dmaps_core.errors import ConfigError, MapError, StorageError
from fus3dmaps_core.semantic_map import SemanticMap

FORMAT_VERSION = 1
_MANIFEST = "manifest.json"
_FORMAT = "fus3dmaps-map"


@dataclass(frozen=True)
class MapInfo:
    """What a map file tells besides the map.

    Attributes:
        encoder: Registry name of the encoder trio whose space the embeddings live in.
        logit_scale: The trio's factor before a softmax over cosines.
        map_frame: Frame of all positions.
        stamp_ns: Time of the newest frame, nanoseconds.
        config: Configuration that the map was made with.
        camera_poses: (n, 4, 4) float64 T_world_camera of the keyframes.
    """

    encoder: str
    logit_scale: float
    map_frame: str
    stamp_ns: int
    config: Config
    camera_poses: NDArray[np.float64]


def check_map_target(directory: Path) -> None:
    """Raise StorageError if the place holds something that is not a map, which saving would have to destroy."""
    if directory.exists() and not (directory / _MANIFEST).is_file():
        raise StorageError(f"'{directory}' exists and is not a saved map; it is left as it is")


def save_map(directory: Path, semantic_map: SemanticMap, info: MapInfo) -> None:
    """Write a map, replacing a map that is there.

    Raises:
        StorageError: The place holds something that is not a map, or cannot be written; what was there is still there.
    """
    check_map_target(directory)
    arrays = {**semantic_map.export_state(), "camera_poses": info.camera_poses}
    temporary = directory.with_name(f".{directory.name}.{os.getpid()}.writing")
    try:
        shutil.rmtree(temporary, ignore_errors=True)
        temporary.mkdir(parents=True)
        files = {name: _write_array(temporary / f"{name}.npy", array) for name, array in arrays.items()}
        manifest = {
            "format": _FORMAT,
            "version": FORMAT_VERSION,
            "encoder": info.encoder,
            "logit_scale": info.logit_scale,
            "map_frame": info.map_frame,
            "stamp_ns": info.stamp_ns,
            "dimension": semantic_map.dimension,
            "variance_ratio": semantic_map.variance_ratio,
            "config": info.config.flat(),
            "arrays": files,
        }
        text = json.dumps(manifest, indent=1).encode()
        _write(temporary / _MANIFEST, lambda path: path.write_bytes(text))
        _swap(temporary, directory)
    except OSError as error:
        shutil.rmtree(temporary, ignore_errors=True)
        raise StorageError(f"cannot write map '{directory}': {error}") from None


def load_map(directory: Path, device: str = "cpu") -> tuple[SemanticMap, MapInfo]:
    """Read a map.

    Args:
        directory: What :func:`save_map` wrote.
        device: Torch device that is to hold the map.

    Raises:
        StorageError: It is no map, of another version, incomplete or altered; the message names the file.
    """
    manifest = _read_manifest(directory)
    try:
        config = Config.from_flat(manifest["config"])
        map_config = MapConfig.model_validate({**config.map.model_dump(), "device": device})
        arrays = {name: _read_array(directory, name, entry) for name, entry in manifest["arrays"].items()}
        poses = arrays.pop("camera_poses")
        semantic_map = SemanticMap(
            int(manifest["dimension"]), map_config, float(manifest["variance_ratio"]), config.fusion.window_radius_m
        )
        semantic_map.import_state(arrays)
        info = MapInfo(
            str(manifest["encoder"]),
            float(manifest["logit_scale"]),
            str(manifest["map_frame"]),
            int(manifest["stamp_ns"]),
            config,
            poses,
        )
    except (KeyError, TypeError, ValueError, AttributeError, ConfigError, MapError) as error:
        raise StorageError(f"'{directory / _MANIFEST}' does not describe a map: {error}") from None
    return semantic_map, info


def _read_manifest(directory: Path) -> dict[str, Any]:
    path = directory / _MANIFEST
    if not path.is_file():
        raise StorageError(f"'{directory}' is not a saved map: it has no {_MANIFEST}")
    try:
        manifest = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise StorageError(f"cannot read '{path}': {error}") from None
    if not isinstance(manifest, dict) or manifest.get("format") != _FORMAT:
        raise StorageError(f"'{path}' is not the manifest of a saved map")
    if manifest.get("version") != FORMAT_VERSION:
        raise StorageError(f"'{path}' has format version {manifest.get('version')}; this program reads {FORMAT_VERSION}")
    return manifest


def _write_array(path: Path, array: NDArray[Any]) -> dict[str, Any]:
    _write(path, lambda where: np.save(where, array, allow_pickle=False))
    return {"dtype": str(array.dtype), "shape": list(array.shape), "sha256": _digest(path)}


def _read_array(directory: Path, name: str, entry: dict[str, Any]) -> NDArray[Any]:
    if not name.isidentifier():
        raise StorageError(f"'{directory / _MANIFEST}' names an array '{name}', which cannot be one")
    path = directory / f"{name}.npy"
    try:
        if _digest(path) != entry["sha256"]:
            raise StorageError(f"'{path}' is damaged: its checksum is not the manifest's")
        array: NDArray[Any] = np.load(path, allow_pickle=False)
    except (OSError, ValueError) as error:
        raise StorageError(f"cannot read '{path}': {error}") from None
    if str(array.dtype) != entry["dtype"] or list(array.shape) != entry["shape"]:
        raise StorageError(
            f"'{path}' holds {array.dtype} {array.shape}, the manifest says {entry['dtype']} {entry['shape']}"
        )
    return array


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _write(path: Path, write: Callable[[Path], object]) -> None:
    write(path)
    _sync(path)


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _swap(temporary: Path, directory: Path) -> None:
    """Put the complete new directory in the place of the old one."""
    _sync(temporary)
    old = directory.with_name(f".{directory.name}.{os.getpid()}.replaced")
    if directory.exists():
        shutil.rmtree(old, ignore_errors=True)
        directory.rename(old)
    temporary.rename(directory)
    _sync(directory.parent)
    shutil.rmtree(old, ignore_errors=True)
