"""Options that several commands share, and how the texts of ``--set``, ``--option`` and ``--out`` are read."""

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
Prompts = Annotated[list[str], typer.Argument(metavar="PROMPT...", help="What to look for, in plain words.")]
Layer = Annotated[str, typer.Option("--layer", help="dense, fused_dense, instances or fused_instances.")]
Negative = Annotated[list[str] | None, typer.Option("--not", help="What it is not; repeatable.")]
AnswerAsJson = Annotated[bool, typer.Option("--json", help="Print a JSON list, best first.")]


def configuration(params_file: Path | None, settings: list[str] | None) -> Config:
    """Return the parameters of a file, or the defaults, after ``--set`` has replaced some of them.

    Args:
        params_file: A file that :meth:`fus3dmaps_core.config.schema.Config.from_yaml` can read.
        settings: ``key=value`` each. Text is taken literally, even if empty, unless it is in quotes; all else is YAML.

    Raises:
        ConfigError: The file cannot be read, or a parameter is unknown, of the wrong type or out of range.
    """
    config = Config() if params_file is None else Config.from_yaml(params_file)
    return config.with_values({key: _value(key, text) for key, text in pairs("--set", settings).items()})


def pairs(option: str, settings: list[str] | None) -> dict[str, str]:
    """Return the texts of a repeatable option by their keys.

    Args:
        option: The option's name, for the message.
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
    """Return the directory that ``--out`` names.

    Raises:
        ConfigError: The text is empty; as a path it would be the current directory.
    """
    if not str(text).strip():
        raise ConfigError("--out: the name of a directory is missing; the current directory is '.'")
    return Path(text)


def _value(key: str, text: str) -> Any:
    field = fields().get(key)
    plain = text.strip()
    # Read as YAML, a path could be a number or a date, or end at a "#", and empty text would be null.
    if field is not None and isinstance(field.default, str) and not plain.startswith(("'", '"')):
        return plain
    try:
        return yaml.safe_load(text)
    except yaml.YAMLError as error:
        reason = getattr(error, "problem", None) or "it cannot be read"
        raise ConfigError(f"parameter '{key}': '{text}' is no YAML value: {reason}") from None
