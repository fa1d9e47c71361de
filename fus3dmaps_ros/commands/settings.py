"""What the command line says about parameters and directories: ``--params-file``, ``--set``, ``--option`` and ``--out``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer
import yaml

from fus3dmaps_core.config.schema import Config, fields
from fus3dmaps_core.errors import ConfigError

ParamsFile = Annotated[Path | None, typer.Option("--params-file", help="YAML file of parameters, as for the node.")]
Settings = Annotated[list[str] | None, typer.Option("--set", help="A parameter, e.g. map.voxel_size_m=0.1; repeatable.")]
DatasetOptions = Annotated[list[str] | None, typer.Option("--option", help="Of the dataset, e.g. stride=11; repeatable.")]


def configuration(params_file: Path | None, settings: list[str] | None) -> Config:
    """The parameters of a file, or the defaults, with those of ``--set`` in their place.

    Args:
        params_file: As :meth:`fus3dmaps_core.config.schema.Config.from_yaml` reads it.
        settings: ``key=value`` each. A text is taken as it stands, empty too, unless it is in quotes; all else is YAML.

    Raises:
        ConfigError: The file cannot be read, or a parameter is unknown, of the wrong type or out of range.
    """
    config = Config() if params_file is None else Config.from_yaml(params_file)
    return config.with_values({key: _value(key, text) for key, text in pairs("--set", settings).items()})


def pairs(option: str, settings: list[str] | None) -> dict[str, str]:
    """The texts of a repeatable option by their keys.

    Args:
        option: Its name, for the message.
        settings: ``key=value`` each.

    Raises:
        ConfigError: One of them has no equals sign.
    """
    values: dict[str, str] = {}
    for setting in settings or ():
        key, equals, text = setting.partition("=")
        if not equals:
            raise ConfigError(f"{option} {setting}: expected key=value")
        values[key.strip()] = text
    return values


def directory(text: str | Path) -> Path:
    """The directory that ``--out`` names.

    Raises:
        ConfigError: The text is empty, which as a path would be the current directory.
    """
    if not str(text).strip():
        raise ConfigError("--out: the name of a directory is missing; the current directory is '.'")
    return Path(text)


def _value(key: str, text: str) -> Any:
    field = fields().get(key)
    plain = text.strip()
    # As YAML a path may be a number, a date, or end at a "#", and nothing at all is no text.
    if field is not None and isinstance(field.default, str) and not plain.startswith(("'", '"')):
        return plain
    try:
        return yaml.safe_load(text)
    except yaml.YAMLError as error:
        reason = getattr(error, "problem", None) or "it cannot be read"
        raise ConfigError(f"parameter '{key}': '{text}' is no YAML value: {reason}") from None
