"""Saved maps: a directory with a manifest and one .npy file per array, replaced at one point or not at all.

Whenever a save ends, by success, refusal or a killed process, the directory holds the last map whose save was committed. The
manifest holds the SHA-256 of every array; nothing in it is ever unpickled. ``docs/map_files.md`` has the format.
"""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from fus3dmaps_core.answers.query import QueryAnswer, TextQuery, answer_query
from fus3dmaps_core.config.schema import Config, MapConfig
from fus3dmaps_core.encoders.protocols import TextEncoder
from fus3dmaps_core.encoders.registry import load_text_encoder
from fus3dmaps_core.errors import ConfigError, MapError, StorageError
from fus3dmaps_core.saved_maps.files import commit, is_own_name, opened, read_array, write_array, writing_to
from fus3dmaps_core.saved_maps.manifest import FORMAT_VERSION, MANIFEST, Manifest, read_manifest
from fus3dmaps_core.voxel_map.semantic_map import SemanticMap

__all__ = [
    "FORMAT_VERSION",
    "MapInfo",
    "Savable",
    "SavedMap",
    "check_fits",
    "check_map_target",
    "load_map",
    "read_manifest",
    "restore_map",
    "save_map",
]

_POSES = "camera_poses"


_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class MapInfo:
    """What a saved map tells besides the map.

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


class Savable(Protocol):
    """A map that can be saved: a pipeline, or what :func:`load_map` returns."""

    @property
    def semantic_map(self) -> SemanticMap:
        """The map."""

    @property
    def info(self) -> MapInfo:
        """What is to be known besides."""


class SavedMap(NamedTuple):
    """A map that was read from a directory.

    Attributes:
        semantic_map: The map.
        info: What the saved map tells besides.
    """

    semantic_map: SemanticMap
    info: MapInfo

    def ask(self, prompts: str | Sequence[str] | TextQuery, **options: Any) -> QueryAnswer:
        """Answer a query in words, e.g. ``load_map("kitchen").ask("a mug", top_k=3)``. Loads the text encoder once.

        Args:
            prompts: What to look for: a prompt, several, or a whole query.
            **options: Other attributes of :class:`TextQuery`, by name.

        Raises:
            QueryError: The query is malformed, or the map or the layer is empty.
            EncoderError: The text encoder cannot be loaded here.
        """
        encoder = _text_encoder(self.info.encoder, self.info.config.encoder.weights)
        query = TextQuery.of(prompts, self.info.config.query, **options)
        return answer_query(self.semantic_map, encoder, query, self.info.logit_scale)

    def __repr__(self) -> str:
        """Say how much the map holds and where it comes from."""
        return f"SavedMap({len(self.info.camera_poses):,} keyframes in frame '{self.info.map_frame}', {self.semantic_map!r})"


@lru_cache(maxsize=2)
def _text_encoder(name: str, weights: str) -> TextEncoder:
    return load_text_encoder(name, "cpu", weights)


def check_map_target(directory: Path) -> None:
    """Refuse a place where saving would have to destroy something else than a map that this program reads.

    Raises:
        StorageError: The place holds something that is not a map, a map of another version or one whose manifest is
            damaged, or cannot be looked at; the message names it.
    """
    try:
        # Listed once: looked up one by one, a manifest that another save commits meanwhile would be taken for a stranger.
        names = {path.name for path in directory.iterdir()}
    except FileNotFoundError:
        return
    except NotADirectoryError:
        raise StorageError(f"'{directory}' exists and is not a saved map; it is left as it is") from None
    except OSError as error:
        raise StorageError(f"cannot read '{directory}': {error}") from None
    if MANIFEST in names:
        try:
            read_manifest(directory)
        except StorageError as error:
            raise StorageError(f"{error}; '{directory}' is left as it is") from None
    # A save that was killed before its first commit leaves nothing but files of its own.
    elif not all(is_own_name(name) for name in names):
        raise StorageError(f"'{directory}' exists and is not a saved map; it is left as it is")


def save_map(directory: str | os.PathLike[str], saved: Savable, saved_ns: int | None = None) -> int:
    """Write a map, replacing a map that is there.

    The map is copied at one moment, under its lock, and goes on changing while the copy is written. Beside that copy a save
    needs some megabytes of memory. Arrays that are on disk already are not written again.

    Args:
        directory: Where; it and its parents are made. Until the save is complete it holds what it held.
        saved: The map and what else is to be known of it, e.g. a pipeline.
        saved_ns: Time of the save, nanoseconds since 1970, by which maps are ordered; None takes the system's clock.

    Returns:
        Bytes of the map on disk.

    Raises:
        StorageError: The place holds something that is not a map, cannot be written, or is being saved to by another
            process or thread; what was there is still there, and nothing else.
    """
    # Read before the map is copied: what is saved may be newer than its stamp, never older.
    directory, info, semantic_map = Path(directory), saved.info, saved.semantic_map
    check_map_target(directory)
    try:
        with writing_to(directory):
            arrays = {**semantic_map.export_state(), _POSES: info.camera_poses}
            # Arrays are let go one by one, so that the copy shrinks while it is written.
            entries = {name: write_array(directory, name, arrays.pop(name)) for name in tuple(arrays)}
            manifest = Manifest(
                saved_ns=time.time_ns() if saved_ns is None else saved_ns,
                encoder=info.encoder,
                logit_scale=info.logit_scale,
                map_frame=info.map_frame,
                stamp_ns=info.stamp_ns,
                dimension=semantic_map.dimension,
                variance_ratio=semantic_map.variance_ratio,
                config=info.config,
                arrays=entries,
            )
            commit(directory, manifest)
    except (OSError, ValidationError) as error:
        raise StorageError(f"cannot write map '{directory}': {error}") from None
    return manifest.size_bytes()


def load_map(directory: str | os.PathLike[str], device: str = "cpu") -> SavedMap:
    """Read a map into a new one of its own configuration.

    Args:
        directory: What :func:`save_map` wrote.
        device: Torch device that is to hold the map.

    Raises:
        StorageError: It is no map, of another version, incomplete or altered; the message names the file.
    """
    directory = Path(directory)
    manifest, arrays = _read(directory)
    info = _info(directory, manifest, arrays)
    try:
        on_device = MapConfig.model_validate({**info.config.map.model_dump(), "device": device})
        fusion = info.config.fusion.model_copy(update={"variance_ratio": manifest.variance_ratio})
        config = info.config.model_copy(update={"map": on_device, "fusion": fusion})
        semantic_map = SemanticMap.from_config(config, manifest.dimension, manifest.variance_ratio, manifest.encoder)
        semantic_map.import_state(arrays)
    except (ValueError, ConfigError, MapError) as error:
        raise _no_map(directory, error) from None
    return SavedMap(semantic_map, info)


def restore_map(directory: Path, semantic_map: SemanticMap, config: Config, encoder: str) -> MapInfo:
    """Replace the content of a running map by a saved one; a refusal leaves the running map as it was.

    Args:
        directory: What :func:`save_map` wrote.
        semantic_map: The running map.
        config: The running configuration.
        encoder: Name of the encoder trio that runs.

    Returns:
        What else the saved map tells.

    Raises:
        StorageError: It is no map, of another version, incomplete or altered, or does not fit; see :func:`check_fits`.
    """
    check_fits(directory, read_manifest(directory), config, encoder, semantic_map.dimension)
    manifest, arrays = _read(directory)
    check_fits(directory, manifest, config, encoder, semantic_map.dimension)  # It may have been replaced meanwhile.
    info = _info(directory, manifest, arrays)
    try:
        semantic_map.import_state(arrays)
    except MapError as error:
        raise _no_map(directory, error) from None
    was, now = info.config.encoder.weights, config.encoder.weights
    if was != now:
        # The same weights may lie in another place; others under the same name make another space.
        _log.warning(
            "map '%s' was built with encoder.weights '%s', here they are '%s': unless these are the same weights, its "
            "objects will not be found",
            directory,
            was,
            now,
        )
    return info


def check_fits(directory: Path, manifest: Manifest, config: Config, encoder: str, dimension: int) -> None:
    """Refuse a saved map that a running configuration cannot go on with.

    Args:
        directory: Where the map is, for the message.
        manifest: What the map says of itself.
        config: The running configuration.
        encoder: Name of the encoder trio that runs.
        dimension: Its embedding width d.

    Raises:
        StorageError: Encoder, embedding dimension, voxel size, number of hypotheses or map frame differ; the message gives
            both values of each.
    """
    saved, running = manifest.config, config
    pairs = {
        "encoder": (manifest.encoder, encoder),
        "embedding dimension": (manifest.dimension, dimension),
        "map.voxel_size_m": (saved.map.voxel_size_m, running.map.voxel_size_m),
        "map.max_hypotheses": (saved.map.max_hypotheses, running.map.max_hypotheses),
        "input.map_frame": (manifest.map_frame, running.input.map_frame),
    }
    differences = [f"{name} is {was!r}, here {now!r}" for name, (was, now) in pairs.items() if was != now]
    if differences:
        raise StorageError(f"map '{directory}' does not fit this configuration: its {'; its '.join(differences)}")


def _read(directory: Path) -> tuple[Manifest, dict[str, NDArray[Any]]]:
    with opened(directory) as (manifest, files):
        entries = manifest.arrays
        return manifest, {
            name: read_array(directory / entries[name].file_name(name), file, entries[name]) for name, file in files.items()
        }


def _info(directory: Path, manifest: Manifest, arrays: dict[str, NDArray[Any]]) -> MapInfo:
    """Take the camera poses out of the arrays and put together what the map tells besides."""
    poses = arrays.pop(_POSES, None)
    if poses is None or poses.shape[1:] != (4, 4) or poses.dtype != np.float64:
        raise _no_map(directory, f"array '{_POSES}' must be there and be (n, 4, 4) float64")
    return MapInfo(manifest.encoder, manifest.logit_scale, manifest.map_frame, manifest.stamp_ns, manifest.config, poses)


def _no_map(directory: Path, cause: object) -> StorageError:
    return StorageError(f"'{directory / MANIFEST}' does not describe a map: {cause}")
