"""Trios with graphs, exported once a session."""

from __future__ import annotations

import numpy as np
import pytest
from graph_trios import HEIGHT, WIDTH, narrow_clip_dinoiser, narrow_radio, narrow_siglip2, toy_trio

from fus3dmaps_core.encoders.protocols import EncoderTrio
from fus3dmaps_core.encoders.registry import load_trio


@pytest.fixture(scope="session")
def trios(tmp_path_factory) -> dict[str, EncoderTrio]:
    return {
        "lite": load_trio("lite", "cpu", 0.05),
        "clip_dinoiser": narrow_clip_dinoiser(),
        "siglip2": narrow_siglip2(tmp_path_factory.mktemp("siglip2")),
        **{name: narrow_radio(name, tmp_path_factory.mktemp(name)) for name in ("naradio", "radseg")},
    }


@pytest.fixture
def picture(rng) -> np.ndarray:
    return rng.integers(0, 256, (HEIGHT, WIDTH, 3)).astype(np.uint8)


@pytest.fixture
def toy() -> EncoderTrio:
    return toy_trio()
