"""Devices that torch cannot use are refused in one short line."""

from __future__ import annotations

import pytest

from fus3dmaps_core.encoders.devices import check_device
from fus3dmaps_core.errors import EncoderError


@pytest.mark.parametrize("device", ["mps", "xla", "hpu", "vulkan", "meta", "cuda:99", "gpu", "", "cpu\n"])
def test_what_cannot_be_used_is_named_in_one_short_line(device):
    with pytest.raises(EncoderError) as refusal:
        check_device(device)
    message = str(refusal.value)
    assert message.startswith(f"parameter 'encoder.device': torch cannot use {device!r}: ")
    assert "\n" not in message
    assert len(message) < 350


def test_the_processor_can_be_used():
    check_device("cpu")
