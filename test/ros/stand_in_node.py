"""The mapper as a process of its own, with stand-in models.

``SLOW_S`` makes every inference take that long. ``HANGING_SAVES=1`` makes every save stop for an hour before its commit.
"""

from __future__ import annotations

import os
import sys
import time
from typing import Any

import numpy as np
from stand_ins import DIMENSION, ColorEncoder, ColorSegmenter

from fus3dmaps_core.config.schema import Config
from fus3dmaps_core.encoders.protocols import EncoderTrio
from fus3dmaps_core.pipeline import Pipeline
from fus3dmaps_core.saved_maps import storage
from fus3dmaps_ros.mapper_node import main


class SlowEncoder(ColorEncoder):
    def encode_patches(self, rgb: np.ndarray) -> Any:
        time.sleep(float(os.environ.get("SLOW_S", "0")))
        return super().encode_patches(rgb)


def make_pipeline(config: Config) -> Pipeline:
    encoder = SlowEncoder()
    return Pipeline(config, EncoderTrio("stand_in", DIMENSION, 1.0, 20.0, encoder, encoder, encoder), ColorSegmenter())


def hang(*_: Any) -> None:
    print("before the commit", flush=True)
    time.sleep(3600)


if __name__ == "__main__":
    if os.environ.get("HANGING_SAVES"):
        storage.commit = hang
    sys.exit(main(make_pipeline=make_pipeline))
