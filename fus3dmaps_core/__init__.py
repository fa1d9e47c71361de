"""Open-vocabulary 3D mapping: one voxel map, a dense and an instance layer, and their fusion. Imports no ROS.

The public API. Names are imported at their first use, so that importing the package costs nothing.
"""

import os
from importlib import import_module
from typing import TYPE_CHECKING, Any

from fus3dmaps_core.version import __version__

if TYPE_CHECKING:
    from fus3dmaps_core.answers.query import TextQuery
    from fus3dmaps_core.config.schema import Config
    from fus3dmaps_core.frame import Intrinsics, PosedFrame
    from fus3dmaps_core.offline import map_recording
    from fus3dmaps_core.pipeline import Pipeline
    from fus3dmaps_core.saved_maps.storage import load_map, save_map
    from fus3dmaps_core.voxel_map.semantic_map import SemanticMap

__all__ = [
    "Config",
    "Intrinsics",
    "Pipeline",
    "PosedFrame",
    "SemanticMap",
    "TextQuery",
    "__version__",
    "load_map",
    "map_recording",
    "save_map",
]

_MODULES = {
    "Config": "config.schema",
    "Intrinsics": "frame",
    "Pipeline": "pipeline",
    "PosedFrame": "frame",
    "SemanticMap": "voxel_map.semantic_map",
    "TextQuery": "answers.query",
    "load_map": "saved_maps.storage",
    "map_recording": "offline",
    "save_map": "saved_maps.storage",
}

# Idle OpenMP threads spin for milliseconds by default. Beside SLAM or any other load they take the cores from the very
# threads they wait for, and inference on the CPU becomes several times slower; a short spin costs next to nothing on an idle
# machine. Read when torch is first imported, hence here. Whatever the user has set stands.
if "OMP_WAIT_POLICY" not in os.environ:
    os.environ.setdefault("GOMP_SPINCOUNT", "1000")


def __getattr__(name: str) -> Any:
    """Import a public name at its first use."""
    if name not in _MODULES:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    value = getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """List the public names beside those that are imported already."""
    return sorted({*globals(), *__all__})
