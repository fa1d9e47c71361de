"""The manifest of a saved map: what it says, and how it is read and refused.

A manifest is small and is read as a whole, so that a map can be listed, compared and refused without its arrays.
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Annotated, Any, Final, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, PlainSerializer, StringConstraints, ValidationError

from fus3dmaps_core.config.schema import Config
from fus3dmaps_core.errors import ConfigError, StorageError

FORMAT: Final = "fus3dmaps-map"
FORMAT_VERSION: Final = 2
MANIFEST = "manifest.json"

NAME_PATTERN = "[a-z][a-z0-9_]{0,63}"
"""What an array may be called: nothing that leads out of its directory."""

DIGITS_IN_NAME = 16
"""Hexadecimal digits of the SHA-256 that are part of an array file's name."""

_MAX_MANIFEST_BYTES = 1 << 20
_NO_CHECKSUM = "0" * 64
_Checksum = Annotated[str, StringConstraints(pattern="^[0-9a-f]{64}$")]
_MAX_DIMENSION = 1 << 16


def _config_of(value: Any) -> Any:
    return Config.from_flat(value) if isinstance(value, dict) else value


class ArrayFile(BaseModel):
    """One array of a saved map.

    Attributes:
        dtype: numpy's name of its type.
        shape: Its shape.
        size_bytes: Size of its file, header included.
        sha256: Checksum of its file, hexadecimal.
    """

    model_config = ConfigDict(frozen=True, strict=True)

    dtype: str
    shape: tuple[Annotated[int, Field(ge=0)], ...]
    size_bytes: int = Field(ge=0)
    sha256: _Checksum

    def file_name(self, name: str) -> str:
        """Return the name of the file that holds the array ``name``, in the map's directory."""
        return f"{name}.{self.sha256[:DIGITS_IN_NAME]}.npy"


class Manifest(BaseModel):
    """What ``manifest.json`` says.

    Attributes:
        format: Always FORMAT.
        version: FORMAT_VERSION.
        saved_ns: Time of the save, nanoseconds since 1970.
        encoder: Registry name of the encoder trio whose space the embeddings live in.
        logit_scale: The trio's factor before a softmax over cosines.
        map_frame: Frame of all positions.
        stamp_ns: Time of the newest frame, nanoseconds.
        dimension: Embedding width d.
        variance_ratio: lambda = R^D / R^I.
        config: Configuration that the map was made with; in the file under dotted keys.
        arrays: The arrays by name.
        sha256: In a manifest that was read, checksum of the file with 64 zeros in the place of this value.
    """

    model_config = ConfigDict(frozen=True, strict=True, allow_inf_nan=False)

    format: Literal["fus3dmaps-map"] = FORMAT
    version: Literal[2] = FORMAT_VERSION
    saved_ns: int
    encoder: str
    logit_scale: float
    map_frame: str
    stamp_ns: int
    dimension: int = Field(ge=1, le=_MAX_DIMENSION)
    variance_ratio: float
    config: Annotated[Config, BeforeValidator(_config_of), PlainSerializer(Config.flat)]
    arrays: dict[Annotated[str, StringConstraints(pattern=f"^{NAME_PATTERN}$")], ArrayFile]
    sha256: _Checksum = _NO_CHECKSUM

    def file_names(self) -> set[str]:
        """Return the names of the array files that belong to the map."""
        return {entry.file_name(name) for name, entry in self.arrays.items()}

    def size_bytes(self) -> int:
        """Return the bytes of the map on disk, the manifest included."""
        return sum(entry.size_bytes for entry in self.arrays.values()) + len(self.encode())

    def encode(self) -> bytes:
        """Encode the file's content, with its checksum."""
        content = self.model_copy(update={"sha256": _NO_CHECKSUM}).model_dump_json(indent=1).encode()
        return content.replace(_NO_CHECKSUM.encode(), hashlib.sha256(content).hexdigest().encode())


class _Header(BaseModel):
    """What every version of the format has."""

    model_config = ConfigDict(strict=True)

    format: Literal["fus3dmaps-map"]
    version: int


def read_manifest(directory: Path) -> Manifest:
    """Read and check the manifest of a saved map.

    Raises:
        StorageError: There is none, it cannot be read, is of another version, damaged, or does not describe a map.
    """
    path = directory / MANIFEST
    if not path.is_file():
        raise StorageError(f"'{directory}' is not a saved map: it has no {MANIFEST}")
    try:
        with path.open("rb") as file:
            content = file.read(_MAX_MANIFEST_BYTES + 1)
    except OSError as error:
        raise StorageError(f"cannot read '{path}': {error}") from None
    if len(content) > _MAX_MANIFEST_BYTES:
        raise StorageError(f"'{path}' is not the manifest of a saved map: it is larger than {_MAX_MANIFEST_BYTES} bytes")
    try:
        version = _Header.model_validate_json(content).version
    except ValidationError as error:
        raise StorageError(f"'{path}' is not the manifest of a saved map: {_describe(error)}") from None
    if version != FORMAT_VERSION:
        raise StorageError(f"'{path}' has format version {version}; this program reads {FORMAT_VERSION}")
    try:
        manifest = Manifest.model_validate_json(content)
    except ValidationError as error:
        raise StorageError(f"'{path}' does not describe a map: {_describe(error)}") from None
    except ConfigError as error:
        raise StorageError(f"'{path}' does not describe a map: {error}") from None
    blank = content.replace(manifest.sha256.encode(), _NO_CHECKSUM.encode())
    if hashlib.sha256(blank).hexdigest() != manifest.sha256:
        raise StorageError(f"'{path}' is damaged: its checksum is not that of its content")
    return manifest


def _describe(error: ValidationError) -> str:
    return "; ".join(
        f"{'.'.join(str(part) for part in item['loc']) or 'content'}: {item['msg']}"
        for item in error.errors(include_input=False, include_url=False)
    )
