"""The work of a first start, done beforehand: set-up and images run ``python -m fus3dmaps_ros.commands.first_start``.

Three things are kept: the bytecode of everything that is imported here, the compiled loops for every storage type, and the
embeddings that the default encoders compute of the names of their classes.
"""

from __future__ import annotations

from typing import get_args

import fus3dmaps_ros.commands.demo
import fus3dmaps_ros.mapper_node
import fus3dmaps_ros.player_node  # noqa: F401  imported for its bytecode, as the two above
from fus3dmaps_core.config.schema import Config, MapConfig
from fus3dmaps_core.pipeline import Pipeline
from fus3dmaps_core.voxel_map.warm_up import warm_up


def prepare() -> None:
    """Load the default models as a start does, and rehearse a map of every storage type.

    Raises:
        EncoderError: The default models cannot be loaded.
    """
    Pipeline.from_config(Config())
    for dtype in get_args(MapConfig.model_fields["dtype"].annotation):
        warm_up(4, MapConfig(dtype=dtype))


if __name__ == "__main__":
    prepare()
