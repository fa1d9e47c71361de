"""The datasets by name. A new layout needs a new module and a line here."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any, cast

from fus3dmaps_core.errors import ConfigError, RecordingError
from fus3dmaps_lab.datasets.protocols import Dataset, LabelledDataset

_LAYOUTS = {
    "hm3dsem": ("fus3dmaps_lab.datasets.hm3dsem", "Hm3dSem"),
    "replica": ("fus3dmaps_lab.datasets.replica_nice_slam", "ReplicaNiceSlam"),
    "replica_semantic_nerf": ("fus3dmaps_lab.datasets.replica_semantic_nerf", "ReplicaSemanticNerf"),
    "scannet": ("fus3dmaps_lab.datasets.scannet", "ScanNet"),
    "sevenscenes": ("fus3dmaps_lab.datasets.seven_scenes", "SevenScenes"),
    "tartanground": ("fus3dmaps_lab.datasets.tartanground", "TartanGround"),
    "tum": ("fus3dmaps_lab.datasets.tum", "TumRgbd"),
}


def names() -> list[str]:
    """List the names of the known layouts."""
    return sorted(_LAYOUTS)


def open_dataset(name: str, directory: Path, **options: object) -> Dataset:
    """Open a scene.

    Args:
        name: One of :func:`names`.
        directory: The scene's folder, or the one that holds it if ``scene`` is given.
        options: ``scene``, a folder inside ``directory``; ``stride``, which takes every n-th frame; and the options of the
            layout. Values may be text, as from a command line.

    Raises:
        RecordingError: The layout is unknown, or the folder has another layout; the message names the file.
        ConfigError: An option is unknown or of the wrong type.
    """
    if name not in _LAYOUTS:
        raise RecordingError(f"unknown dataset layout '{name}', known are {', '.join(names())}")
    module, class_name = _LAYOUTS[name]
    layout = getattr(import_module(module), class_name)
    scene = options.pop("scene", None)
    if scene is not None:
        directory = directory / str(scene)
    return cast(Callable[..., Dataset], layout)(directory, **_typed(name, layout, options))


def open_labelled(name: str, directory: Path, **options: object) -> LabelledDataset:
    """Open a scene whose true classes are known.

    Raises:
        RecordingError: As :func:`open_dataset`; also if the layout or this folder has no labels.
        ConfigError: As :func:`open_dataset`.
    """
    dataset = cast(LabelledDataset, open_dataset(name, directory, **options))
    if len(dataset.class_names) < 2:
        raise RecordingError(f"'{directory}' has no labels that the layout '{name}' knows; see docs/datasets.md")
    return dataset


def _typed(name: str, layout: type[Any], options: dict[str, object]) -> dict[str, object]:
    known = {key: p for key, p in inspect.signature(layout).parameters.items() if p.kind is p.KEYWORD_ONLY}
    typed: dict[str, object] = {}
    for key, value in options.items():
        if key not in known:
            raise ConfigError(f"option '{key}' is unknown to '{name}', known are {', '.join(sorted(['scene', *known]))}")
        default = known[key].default
        try:
            typed[key] = int(str(value)) if isinstance(default, int) else str(value)
        except ValueError:
            raise ConfigError(f"option '{key}' must be a whole number, got '{value}'") from None
    return typed
