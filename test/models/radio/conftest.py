"""Networks of both pairs, narrow but of the true classes, loaded from files as a user's would be."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from radio_files import find_checkout, small_text_pair, with_norms, write_checkpoint, write_text

from fus3dmaps_core.encoders.radio.checkpoint import read_checkpoint
from fus3dmaps_core.encoders.radio.pair import load_trio


@pytest.fixture(scope="session")
def checkout() -> Path:
    return find_checkout()


@pytest.fixture(scope="session", params=["naradio", "radseg"])
def loaded(request, checkout, tmp_path_factory) -> SimpleNamespace:
    """A directory of weights, the pair that it is for, its three encoders, and what the files hold."""
    torch.manual_seed(11)
    folder = tmp_path_factory.mktemp(request.param)
    pair = small_text_pair(request.param)
    (folder / "RADIO").symlink_to(checkout, target_is_directory=True)
    checkpoint = folder / pair.radio.file_name
    network = {"depth": 3, "init_values": 1.0}  # With layer scales.
    with_norms(write_checkpoint(checkpoint, checkout, pair.name, 48, 2, "vit_tiny_patch16_224", **network))
    tower = write_text(folder, pair, lengths_differ=True)
    trio = load_trio(pair, "cpu", 0.0, str(folder))
    radio = read_checkpoint(checkpoint, folder / "RADIO", pair.name).radio
    return SimpleNamespace(folder=folder, pair=pair, trio=trio, radio=radio, tower=tower, checkpoint=checkpoint)
