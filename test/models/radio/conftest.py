"""Networks of both trios, narrow but of the true classes, loaded from files as a user's would be."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from radio_files import find_checkout, small_text_variant, with_norms, write_checkpoint, write_text

from fus3dmaps_core.encoders.radio.checkpoint import read_checkpoint
from fus3dmaps_core.encoders.radio.loading import load_trio


@pytest.fixture(scope="session")
def checkout() -> Path:
    return find_checkout()


@pytest.fixture(scope="session", params=["naradio", "radseg"])
def loaded(request, checkout, tmp_path_factory) -> SimpleNamespace:
    """Write a directory of weights; return it, the variant that it is for, its three encoders, and what the files hold."""
    torch.manual_seed(11)
    folder = tmp_path_factory.mktemp(request.param)
    variant = small_text_variant(request.param)
    (folder / "RADIO").symlink_to(checkout, target_is_directory=True)
    checkpoint = folder / variant.radio.file_name
    network = {"depth": 3, "init_values": 1.0}  # With layer scales.
    with_norms(write_checkpoint(checkpoint, checkout, variant.name, 48, 2, "vit_tiny_patch16_224", **network))
    tower = write_text(folder, variant, lengths_differ=True)
    trio = load_trio(variant, "cpu", 0.0, str(folder))
    radio = read_checkpoint(checkpoint, folder / "RADIO", variant.name).radio
    return SimpleNamespace(folder=folder, variant=variant, trio=trio, radio=radio, tower=tower, checkpoint=checkpoint)
