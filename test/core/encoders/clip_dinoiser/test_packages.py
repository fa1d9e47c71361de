"""Without the extra the trio is refused by name, and nothing of it is imported before."""

from __future__ import annotations

import sys

import pytest

from fus3dmaps_core.encoders.registry import load_text_encoder, load_trio
from fus3dmaps_core.errors import EncoderError


@pytest.mark.parametrize(
    "load", [lambda: load_trio("clip_dinoiser", "cpu", 0.05), lambda: load_text_encoder("clip_dinoiser", "cpu")]
)
def test_a_missing_package_is_named_with_the_extra_that_has_it(load, monkeypatch):
    monkeypatch.setitem(sys.modules, "open_clip", None)  # As if it were not installed.
    monkeypatch.delitem(sys.modules, "open_clip.model", raising=False)
    with pytest.raises(EncoderError, match=r"'clip_dinoiser'.*'open_clip.*fus3dmaps_ros\[models\]") as refusal:
        load()
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("device", ["cuda:99", "abacus"])
def test_an_unusable_device_is_named(device):
    with pytest.raises(EncoderError, match=rf"encoder\.device.*{device}"):
        load_trio("clip_dinoiser", device, 0.05)
